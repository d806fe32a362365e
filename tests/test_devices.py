"""Training on a GPU, where there is one: the same steps, and a record that a CPU reads."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from safemr.algorithms import fac, joint_sis, sac_lagrangian, safemr
from safemr.errors import UserError
from tests.test_numba_steps import PARTS, make, transitions

on_a_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")


@on_a_gpu
@pytest.mark.parametrize("module", [fac, joint_sis, safemr, sac_lagrangian])
def test_a_gpu_takes_the_same_steps(module: ModuleType) -> None:
    """Parameters, moments, temperature and zeta over 8 updates, with the CPU's noise."""
    here = make(module, "torch")
    there = type(here)(dataclasses.replace(here.config, device="cuda"), 5, 2, 0.25, 0, 100)
    for name in ("critics", "targets", "policy", "multiplier"):
        getattr(there, name).load(getattr(here, name).parameters.detach())
    random = [torch.Generator().manual_seed(5) for _ in range(2)]
    here.noise = lambda count: torch.randn(count, 2, generator=random[0])
    there.noise = lambda count: torch.randn(count, 2, generator=random[1]).cuda()
    for draw in range(2):
        here.update(transitions(draw), PARTS)
        there.update(type(batch := transitions(draw))(*(field.cuda() for field in batch)), PARTS)
    for name in ("critics", "targets", "policy", "multiplier"):
        moved = getattr(there, name).parameters
        assert moved.device.type == "cuda"
        one = getattr(here, name).parameters.detach()
        scale = float(one.abs().max())
        assert float((one - moved.detach().cpu()).abs().max()) <= 1e-4 * scale, name
    if isinstance(here, fac.Agent):
        torch.testing.assert_close(there.zeta.cpu(), here.zeta, rtol=1e-4, atol=1e-6)


@on_a_gpu
@pytest.mark.parametrize(
    "algorithm", ["fac", "joint_sis", "safemr", "neural_safemr", "sac_lagrangian"]
)
def test_a_run_on_a_gpu_is_recorded_and_read_on_a_cpu(algorithm: str, tmp_path: Path) -> None:
    import safemr as package

    record = package.train(
        "Pillars-0.15-Goal",
        algorithm,
        steps=8_000,
        log_points=2,
        eval_episodes=1,
        out=tmp_path,
        quiet=True,
        device="cuda",
        backend="torch",
        start_steps=2_000,
    )
    assert record.config["algorithm"]["hyperparameters"]["device"] == "cuda"
    loaded = package.load(record.folder)
    envs = loaded.make_envs(1)
    try:
        observations, _ = envs.reset(seed=0)
        assert np.isfinite(loaded.policy(observations)).all()
    finally:
        envs.close()


def test_a_name_that_is_no_device_is_refused() -> None:
    with pytest.raises(UserError, match="device = 'cudda': not a device of PyTorch"):
        safemr.Config(device="cudda")


@pytest.mark.parametrize("device", ["meta", "cuda:63"])
def test_a_device_that_this_machine_lacks_is_one_line(device: str) -> None:
    """Known only where the run is trained: `meta` has a name and no numbers."""
    with pytest.raises(UserError, match=f"device = '{device}': PyTorch finds no such device"):
        make(safemr, "torch", device=device)
