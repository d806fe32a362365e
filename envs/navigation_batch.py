"""The behaviour of the navigation tasks: N worlds with rewards, costs, goals and observations.

The Gymnasium environments of envs/navigation.py, scalar and batched, are thin shells around it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from envs.contract import Independent
from envs.layout import sample_goal, sample_layout
from envs.navigation_kernels import SCORES, observation_blocks, observe, score, task_distances
from envs.navigation_physics import Worlds
from envs.scene import Scene
from envs.tasks import NavigationTask

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Info = dict[str, NDArray[Any]]


class NavigationBatch(Independent):
    """N worlds of one task without autoreset.

    generators: one `numpy.random.Generator` a world, all that a reset or a new goal depends on.
    step_limit: the steps of an episode, by default the task's.
    """

    def __init__(self, task: NavigationTask, num_worlds: int) -> None:
        self.task = task
        self.worlds = Worlds(task, num_worlds)
        self.generators = [seeding.np_random()[0] for _ in range(num_worlds)]
        self.steps = np.zeros(num_worlds, np.int64)
        self.step_limit = task.max_episode_steps
        self._distances = np.zeros((num_worlds, 2))
        self._hazard_size = 0.0 if task.solid_obstacles else task.obstacle_size
        layout = task.observation_layout
        self._blocks = observation_blocks(layout)
        self._width = max(block.stop for block in layout.values())

    def __len__(self) -> int:
        return len(self.worlds)

    def reset(self, indices: Iterable[int]) -> None:
        """Put these worlds into new layouts. Raises LayoutError if none can be found."""
        self.worlds.place({i: sample_layout(self.task, self.generators[i]) for i in indices})
        self.steps[list(indices)] = 0
        self._distances = self._measure()

    def step(self, actions: Any) -> tuple[Array, Flags, Flags, Info]:
        """Advance by one step: reward [N], terminated [N], truncated [N], info of [N] arrays.

        Reward, costs and goal_met refer to the goal before a possible resample; the observation,
        asked for separately with `observe`, to the goal after it. A world that diverged keeps its
        last valid state, pays -10 and is terminated; so is one without room for a new goal.
        Raises ValueError for a bad action.
        """
        diverged = self.worlds.step(self._checked(actions))
        distances = self._measure()
        scores = np.empty((len(SCORES), len(self)))
        goal_met = np.empty(len(self), np.bool_)
        score(
            self._distances,
            distances,
            self.task.has_box,
            self.task.goal_size,
            self._hazard_size,
            self.task.indicator_cost,
            self.worlds.d,
            self.worlds.contacts,
            diverged,
            scores,
            goal_met,
        )
        terminated = diverged
        if goal_met.any():
            terminated = diverged.copy()
            for index in np.flatnonzero(goal_met):
                terminated[index] = not self._resample_goal(int(index))
            distances = self._measure()
        self._distances = distances
        self.steps += 1
        truncated = self.steps >= self.step_limit
        info: Info = dict(zip(SCORES, scores, strict=True))
        info |= {"goal_met": goal_met, "diverged": diverged}
        return info.pop("reward"), terminated, truncated, info

    def observe(self) -> Array:
        """The observation [N, obs] of the present state and goal."""
        worlds = self.worlds
        observation = np.zeros((len(self), self._width))
        observe(
            worlds.pose,
            worlds.qpos,
            worlds.qvel,
            worlds.qacc,
            worlds.obstacles,
            worlds.goal,
            self._blocks,
            self.task.lidar_range,
            observation,
        )
        return observation

    def reset_info(self) -> Info:
        """The info of worlds that were just reset: no reward and no cost yet."""
        count = len(self)
        info: Info = {name: np.zeros(count) for name in SCORES[1:]}
        return info | {name: np.zeros(count, np.bool_) for name in ("goal_met", "diverged")}

    def scene(self, index: int) -> Scene:
        """A copy of what can be drawn of one world."""
        worlds = self.worlds
        free = None
        if self.task.has_free_body:
            x, y, _, w, i, j, k = worlds.qpos[index, 3:10]
            free = np.array([x, y, np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))])
        return Scene(
            task=self.task,
            robot=worlds.pose[index].copy(),
            goal=worlds.goal[index].copy(),
            obstacles=worlds.obstacles[index].copy(),
            box=free if self.task.has_box else None,
            vase=free if self.task.has_vase else None,
        )

    def get_state(self) -> dict[str, Any]:
        """A complete snapshot: arrays, integers and strings only."""
        generators = {str(i): g.bit_generator.state for i, g in enumerate(self.generators)}
        return {
            "worlds": self.worlds.get_state(),
            "steps": self.steps.copy(),
            "generators": generators,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a snapshot of an equal batch; it then continues bit for bit.

        Raises ValueError for a snapshot of another task or another number of worlds.
        """
        if "worlds" not in state:
            raise ValueError(f"{self.task.name}: this is no snapshot of a navigation task")
        self.worlds.set_state(state["worlds"])
        self.steps[:] = state["steps"]
        for index, generator in enumerate(self.generators):
            generator.bit_generator.state = state["generators"][str(index)]
        self._distances = self._measure()

    def _measure(self) -> Array:
        distances = np.empty((len(self), 2))
        worlds = self.worlds
        task_distances(worlds.pose, worlds.qpos, worlds.goal, self.task.has_box, distances)
        return distances

    def _checked(self, actions: Any) -> Array:
        array = np.asarray(actions)
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{self.task.name}: actions must be real numbers, got {array.dtype}")
        if array.shape != (len(self), 2):
            raise ValueError(
                f"{self.task.name}: actions must have shape {(len(self), 2)}, got {array.shape}"
            )
        return array.astype(np.float64)

    def _resample_goal(self, index: int) -> bool:
        task, worlds = self.task, self.worlds
        others = [(worlds.pose[index, :2], task.robot_keepout)]
        if task.has_free_body:
            others.append((worlds.qpos[index, 3:5], task.box_keepout))
        others += [(xy, task.obstacle_keepout) for xy in worlds.obstacles[index]]
        goal = sample_goal(task, self.generators[index], others)
        if goal is not None:
            worlds.move_goal(index, goal)
        return goal is not None
