"""A point on a line that gains by being near a wall it must not touch: optimum known exactly.

The point starts at x0 in [-0.1, 0.1] and moves by 0.1 a, a clipped to [-1, 1]. Each step pays the
position reached. Reaching x >= 1 (the contact distance 0.5 of an obstacle at 1.5, which also stops
the point) costs 1. Without the constraint the best place is 1.5; with it, just below 1.
"""

from __future__ import annotations

import functools
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

CENTRE, D_MIN, SPEED = 1.5, 0.5, 0.1
EPISODE = 40


def optimal_return(limit: float = CENTRE - D_MIN, steps: int = EPISODE) -> float:
    """Return from x0 = 0 of moving at full speed to ``limit`` and staying there."""
    return float(np.minimum(limit, SPEED * np.arange(1, steps + 1)).sum())


class ToyEnvs(VectorEnv):
    """N points; the same attributes, infos, autoreset and snapshots as the repository's tasks."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012
    d_min = D_MIN
    num_obstacles = 1
    task_version = 1

    def __init__(self, num_envs: int, max_episode_steps: int = EPISODE) -> None:
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.observation_layout = {"x": slice(0, 1)}
        self.single_observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = gymnasium.vector.utils.batch_space(
            self.single_observation_space, num_envs
        )
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)
        self._random = np.random.default_rng(0)
        self._x = np.zeros(num_envs)
        self._steps = np.zeros(num_envs, dtype=np.int64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        if seed is not None:
            self._random = np.random.default_rng(seed)
        self._x = self._random.uniform(-0.1, 0.1, self.num_envs)
        self._steps[:] = 0
        return self._x[:, None].copy(), self._infos(
            np.zeros(self.num_envs), np.zeros(self.num_envs)
        )

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        before = self._x
        moved = before + SPEED * np.clip(np.asarray(actions, np.float64)[:, 0], -1.0, 1.0)
        self._x = np.minimum(moved, CENTRE)
        self._steps += 1
        rewards = self._x.copy()
        cost = (CENTRE - self._x <= D_MIN).astype(float)
        infos = self._infos(cost, self._x - before)
        truncated = self._steps >= self.max_episode_steps
        terminated = np.zeros(self.num_envs, dtype=bool)
        if truncated.any():
            infos["final_obs"], infos["_final_obs"] = self._x[:, None].copy(), truncated.copy()
            infos["final_info"] = {key: np.copy(value) for key, value in infos.items()}
            self._x = self._x.copy()
            self._x[truncated] = self._random.uniform(-0.1, 0.1, int(truncated.sum()))
            self._steps[truncated] = 0
            infos["d"] = (CENTRE - self._x)[:, None]
            infos["d_dot"] = np.where(truncated[:, None], 0.0, infos["d_dot"])
        return self._x[:, None].copy(), rewards, terminated, truncated, infos

    def _infos(self, cost: np.ndarray, change: np.ndarray) -> dict[str, Any]:
        zeros = np.zeros(self.num_envs)
        return {
            "cost": cost,
            "cost_indicator": cost,
            "cost_contact": cost,
            "goal_met": zeros,
            "reward_approach": zeros,
            "reward_push": zeros,
            "reward_goal": zeros,
            "d": (CENTRE - self._x)[:, None],
            "d_dot": -change[:, None] / SPEED,
        }

    def get_state(self) -> dict[str, Any]:
        return {
            "x": self._x.copy(),
            "steps": self._steps.copy(),
            "random": self._random.bit_generator.state,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        self._x = np.array(state["x"])
        self._steps = np.array(state["steps"])
        self._random.bit_generator.state = state["random"]


# Algorithms that ask the model of the point robot, which the toy has not.
OF_THE_ROBOT = ("fac_oracle", "safemr_guarded")


def envs_for(algorithm: str) -> Any:
    """What makes the environments that an algorithm is tried on: the toy where that will do."""
    if algorithm not in OF_THE_ROBOT:
        return ToyEnvs
    from safemr.tasks import make_envs

    return functools.partial(make_envs, "Pillars-0.15-Goal")
