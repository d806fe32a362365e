"""A million random steps of the aircraft task: no exception, no NaN, no leak."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import envs  # noqa: F401  (registers the tasks)
from benchmarks.environments import resident_megabytes


@pytest.mark.slow
def test_a_million_random_steps() -> None:
    num_envs, total = 500, 1_000_000
    vector = gymnasium.make_vec(
        "Aircraft-v0", num_envs=num_envs, vectorization_mode="vector_entry_point"
    )
    vector.reset(seed=0)
    rng = np.random.default_rng(0)
    collided, over, baseline = 0, 0, 0.0
    for step in range(total // num_envs):
        if step % 10 == 0:
            actions = rng.uniform(-5.0, 5.0, (num_envs, 1))  # beyond the limits too
        observation, reward, terminated, truncated, infos = vector.step(actions)
        for array in (observation, reward, infos["d"], infos["d_dot"], infos["cost"]):
            assert np.isfinite(array).all()
        assert not (terminated & truncated).any()
        collided = collided + infos["cost"].sum()
        over = over + (terminated | truncated).sum()
        if step == 500:
            baseline = resident_megabytes()
    assert collided > 100
    assert over > collided + 1000
    assert resident_megabytes() - baseline < 20
