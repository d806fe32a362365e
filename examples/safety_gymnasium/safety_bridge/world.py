"""One of Safety-Gymnasium's worlds as an environment of today's Gymnasium: `gymnasium.make`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

from safety_bridge.batch import Floats, SafetyBatch


class SafetyWorld(gymnasium.Env[Floats, Floats]):
    """A batch of one without its autoreset; `info` has cost, goal_met, and d and d_dot [M].

    For wrappers and libraries that step one environment, a `safemr.SafetyFilter` among them; a
    batch takes one message a step however many worlds it has. ``d_min`` is its attribute.

    Raises:
        UserError: as `SafetyBatch` does.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, name: str, max_episode_steps: int = 1000) -> None:
        self._batch = SafetyBatch(1, name, max_episode_steps)
        self.observation_space = self._batch.single_observation_space
        self.action_space = self._batch.single_action_space
        self.d_min = self._batch.d_min

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        super().reset(seed=seed)
        observations, infos = self._batch.reset(seed=None if seed is None else [seed])
        return observations[0], _first(infos)

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        observations, rewards, terminated, truncated, infos = self._batch.step(
            np.asarray(action)[None]
        )
        if terminated[0] or truncated[0]:  # the batch shows the next episode's start already
            observations, infos = infos["final_obs"], infos["final_info"]
        state = float(rewards[0]), bool(terminated[0]), bool(truncated[0])
        return observations[0], *state, _first(infos)

    def close(self) -> None:
        self._batch.close()


def _first(infos: Mapping[str, Any]) -> dict[str, Any]:
    """What is said of the one world, without the flags of a batch."""
    return {name: values[0] for name, values in infos.items() if not name.startswith("_")}
