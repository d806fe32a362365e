"""The navigation tasks as Gymnasium environments.

Both classes are shells around `NavigationBatch`: `NavigationEnv` is a batch of one world, and
`NavigationVectorEnv` adds autoreset, so a batch of N equals N scalar environments bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from envs.contract import (
    BatchEnvironment,
    ScalarEnvironment,
    checked_limit,
    checked_render_mode,
)
from envs.navigation_batch import NavigationBatch
from envs.rendering import FrameRenderer
from envs.scene import Scene
from envs.tasks import REGISTERED_TASKS, NavigationTask

Array = NDArray[np.float64]

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 50}


def find_task(
    name: str, settings: Mapping[str, Any], max_episode_steps: int | None = None
) -> NavigationTask:
    """The task of this name with some settings changed. Raises ValueError for unknown ones."""
    if name not in REGISTERED_TASKS:
        raise ValueError(f"unknown task {name!r}; tasks: {', '.join(REGISTERED_TASKS)}")
    task = REGISTERED_TASKS[name]
    limit = checked_limit(name, max_episode_steps, task.max_episode_steps)
    return task.with_settings(**settings, max_episode_steps=limit)


def _spaces(task: NavigationTask) -> tuple[Any, Any]:
    """Space of one flat observation (lidars in [0, 1], magnetometer in [-0.5, 0.5]), and action."""
    layout = task.observation_layout
    high = np.full(max(block.stop for block in layout.values()), np.inf)
    low = -high
    for name, block in layout.items():
        if name.endswith("_lidar"):
            low[block], high[block] = 0.0, 1.0
    high[layout["magnetometer"]] = 0.5
    low[layout["magnetometer"]] = -0.5
    return Box(low, high, dtype=np.float64), Box(-1.0, 1.0, (2,), np.float32)


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
    def decodable_lidars(self) -> tuple[str, ...]:
        """Lidars that say exactly where the one object is that they see."""
        return self.task.decodable_lidars

    @property
    def setting_names(self) -> list[str]:
        """The keyword arguments that change the task."""
        return self.task.setting_names

    @property
    def task_version(self) -> int:
        return self.task.version


class NavigationEnv(_TaskAttributes, ScalarEnvironment):
    """One navigation world. `settings` change fields of the task (sleep, obstacle_size, ...).

    info, at reset and at each step: cost, cost_indicator, cost_contact, reward_approach,
    reward_push, reward_goal (floats); goal_met, diverged (bools); d, d_dot (float64 [M]).
    """

    metadata = METADATA

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **settings: Any,
    ) -> None:
        self.task = find_task(task, settings, max_episode_steps)
        self._name = task
        self.render_mode = checked_render_mode(task, render_mode)
        self.observation_space, self.action_space = _spaces(self.task)
        self._simulation = self._batch = NavigationBatch(self.task, 1)
        self._renderer = FrameRenderer()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode. There are no options; an unknown one or a bad seed is a ValueError."""
        self._begin(seed, options)
        self._batch.reset([0])
        self._placed = self._running = True
        observation = self._batch.observe()[0]
        return observation, self._scalar_info(self._batch.reset_info())

    def step(self, action: NDArray[np.float32]) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Raises ValueError for a bad action and ResetNeeded after the end of an episode."""
        if not self._running:
            raise self._refusal()
        reward, terminated, truncated, info = self._batch.step(np.asarray(action)[None])
        self._running = not (terminated[0] or truncated[0])
        observation = self._batch.observe()[0]
        scalars = self._scalar_info(info)
        return observation, float(reward[0]), bool(terminated[0]), bool(truncated[0]), scalars

    def _frame(self) -> NDArray[np.uint8]:
        """[480, 480, 3]. Raises RuntimeError where OpenGL is not available."""
        return self._renderer.frame(self._batch.worlds, 0)

    def close(self) -> None:
        super().close()
        self._renderer.close()

    def scene(self) -> Scene:
        """What `envs.drawing.draw_scene` draws."""
        return self._batch.scene(0)

    def _scalar_info(self, info: Mapping[str, NDArray]) -> dict[str, Any]:
        scalars = {name: values[0].item() for name, values in info.items()}
        return scalars | {
            "d": self._batch.worlds.d[0].copy(),
            "d_dot": self._batch.worlds.d_dot[0].copy(),
        }


class NavigationVectorEnv(_TaskAttributes, BatchEnvironment):
    """N navigation worlds with SAME_STEP autoreset.

    `infos` has the keys of `NavigationEnv` as arrays [N] and [N, M], each with Gymnasium's mask
    `_key`. Where an episode ended, d and d_dot belong to the new episode's first state, the other
    keys to the step that ended it; `final_obs` [N, obs] and `final_info` hold the old episode's
    last state, valid where `_final_obs` [N] is true.
    """

    metadata = METADATA | BatchEnvironment.metadata

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        **settings: Any,
    ) -> None:
        self.task = find_task(task, settings, max_episode_steps)
        self._name = task
        self.render_mode = checked_render_mode(task, render_mode)
        self._set_spaces(num_envs, _spaces(self.task))
        self._simulation = self._batch = NavigationBatch(self.task, num_envs)
        self._renderer = FrameRenderer()
        self._masks = self._masks_everywhere()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._masks = self._masks_everywhere()  # copied arrays could be written to

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Start N new episodes. seed: an integer seeds world i with seed + i, a sequence gives one
        seed a world (None keeps that world's generator).

        options: {"reset_mask": bool [N]} starts anew, and seeds, only the worlds where it is true;
        the masks `_key` of infos are then that mask, while observations and d are of all worlds.
        """
        mask, _ = self._begin(seed, options)
        self._batch.reset(np.flatnonzero(mask).tolist())
        self._started = True
        infos = self._infos(self._batch.reset_info())
        return self._batch.observe(), infos | {name: mask.copy() for name in self._masks}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Raises ValueError for a bad action, naming the environment."""
        if not self._started:
            raise self._refusal()
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

    def _frame(self, index: int) -> NDArray[np.uint8]:
        """[480, 480, 3]. Raises RuntimeError where OpenGL is not available."""
        return self._renderer.frame(self._batch.worlds, index)

    def close_extras(self, **kwargs: Any) -> None:
        super().close_extras(**kwargs)
        if hasattr(self, "_renderer"):  # Gymnasium closes what failed to be constructed, too
            self._renderer.close()

    def scene(self, index: int) -> Scene:
        """What `envs.drawing.draw_scene` draws of world `index`."""
        return self._batch.scene(index)

    def _infos(self, info: Mapping[str, NDArray]) -> dict[str, Any]:
        worlds = self._batch.worlds
        return {**info, "d": worlds.d.copy(), "d_dot": worlds.d_dot.copy()}

    def _masks_everywhere(self) -> dict[str, NDArray[np.bool_]]:
        everywhere = np.ones(self.num_envs, np.bool_)
        everywhere.flags.writeable = False
        return {f"_{name}": everywhere for name in (*self._batch.reset_info(), "d", "d_dot")}
