"""What `examples/safety_gymnasium` uses of Safety-Gymnasium, for its tests: a point among hazards.

It moves by 0.1 times its action, which is its velocity. The name says what is wrong with it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium.spaces import Box


@dataclass
class Hazards:
    name: str = "hazards"
    num: int = 3
    size: float = 0.2
    is_constrained: bool = True
    color: np.ndarray = np.ones(4)  # noqa: RUF009 - what Python 3.11 refuses
    pos: list[np.ndarray] = field(default_factory=list)


class World:
    """Observes its place and the number of its episode; 1 m to the right is the goal."""

    observation_space = Box(-np.inf, np.inf, (3,))

    def __init__(self, name: str, limit: int) -> None:
        self.name, self.limit, self.random, self.episode = name, limit, np.random.RandomState(), 0
        if name == "broken":
            raise ValueError("a wheel\nis missing")
        self.unwrapped: Any = self
        self.task = SimpleNamespace(
            action_space=Box(-1.0, 1.0, (2,)), hazards=Hazards(), agent=SimpleNamespace()
        )

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        print("not a message")
        if seed is not None:
            self.random, self.episode = np.random.RandomState(seed), 0
        self.steps, self.episode = 0, self.episode + 1
        around = self.random.uniform(-1.0, 1.0, (self.task.hazards.num, 2))
        self.task.hazards.pos = [np.array([x, y, 0.02]) for x, y in around]
        self.task.agent.pos, self.task.agent.vel = np.array([0.0, 0.0, 0.1]), np.zeros(3)
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, float, bool, bool, dict[str, Any]]:
        if action[0] > 0.99 and self.name in ("wheels", "exits"):
            if self.name == "exits":
                os._exit(3)
            raise ValueError("a wheel\nfell off")
        agent = self.task.agent
        agent.vel = np.array([*action, 0.0])
        agent.pos = agent.pos + 0.1 * agent.vel
        self.steps += 1
        away = [np.hypot(*(place - agent.pos)[:2]) for place in self.task.hazards.pos]
        cost = float(min(away) < self.task.hazards.size)
        info = {"goal_met": True} if agent.pos[0] > 1.0 else {}
        return self._seen(), agent.pos[0], cost, False, self.steps >= self.limit, info

    def _seen(self) -> Any:
        return np.array([*self.task.agent.pos[:2], self.episode])


def make(name: str, disable_env_checker: bool, max_episode_steps: int) -> World:
    assert disable_env_checker
    return World(name, max_episode_steps)
