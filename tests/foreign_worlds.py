"""Environments that know nothing of `safemr`: a point on a line, whole and with one fault each."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete

from tests.toy import ToyEnvs

EPISODE = 7


class Line(gymnasium.Env):
    """x moves by 0.1 (a - 2) / 2, a in [0, 4]; walls at 1.5 and, in every second episode, at -3.

    Pays x; costs 1 where a wall is nearer than d_min. ``fault`` is what is wrong, see `_spoilt`.
    """

    def __init__(self, fault: str = "", d_min: float | None = 0.5) -> None:
        self.fault, self.episode, self.steps = fault, 0, 0
        if d_min is not None:
            self.d_min = d_min
        if fault != "few obstacles":
            self.num_obstacles = 2
        self.action_space = Box(0.0, 4.0, (1,), np.float32)
        if fault == "discrete":
            self.action_space = Discrete(3)
        if fault == "unbounded":
            self.action_space = Box(-np.inf, np.inf, (1,), np.float32)
        # Vectors have the keys in this order.
        self.observation_space = Dict({"speed": Box(-np.inf, np.inf), "x": Box(-2.0, 6.0, (1, 1))})

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode, self.steps = self.episode + 1, 0
        self.x, self.speed = self.np_random.uniform(-0.1, 0.1), 0.0
        if self.fault == "other spaces" and self.episode > 1:
            self.action_space = Box(0.0, 5.0, (1,), np.float32)
        return self._seen(), self._told()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        if self.fault == "raises" and self.steps > 2:
            raise RuntimeError("no bolt")
        if self.fault == "short":
            return self._seen(), 0.0, False, {}  # type: ignore[return-value]
        self.speed = 0.5 * (float(np.ravel(action)[0]) - 2.0)
        self.x += 0.1 * self.speed
        told = self._told()
        told["cost"] = float((np.abs(told["d"]) < 0.5).any())
        told["text"] = "not a number"
        return self._seen(), self.x, False, False, self._spoilt(told)

    def _seen(self) -> dict[str, Any]:
        wide = self.fault == "wide" and self.steps > 2
        x = np.full((1, 2 if wide else 1), self.x, np.float32)
        speed = np.nan if self.fault == "nan observation" and self.steps > 2 else self.speed
        return {"speed": np.array([speed], np.float32), "x": x}

    def _told(self) -> dict[str, Any]:
        walls = np.array([1.5, -3.0][: 1 + self.episode % 2])
        if self.fault == "nobody":
            return {"d": np.full(1, np.inf), "d_dot": np.zeros(1)}
        return {"d": np.abs(walls - self.x), "d_dot": -np.sign(walls - self.x) * self.speed}

    def _spoilt(self, told: dict[str, Any]) -> dict[str, Any]:
        late = self.steps > 2
        lacking = {"no cost": "cost", "no d": "d", "no d_dot": "d_dot"}
        if self.fault in lacking:
            del told[lacking[self.fault]]
        if self.fault == "nan d" and late:
            told["d"] = told["d"] * np.nan
        if self.fault == "d is a number":
            told["d"] = 1.0
        if self.fault == "lengths" and late:
            told["d_dot"] = np.zeros(3)
        return told


class Free(Line):
    """Without distances, which only an energy function needs."""

    def _told(self) -> dict[str, Any]:
        return {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        self.x += 0.05 * (float(np.ravel(action)[0]) - 2.0)
        return self._seen(), self.x, False, False, {"cost": float(self.x > 1.0)}


class Spaceless(gymnasium.Env):
    """Says neither what it shows nor what it takes."""


gymnasium.register(id="Line-v2", entry_point=Line, max_episode_steps=EPISODE)
gymnasium.register(id="Endless-v0", entry_point=Line)
gymnasium.register(id="Free-v0", entry_point=Free, max_episode_steps=EPISODE)
gymnasium.register(id="Spaceless-v0", entry_point=Spaceless, max_episode_steps=EPISODE)
gymnasium.register(id="Batched-v0", vector_entry_point=ToyEnvs, max_episode_steps=40)
