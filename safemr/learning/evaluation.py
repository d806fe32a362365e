"""Evaluation of a policy on fixed seeds, the same for every algorithm."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from safemr.environments import SafetyEnvs
from safemr.learning.episode_statistics import EpisodeStatistics
from safemr.learning.interface import held


class Acts(Protocol):
    """Anything that maps raw observations [N, obs] to the environment's actions [N, A].

    Each is held for ``action_repeat`` control steps, where it says so.
    """

    def act(self, observations: NDArray[Any], deterministic: bool = True) -> NDArray[Any]: ...


def play(
    policy: Acts, envs: SafetyEnvs, seed: int, deterministic: bool = True
) -> EpisodeStatistics:
    """One episode in every sub-environment of ``envs``, which are reset with seed, seed + 1, ...

    Reusing ``envs`` from one call to the next gives the same layouts each time.
    """
    envs = held(envs, getattr(policy, "action_repeat", 1))
    statistics = EpisodeStatistics(envs.num_envs)
    running = np.ones(envs.num_envs, bool)
    observations, _ = envs.reset(seed=seed)
    while running.any():
        actions = policy.act(observations, deterministic)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        statistics.update(rewards, terminated, truncated, infos, counted=running)
        running &= ~(terminated | truncated)
    return statistics


def evaluate(
    policy: Acts, envs: SafetyEnvs, seed: int, deterministic: bool = True
) -> dict[str, float]:
    """The averages of `EpisodeStatistics` over the episodes of `play`."""
    return play(policy, envs, seed, deterministic).pop()
