"""`safemr.load`: a record in other hands, here and where the packages are only installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

import safemr
from safemr import cli
from safemr.certificates.bound import BoundCertificate
from safemr.errors import UserError
from safemr.experiment.record import Record
from safemr.experiment.train import main

matplotlib.use("Agg")
ROOT = Path(__file__).resolve().parents[1]
RUNS = ROOT / "results/runs/Pillars-0.15-Goal"
OURS = next((RUNS / "SafeMR").glob("seed0-*"))
BASELINE = next((RUNS / "PPO-L").glob("seed0-*"))


def test_a_record_is_a_policy_and_a_certificate() -> None:
    loaded, record = safemr.load(OURS), Record.open(OURS)
    envs = loaded.make_envs(2)
    observations, infos = envs.reset(seed=0)
    actions = loaded.policy(observations)
    assert np.array_equal(actions, record.policy().act(observations))
    assert np.array_equal(loaded.policy(observations[0]), loaded.policy(observations[:1])[0])
    bound, plain = loaded.certificate, record.certificate()
    assert isinstance(bound, BoundCertificate)
    assert bound.d_min == envs.d_min == 0.25
    d, d_dot = infos["d"], infos["d_dot"]
    assert np.array_equal(bound.phi(d, d_dot), plain.phi(d, d_dot, 0.25))
    assert bound.phi(1.0, -0.5) == bound.phi(np.array([1.0, 3.0]), np.array([-0.5, 0.0]))
    assert bound.phi(np.linspace(0.1, 2, 7)[:, None], 0.0).shape == (7,)
    assert loaded.progress[-1]["step"] >= loaded.config["steps"]
    envs.close()


def test_phi_is_drawn_with_its_zero_where_it_is_zero() -> None:
    bound = safemr.load(OURS).certificate
    ax = bound.plot(speed=1.0, points=101)
    line = next(c for c in ax.collections if len(c.get_paths()) == 1 and not c.get_fill())
    zero = line.get_paths()[0].vertices
    assert np.abs(bound.phi(zero[:, :1], zero[:, 1:])).max() < 0.02
    matplotlib.pyplot.close(ax.figure)


def test_what_is_not_there_is_told() -> None:
    loaded = safemr.load(str(BASELINE))
    with pytest.raises(UserError, match="no energy function"):
        loaded.certificate  # noqa: B018
    with pytest.raises(UserError, match="json is missing; repair"):
        safemr.load(RUNS / "SafeMR/seed9-000000000000")
    with pytest.raises(UserError, match="d has shape"):
        safemr.load(OURS).certificate.phi(np.ones(3), np.ones(2))


def test_it_works_where_the_packages_are_installed(tmp_path: Path) -> None:
    """As from a wheel: the packages and their assets in a folder, and nothing else."""
    site = tmp_path / "site"
    for package in ("safemr", "envs"):
        kept = shutil.ignore_patterns("__pycache__") if package == "safemr" else None
        shutil.copytree(ROOT / package, site / package, ignore=kept)
    place = tmp_path / "elsewhere" / OURS.relative_to(ROOT / "results")
    shutil.copytree(OURS, place)
    code = (
        "import sys, gymnasium, numpy as np, safemr\n"
        "record = safemr.load(sys.argv[1])\n"
        "env = record.make_envs(1)\n"
        "env = safemr.SafetyFilter(gymnasium.make('Pillars-0.15-Goal-v0'), record.certificate)\n"
        "observation, info = env.reset(seed=0)\n"
        "*_, info = env.step(record.policy(observation))\n"
        "print(safemr.__file__, float(record.certificate.phi(info['d'], info['d_dot'])),\n"
        "      info['filter_feasible'])\n"
    )
    done = subprocess.run(
        [sys.executable, "-P", "-c", code, str(place)], cwd=tmp_path, capture_output=True,
        text=True, env={**os.environ, "PYTHONPATH": str(site), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    file, phi, feasible = done.stdout.split()
    assert Path(file).is_relative_to(site)
    assert feasible == "True"
    assert float(phi) < 0


def test_the_critic_is_kept_where_it_is_asked_for_and_nowhere_else(tmp_path: Path) -> None:
    small = ["--set", "start_steps=100", "--set", "num_envs=2", "--steps", "400"]
    options = ["--task", "Pillars-0.15-Goal", "--algorithm", "fac", *small, "--eval-episodes", "1",
               "--log-points", "1", "--out", str(tmp_path)]  # fmt: skip
    assert main(options) == 0
    assert main([*options, "--set", "record_critic=true"]) == 0
    found: dict[bool, Any] = {}
    for config in tmp_path.glob("runs/*/*/*/config.json"):
        loaded = safemr.load(config.parent)
        found["record_critic" in config.read_text()] = loaded
    assert set(found) == {True, False}
    extra = {"critic_sizes", "critic_activation", "critic_parameters", "critic_scale"}
    without, kept = (found[key].record.policy_arrays() for key in (False, True))
    assert set(kept) - set(without) == extra
    for name in without:  # what was trained is the same
        assert np.array_equal(without[name], kept[name])
    from safemr.filters.wrapper import FilteredEnvs

    filtered = FilteredEnvs(found[True].make_envs(2), found[True].certificate, "critic")
    observations, _ = filtered.reset(seed=0)
    wanted = found[True].policy(observations)
    *_, infos = filtered.step(wanted)
    scale = float(kept["critic_scale"])
    assert scale == found[True].record.hyperparameters["constraint_scale"]
    assert np.isfinite(infos["filter_margin"]).all()
    with pytest.raises(UserError, match="record_critic"):
        FilteredEnvs(found[False].make_envs(1), found[False].certificate, "critic")


def test_the_film_is_written_and_bad_input_ends_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    path = tmp_path / "films" / "out.gif"
    assert cli.main(["play", str(BASELINE), "--certificate", "phi_h", "--filter", "--steps", "12",
                     "--stride", "6", "--video", str(path)]) == 0  # fmt: skip
    with Image.open(path) as film:
        assert film.n_frames == 2
        assert film.info["duration"] == 120
    assert "12 steps: return" in capsys.readouterr().out
    for wrong in (
        ["--video", "out.avi"],
        ["--video", "a.gif", "--steps", "0"],
        ["--video", "a.gif"],
    ):
        with pytest.raises(SystemExit) as end:
            cli.main(["play", str(BASELINE), *wrong])
        assert end.value.code == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("error: ")
