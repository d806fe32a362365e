"""The navigation tasks as Gymnasium environments.

Both classes are shells around `NavigationBatch`: `NavigationEnv` is a batch of one world, and
`NavigationVectorEnv` adds autoreset, so a batch of N equals N scalar environments bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from envs.navigation_batch import NavigationBatch, Scene
from envs.rendering import FrameRenderer
from envs.tasks import REGISTERED_TASKS, NavigationTask

Array = NDArray[np.float64]

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}


def find_task(name: str, settings: Mapping[str, Any]) -> NavigationTask:
    """The task of this name with some settings changed. Raises ValueError for unknown ones."""
    if name not in REGISTERED_TASKS:
        raise ValueError(f"unknown task {name!r}; tasks: {', '.join(REGISTERED_TASKS)}")
    return REGISTERED_TASKS[name].with_settings(**settings)


def observation_space(task: NavigationTask) -> Box:
    """The space of one flat observation: lidars in [0, 1], magnetometer in [-0.5, 0.5]."""
    layout = task.observation_layout
    high = np.full(max(block.stop for block in layout.values()), np.inf)
    low = -high
    for name, block in layout.items():
        if name.endswith("_lidar"):
            low[block], high[block] = 0.0, 1.0
    high[layout["magnetometer"]] = 0.5
    low[layout["magnetometer"]] = -0.5
    return Box(low, high, dtype=np.float64)


class _TaskAttributes:
    """What both environments say about their task."""

    task: NavigationTask

    @property
    def d_min(self) -> float:
        """Distance to an obstacle's centre at which a violation begins, m."""
        return self.task.d_min

    @property
    def num_obstacles(self) -> int:
        return self.task.num_obstacles

    @property
    def observation_layout(self) -> dict[str, slice]:
        """Sensor block -> slice of the observation, in order."""
        return self.task.observation_layout

    @property
    def max_episode_steps(self) -> int:
        return self.task.max_episode_steps

    @property
    def task_version(self) -> int:
        return self.task.version


class NavigationEnv(_TaskAttributes, gymnasium.Env[Array, NDArray[np.float32]]):
    """One navigation world. `settings` change fields of the task (sleep, max_episode_steps, ...).

    info, at reset and at each step: cost, cost_indicator, cost_contact, reward_approach,
    reward_push, reward_goal (floats); goal_met, diverged (bools); d, d_dot (float64 [M]).
    """

    metadata = METADATA

    def __init__(self, task: str, render_mode: str | None = None, **settings: Any) -> None:
        self.task = find_task(task, settings)
        self.render_mode = _checked_render_mode(render_mode)
        self.observation_space: gymnasium.Space[Any] = observation_space(self.task)
        self.action_space = Box(-1.0, 1.0, (2,), np.float32)
        self._batch = NavigationBatch(self.task, 1)
        self._renderer = FrameRenderer()
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        super().reset(seed=seed)
        self._batch.generators[0] = self.np_random
        self._batch.reset([0])
        self._running = True
        observation = self._batch.observe()[0]
        return observation, self._scalar_info(self._batch.reset_info())

    def step(self, action: NDArray[np.float32]) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Raises ValueError for a bad action and ResetNeeded after the end of an episode."""
        if not self._running:
            raise gymnasium.error.ResetNeeded(
                f"{self.task.name}: call reset() before the first step and after an episode's end"
            )
        reward, terminated, truncated, info = self._batch.step(np.asarray(action)[None])
        self._running = not (terminated[0] or truncated[0])
        observation = self._batch.observe()[0]
        scalars = self._scalar_info(info)
        return observation, float(reward[0]), bool(terminated[0]), bool(truncated[0]), scalars

    def render(self) -> NDArray[np.uint8] | None:
        """An RGB frame [480, 480, 3]. Raises RuntimeError where OpenGL is not available."""
        if self.render_mode is None:
            return None
        return self._renderer.frame(self._batch.worlds, 0)

    def close(self) -> None:
        self._renderer.close()

    def scene(self) -> Scene:
        """What `envs.drawing.draw_scene` draws."""
        return self._batch.scene(0)

    def get_state(self) -> dict[str, Any]:
        """A complete snapshot: arrays and plain numbers only."""
        return self._batch.get_state() | {"running": self._running}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a snapshot; the environment then continues bit for bit."""
        self._batch.set_state(state)
        self.np_random = self._batch.generators[0]
        self._running = bool(state["running"])

    def _scalar_info(self, info: Mapping[str, NDArray]) -> dict[str, Any]:
        scalars = {name: values[0].item() for name, values in info.items()}
        return scalars | {
            "d": self._batch.worlds.d[0].copy(),
            "d_dot": self._batch.worlds.d_dot[0].copy(),
        }


class NavigationVectorEnv(_TaskAttributes, VectorEnv[Array, NDArray[np.float32], Any]):
    """N navigation worlds with SAME_STEP autoreset.

    `infos` has the keys of `NavigationEnv` as arrays [N] and [N, M], each with Gymnasium's mask
    `_key`. Where an episode ended, d and d_dot belong to the new episode's first state, the other
    keys to the step that ended it; `final_obs` [N, obs] and `final_info` hold the old episode's
    last state, valid where `_final_obs` [N] is true.
    """

    metadata = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self, task: str, num_envs: int = 1, render_mode: str | None = None, **settings: Any
    ) -> None:
        self.task = find_task(task, settings)
        if num_envs < 1:
            raise ValueError(f"{task}: num_envs must be at least 1, got {num_envs}")
        self.num_envs = num_envs
        self.render_mode = _checked_render_mode(render_mode)
        self.single_observation_space = observation_space(self.task)
        self.single_action_space = Box(-1.0, 1.0, (2,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._batch = NavigationBatch(self.task, num_envs)
        self._renderer = FrameRenderer()
        everywhere = np.ones(num_envs, np.bool_)
        everywhere.flags.writeable = False
        self._masks = {f"_{name}": everywhere for name in (*self._batch.reset_info(), "d", "d_dot")}
        self._started = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Start N new episodes. seed: an integer seeds world i with seed + i, a sequence gives one
        seed a world (None keeps that world's generator)."""
        if isinstance(seed, (int, np.integer)):
            seeds: Sequence[int | None] = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(
                f"{self.task.name}: {len(seeds)} seeds for {self.num_envs} environments"
            )
        for index, one in enumerate(seeds):
            if one is not None:
                self._batch.generators[index] = seeding.np_random(one)[0]
        self._batch.reset(range(self.num_envs))
        self._started = True
        return self._batch.observe(), self._infos(self._batch.reset_info()) | self._masks

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Raises ValueError for a bad action, naming the environment."""
        if not self._started:
            raise gymnasium.error.ResetNeeded(
                f"{self.task.name}: call reset() before the first step"
            )
        reward, terminated, truncated, info = self._batch.step(actions)
        observation = self._batch.observe()
        infos = self._infos(info) | self._masks
        done = terminated | truncated
        if done.any():
            infos["final_obs"], infos["_final_obs"] = observation, done
            final_info = self._infos({name: values.copy() for name, values in info.items()})
            infos["final_info"] = final_info | {f"_{name}": done for name in final_info}
            infos["_final_info"] = done
            self._batch.reset(np.flatnonzero(done))
            observation = self._batch.observe()
            infos |= self._infos({})
        return observation, reward, terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """One RGB frame [480, 480, 3] a world."""
        if self.render_mode is None:
            return None
        return tuple(self._renderer.frame(self._batch.worlds, i) for i in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        self._renderer.close()

    def scene(self, index: int) -> Scene:
        """What `envs.drawing.draw_scene` draws of world `index`."""
        return self._batch.scene(index)

    def get_state(self) -> dict[str, Any]:
        """A complete snapshot: arrays and plain numbers only."""
        return self._batch.get_state() | {"running": self._started}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a snapshot of an equal environment; it then continues bit for bit."""
        self._batch.set_state(state)
        self._started = bool(state["running"])

    def _infos(self, info: Mapping[str, NDArray]) -> dict[str, Any]:
        worlds = self._batch.worlds
        return {**info, "d": worlds.d.copy(), "d_dot": worlds.d_dot.copy()}


def _checked_render_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
    return render_mode
