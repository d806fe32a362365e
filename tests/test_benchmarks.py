"""The benchmarks run: each is a program that nothing else calls, and so breaks unseen."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import training

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("algorithm", ["safemr", "ppo_lagrangian"])
def test_the_parts_of_a_configured_run_are_timed(algorithm: str) -> None:
    task = "Hazards-0.30-Push"
    settings = training.settings_of(ROOT / "config" / "second_pilot.yaml", task)[algorithm]
    assert settings["interface"]["action_repeat"] == 5
    if algorithm == "ppo_lagrangian":
        short = {"epoch_steps": 800, "value_passes": 1, "policy_passes": 1}
        settings = settings | {"hyperparameters": settings["hyperparameters"] | short}
    settings = settings | {"decisions": 256}
    rows = training.measure(algorithm, task, 1, 2_000, settings)
    by_backend = training.cases(rows)
    assert {backend for _, backend in by_backend} == set(training.BACKENDS)
    for parts in by_backend.values():
        spent = {row["part"]: row["ms"] for row in parts}
        assert spent["environment"] > 0.0
        assert spent["critic step"] > 0.0
        assert sum(row["floor_ms"] for row in parts[:-1]) == parts[-1]["floor_ms"] > 0.0
    assert "| measured / floor |" in training.summary(rows)
