"""A run killed at any moment and started again ends as if nothing had happened."""

from __future__ import annotations

import csv
import io
import os
import random
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from safemr import records, runs
from safemr.checkpoints import RunSession
from safemr.train import train

# Overrides that let every branch of an algorithm run within 600 steps.
SMALL: dict[str, dict[str, Any]] = {
    "off_policy": {"start_steps": 100, "batch_size": 32, "hidden": 16, "replay_capacity": 400},
    "on_policy": {"epoch_steps": 320, "hidden": 16, "value_batch": 80, "policy_batch": 80},
}

SETTINGS = {"Hazards-0.15-Push": {"max_episode_steps": 50}}


def small_run(name: str, steps: int = 1200, task: str = "Hazards-0.15-Push") -> runs.Run:
    algorithm = runs.load_algorithm(name)
    fields = algorithm.hyperparameters.__dataclass_fields__
    overrides = {k: v for k, v in SMALL[algorithm.family].items() if k in fields}
    return runs.make_run(
        runs.describe_task(task, SETTINGS.get(task, {})),
        algorithm,
        runs.hyperparameters(algorithm, overrides, name),
        variant=name,
        seed=100,
        steps=steps,
        log_every=steps // 12,
        evaluation={"every": steps // 4, "episodes": 1, "seed": 10_000},
    )


def attempt(run: runs.Run, root: Path) -> int:
    """Train in a forked process, which need not import anything; returns its process id."""
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        with open(os.devnull, "w") as quiet:
            sys.stderr = quiet
            with RunSession(run.config, run.variant, root, minimum_interval=0.0) as session:
                if not session.complete:
                    train(run.config, session, stream=quiet)
            status = 0
    finally:
        os._exit(status)


def outcome(run: runs.Run, root: Path) -> tuple[list[dict[str, str]], bytes]:
    """Progress without the time columns, and the policy file."""
    folder = root / run.path
    records.verify_record(folder)
    rows = list(csv.DictReader(io.StringIO((folder / "progress.csv").read_text())))
    kept = [{k: v for k, v in row.items() if not k.startswith("time_")} for row in rows]
    return kept, (folder / "policy.npz").read_bytes()


def uninterrupted(run: runs.Run, root: Path) -> tuple[tuple[list[dict[str, str]], bytes], float]:
    begun = time.monotonic()
    _, status = os.waitpid(attempt(run, root), 0)
    assert status == 0
    return outcome(run, root), time.monotonic() - begun


def interrupted(run: runs.Run, root: Path, duration: float, kills: int, seed: int) -> None:
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
def test_kills_at_random_moments(name: str, tmp_path: Path) -> None:
    run = small_run(name)
    whole, duration = uninterrupted(run, tmp_path / "whole")
    interrupted(run, tmp_path / "killed", duration, kills=3, seed=1)
    assert outcome(run, tmp_path / "killed") == whole


EVERY_ALGORITHM = [("Hazards-0.15-Push", name) for name in runs.algorithm_names()]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "name"), [*EVERY_ALGORITHM, ("Aircraft", "safemr")])
def test_many_kills_of_every_algorithm(task: str, name: str, tmp_path: Path) -> None:
    run = small_run(name, steps=2400, task=task)
    whole, duration = uninterrupted(run, tmp_path / "whole")
    for seed in range(5):
        root = tmp_path / f"killed{seed}"
        interrupted(run, root, duration, kills=5, seed=seed)
        assert outcome(run, root) == whole


def test_two_runs_with_one_seed_are_equal(tmp_path: Path) -> None:
    run = small_run("fac", steps=600)
    first, _ = uninterrupted(run, tmp_path / "first")
    second, _ = uninterrupted(run, tmp_path / "second")
    assert first == second
