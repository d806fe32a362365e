"""n-step returns of the replay memory against a plain loop over the same experience."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from safemr.learning.replay import Replay

GAMMA = 0.9


def fill(replay: Replay, steps: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random experience whose observation encodes (time, environment); returned time-major."""
    rng = np.random.default_rng(seed)
    envs = replay.num_envs
    log: dict[str, list] = {"rewards": [], "terminated": [], "ended": []}
    for t in range(steps):
        terminated = rng.random(envs) < 0.15
        ended = terminated | (rng.random(envs) < 0.15)
        rewards = rng.normal(size=envs)
        code = np.stack([np.full(envs, t), np.arange(envs)], 1)
        fields = {
            "observations": code,
            "next_observations": code + 0.5,
            "actions": rng.normal(size=(envs, 1)),
            "rewards": rewards,
            "terminated": terminated,
            "ended": ended,
            "costs": rewards > 1,
            "distances": np.arange(8) + 100.0 * code[:, :1],
        }
        replay.add(**{k: torch.as_tensor(np.asarray(v, np.float32)) for k, v in fields.items()})
        for name, value in (("rewards", rewards), ("terminated", terminated), ("ended", ended)):
            log[name].append(value)
    return {name: np.array(values) for name, values in log.items()}


def expected(log: dict[str, np.ndarray], t: int, env: int, n: int) -> tuple[float, float, float]:
    """Return, discount and last time step by a plain loop."""
    total, m = 0.0, 0
    while True:
        total += GAMMA**m * log["rewards"][t + m, env]
        m += 1
        if log["ended"][t + m - 1, env] or m == n or t + m == len(log["rewards"]):
            break
    last = t + m - 1
    return total, GAMMA**m * (1 - log["terminated"][last, env]), last


@given(
    n=st.integers(1, 6),
    steps=st.integers(1, 40),
    capacity=st.integers(6, 20),
    seed=st.integers(0, 1000),
)
@settings(max_examples=60, deadline=None)
def test_n_step_returns_stop_at_episode_ends_and_at_the_newest_step(n, steps, capacity, seed):
    replay = Replay(capacity, 3, 2, 1, 2, gamma=GAMMA, n_step=n)
    log = fill(replay, steps, seed)
    batch = replay.sample(64, torch.Generator().manual_seed(seed))
    for row in range(64):
        t, env = (int(x) for x in batch.observations[row])
        assert t >= steps - capacity
        total, discount, last = expected(log, t, env, n)
        assert batch.returns[row].item() == pytest.approx(total, rel=1e-5, abs=1e-5)
        assert batch.discounts[row].item() == pytest.approx(discount, rel=1e-6)
        assert batch.bootstraps[row].tolist() == [last + 0.5, env + 0.5]
        assert batch.d[row].tolist() == [100.0 * t, 100.0 * t + 1]
        assert batch.d_dot_next[row].tolist() == [100.0 * t + 6, 100.0 * t + 7]


def test_sampling_is_uniform_over_what_is_held():
    replay = Replay(10, 4, 2, 1, 2, gamma=GAMMA, n_step=3)
    fill(replay, 25)
    batch = replay.sample(40_000, torch.Generator().manual_seed(1))
    times, counts = np.unique(batch.observations[:, 0].numpy(), return_counts=True)
    assert times.tolist() == list(range(15, 25))
    # 4,000 each with a standard deviation of 60: six of them
    assert abs(counts - 4000).max() < 360


def test_state_continues_bit_for_bit():
    first, second = (Replay(10, 4, 2, 1, 2, gamma=GAMMA, n_step=3) for _ in range(2))
    fill(first, 7)
    second.load_state_dict(first.state_dict())
    for replay in (first, second):
        fill(replay, 6, seed=5)
    draws = [r.sample(32, torch.Generator().manual_seed(2)) for r in (first, second)]
    for a, b in zip(*draws, strict=True):
        assert torch.equal(a, b)


def test_a_ring_shorter_than_the_return_is_refused():
    with pytest.raises(ValueError, match="capacity 2 must be at least n_step 5"):
        Replay(2, 1, 1, 1, 1, gamma=GAMMA, n_step=5)


def test_split_gives_consecutive_parts():
    replay = Replay(10, 4, 2, 1, 2, gamma=GAMMA, n_step=3)
    fill(replay, 9)
    batch = replay.sample(8, torch.Generator().manual_seed(0))
    parts = batch.split(2)
    assert torch.equal(torch.cat([part.returns for part in parts]), batch.returns)
    assert [len(part.returns) for part in parts] == [4, 4]
