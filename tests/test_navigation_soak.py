"""Long runs of the navigation environments: endurance, memory, sleep statistics, the benchmark."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import ks_2samp

import envs  # noqa: F401  (registers the tasks)
from benchmarks import environments
from envs.tasks import NAVIGATION_TASKS


def make_vec(name: str, num_envs: int, **settings: Any) -> Any:
    return gymnasium.make_vec(
        f"{name}-v0", num_envs=num_envs, vectorization_mode="vector_entry_point", **settings
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(NAVIGATION_TASKS))
def test_a_million_random_steps(name: str) -> None:
    num_envs, total = 50, 1_000_000
    vector = make_vec(name, num_envs, sleep=NAVIGATION_TASKS[name].has_box)
    vector.reset(seed=0)
    rng = np.random.default_rng(0)
    ended, baseline = 0, 0.0
    for step in range(total // num_envs):
        if step % 10 == 0:
            actions = rng.uniform([-0.05, -1.0], [0.1, 1.0], (num_envs, 2))
        observation, reward, terminated, truncated, infos = vector.step(actions)
        for array in (observation, reward, infos["d"], infos["d_dot"], infos["cost"]):
            assert np.isfinite(array).all()
        assert not terminated.any()
        ended += truncated.sum()
        if step == 2000:
            baseline = environments.resident_megabytes()
    assert ended == total // 1000
    assert environments.resident_megabytes() - baseline < 20


def pushing_episodes(sleep: bool, seed: int) -> dict[str, NDArray[np.float64]]:
    """Statistics of episodes in which every robot runs into its box, [episodes] each."""
    vector = make_vec("Hazards-0.15-Push", 48, sleep=sleep, max_episode_steps=300)
    layout = vector.observation_layout
    observation, _ = vector.reset(seed=seed)
    start = np.array([vector.scene(i).box for i in range(48)])
    totals = {name: np.zeros(48) for name in ("reward_approach", "reward_push", "cost")}
    for _ in range(299):
        lidar = observation[:, layout["box_lidar"]]
        angle = np.angle((lidar**8 * np.exp(2j * np.pi * (np.arange(16) + 0.5) / 16)).sum(axis=1))
        turn = np.clip(angle, -1, 1)
        observation, _, _, _, infos = vector.step(np.stack([0.03 * (abs(angle) < 0.8), turn], 1))
        for name, total in totals.items():
            total += infos[name]
    end = np.array([vector.scene(i).box for i in range(48)])
    totals["box_path"] = np.linalg.norm(end[:, :2] - start[:, :2], axis=1)
    totals["box_turn"] = np.cos(end[:, 2] - start[:, 2])
    return totals


@pytest.mark.slow
def test_sleep_keeps_the_distributions() -> None:
    awake = pushing_episodes(sleep=False, seed=0)
    asleep = pushing_episodes(sleep=True, seed=1000)
    assert np.median(awake["box_path"]) > 0.05  # the boxes were pushed
    p_values = {name: ks_2samp(awake[name], asleep[name]).pvalue for name in awake}
    assert min(p_values.values()) > 1e-3, p_values


@pytest.mark.slow
def test_benchmark_reports_every_column(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "environments.csv"
    arguments = ["--tasks", "Pillars-0.15-Goal", "--rounds", "3", "--steps", "10"]
    assert environments.main([*arguments, "--output", str(file)]) == 0
    assert "| Pillars-0.15-Goal |" in capsys.readouterr().out
    with file.open() as stream:
        (row,) = csv.DictReader(stream)
    assert set(row) == set(environments.COLUMNS)
    assert 0 < float(row["MB per extra env"]) < 1
    assert 0.5 < float(row["batched / raw"]) < 1.5
