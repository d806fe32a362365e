"""Training that diverges stops at once and says what, where and when; the others go on."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch

from safemr.experiment import train
from safemr.learning import contract
from safemr.report import recorded

ROOT = Path(__file__).resolve().parents[1]
TASK, NAME = "Hazards-0.15-Push", "Short-Push"
SHORT = ("task.max_episode_steps=50", "hidden=16")
DIVERGING = {
    # An entropy that is hardly reached: the temperature, and with it every loss, grows for ever.
    "fac": ("target_entropy=1.386", "temperature_lr=1", "start_steps=100", "batch_size=32"),
    "safemr": ("target_entropy=1.386", "temperature_lr=1", "start_steps=100", "batch_size=32"),
    # Steps of 1 for a policy whose actions hardly vary.
    "ppo_lagrangian": ("policy_lr=1", "initial_log_std=-10", "epoch_steps=320"),
}
RECORDED = [path for path in ROOT.glob("results/**/progress.csv") if "probes" not in path.parts]


@pytest.mark.parametrize("name", DIVERGING)
def test_a_diverging_run_ends_in_one_line_and_is_named(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [word for value in (*SHORT, *DIVERGING[name]) for word in ("--set", value)]
    arguments = ["--task", TASK, "--task-name", NAME, "--algorithm", name]
    arguments += ["--steps", "4000", "--eval-episodes", "1"]
    lines = []
    for _ in range(2):  # what is deterministic fails again in the same way
        assert train.main([*arguments, *settings, "--out", str(tmp_path)]) == 4
        lines.append(capsys.readouterr().err.splitlines()[-1])
    assert lines[0] == lines[1]
    assert re.fullmatch(
        rf"error: {name} {NAME} seed 100: (\w+) became \d{{9,}}\.\d at step \d+; "
        r"last good log point: step \d+; no checkpoint yet",
        lines[0],
    )
    assert not list(tmp_path.glob("runs/*/*/*"))
    assert recorded.main([str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert f"{name} {NAME} seed 100" in printed
    assert "failed: " in printed


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e9, -1e9])
def test_what_is_absurdly_large_counts_as_infinite(value: float) -> None:
    with pytest.raises(contract.TrainingDivergedError) as caught:
        contract.check_finite(7, {"updates": 1e9, "policy_loss": 1.0, "temperature": value})
    error = caught.value
    assert (error.step, error.quantity) == (7, "temperature")
    assert error.value == value or (math.isnan(error.value) and math.isnan(value))
    parameters = torch.tensor([0.5, value, -2.0])
    with pytest.raises(contract.TrainingDivergedError, match="policy_parameters became"):
        contract.check_parameters(7, parameters)


def test_the_bounds_are_far_from_every_recorded_run() -> None:
    """A thousand times the largest number of the records passes."""
    assert len(RECORDED) > 300
    largest: dict[str, float] = {}
    for path in RECORDED:
        with path.open() as lines:
            for row in csv.DictReader(lines):
                for name, text in row.items():
                    if text and not name.startswith(("time_", "step", "train_", "eval_")):
                        largest[name] = max(largest.get(name, 0.0), abs(float(text)))
    assert largest["cost_grad_norm"] > 100
    contract.check_finite(0, {name: 1_000 * value for name, value in largest.items()})
    for path in ROOT.glob("results/**/policy.npz"):
        with np.load(path) as arrays:
            contract.check_parameters(0, 1_000 * torch.from_numpy(arrays["policy_parameters"]))
