"""A run killed at any moment and started again ends as if nothing had happened."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import pytest
from kills import Outcome, attempt, equal_rows, finish, killed, make_run, outcome, short_run

from safemr.experiment import planning

# Overrides that let every branch of an algorithm run within 600 steps.
SMALL: dict[str, dict[str, Any]] = {
    "off_policy": {"start_steps": 100, "batch_size": 32, "hidden": 16, "replay_capacity": 400},
    "on_policy": {"epoch_steps": 320, "hidden": 16, "value_batch": 80, "policy_batch": 80},
}


def small_run(name: str, steps: int = 1200, task: str = "Hazards-0.15-Push") -> planning.Run:
    algorithm = planning.load_algorithm(name)
    fields = algorithm.hyperparameters.__dataclass_fields__
    overrides = {k: v for k, v in SMALL[algorithm.family].items() if k in fields}
    return make_run(name, task, overrides, steps, points=12, evaluations=4)


def uninterrupted(run: planning.Run, root: Path) -> tuple[Outcome, float]:
    begun = time.monotonic()
    return finish(run, root), time.monotonic() - begun


def interrupted(run: planning.Run, root: Path, duration: float, kills: int, seed: int) -> None:
    """Kill the run at ``kills`` random moments of its life, then let it finish."""
    generator, window, hits = random.Random(seed), 0.6 * duration, 0
    while hits < kills:
        pid = attempt(run, root)
        time.sleep(generator.uniform(0.0, window))
        os.kill(pid, signal.SIGKILL)
        _, status = os.waitpid(pid, 0)
        if os.WIFSIGNALED(status):
            hits += 1
        else:  # it was finished already: begin again, and strike earlier
            shutil.rmtree(root)
            window *= 0.7
    _, status = os.waitpid(attempt(run, root), 0)
    assert status == 0


@pytest.mark.parametrize("name", ["safemr", "ppo_lagrangian"])
def test_kills_after_known_checkpoints(name: str, tmp_path: Path) -> None:
    """With the default networks, and every attempt but the first begun from a checkpoint."""
    run = short_run(name)
    every = run.config["log_every"]
    whole = finish(run, tmp_path / "whole")
    again = killed(run, tmp_path / "killed", [2 * every, 7 * every], [0.0, 0.05])
    assert equal_rows(again, whole) == len(whole[0])
    assert again == whole


@pytest.mark.parametrize("name", ["safemr", "ppo_lagrangian"])
def test_kills_at_random_moments(name: str, tmp_path: Path) -> None:
    run = small_run(name)
    whole, duration = uninterrupted(run, tmp_path / "whole")
    interrupted(run, tmp_path / "killed", duration, kills=3, seed=1)
    assert outcome(run, tmp_path / "killed") == whole


EVERY_ALGORITHM = [("Hazards-0.15-Push", name) for name in planning.algorithm_names()]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "name"), [*EVERY_ALGORITHM, ("Aircraft", "safemr")])
def test_many_kills_of_every_algorithm(task: str, name: str, tmp_path: Path) -> None:
    run = small_run(name, steps=2400, task=task)
    whole, duration = uninterrupted(run, tmp_path / "whole")
    for seed in range(5):
        root = tmp_path / f"killed{seed}"
        interrupted(run, root, duration, kills=5, seed=seed)
        assert outcome(run, root) == whole


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "name", "overrides"),
    [
        *(("Pillars-0.15-Goal", name, {}) for name in planning.algorithm_names()),
        ("Hazards-0.30-Push", "safemr", {}),
        ("Pillars-0.15-Goal", "safemr", {"backend": "torch"}),
        ("Aircraft", "safemr", {}),
        ("Aircraft", "ppo_lagrangian", {}),
    ],
)
def test_many_kills_after_known_checkpoints(
    task: str, name: str, overrides: dict[str, Any], tmp_path: Path
) -> None:
    """`tests/kills.py` counts more of them."""
    run = short_run(name, task, overrides)
    every = run.config["log_every"]
    whole = finish(run, tmp_path / "whole")
    for number, points in enumerate([(1, 5, 9), (2, 3, 4), (7, 8, 10)]):
        root = tmp_path / f"killed{number}"
        again = killed(run, root, [point * every for point in points], [0.0, 0.02, 0.05])
        assert equal_rows(again, whole) == len(whole[0])
        assert again == whole


def test_two_runs_with_one_seed_are_equal(tmp_path: Path) -> None:
    run = small_run("fac", steps=600)
    first, _ = uninterrupted(run, tmp_path / "first")
    second, _ = uninterrupted(run, tmp_path / "second")
    assert first == second
