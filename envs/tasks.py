"""The navigation tasks: one frozen dataclass each, and nothing about them anywhere else.

The four of the paper are Safety Gym configurations of the point robot as the JointSIS code base
uses them (`Safexp-CustomGoalPillar2-v0`, `Safexp-CustomPush1-v0`); the 0.30 tasks change the
obstacle size only. `PointGoal1` is Safety Gym's own `Safexp-PointGoal1-v0`, for comparing the
baselines with published results and nothing else. See docs/environments.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

ROBOT_RADIUS = 0.1  # m, the sphere of assets/point.xml
LIDAR_BINS = 16
# `vases_lidar` is Safety Gym's lidar of vases that are not there, always zero.
LIDARS = {
    "pillars_goal": ("goal", "pillars"),
    "hazards_push": ("goal", "box", "hazards", "vases"),
    "hazards_goal": ("goal", "hazards", "vase"),
}


@dataclass(frozen=True)
class NavigationTask:
    """A point robot that reaches a goal, or pushes a box there, among circular obstacles.

    Lengths in metres. `pillars_goal`: solid pillars, reach the goal. `hazards_push`: flat zones
    that can be crossed, push the box to the goal. `hazards_goal`: flat zones and a light vase that
    stands in the way, reach the goal. Raises ValueError for values out of range.
    """

    name: str
    family: Literal["pillars_goal", "hazards_push", "hazards_goal"]  # names the MJCF file, too
    obstacle_size: float  # radius
    num_obstacles: int
    obstacle_keepout: float = 0.4  # keepouts: two objects start at least their sum apart
    robot_keepout: float = 0.4
    goal_keepout: float = 0.4
    box_keepout: float = 0.2  # of the box or the vase
    goal_size: float = 0.3  # the goal is met at this distance
    extent: float = 2.0  # objects start in the square [-extent, extent]^2
    max_episode_steps: int = 1000
    sleep: bool = False  # MuJoCo's sleep flag: a resting box costs nothing
    version: int = 1  # bumped when the behaviour of the task changes

    def __post_init__(self) -> None:
        for name in ("obstacle_size", "goal_size", "extent"):
            if not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"{self.name}: {name} must be positive, got {getattr(self, name)}")
        for name in ("obstacle_keepout", "robot_keepout", "goal_keepout", "box_keepout"):
            if not 0 <= getattr(self, name) < self.extent:
                raise ValueError(
                    f"{self.name}: {name} must be in [0, extent = {self.extent}), "
                    f"got {getattr(self, name)}"
                )
        for name in ("num_obstacles", "max_episode_steps"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{self.name}: {name} must be a positive integer, got {value!r}")
        if not isinstance(self.sleep, bool):
            raise ValueError(f"{self.name}: sleep must be true or false, got {self.sleep!r}")

    @property
    def has_box(self) -> bool:
        return self.family == "hazards_push"

    @property
    def has_vase(self) -> bool:
        return self.family == "hazards_goal"

    @property
    def has_free_body(self) -> bool:
        """Whether there is a box or a vase: a body that moves when it is pushed."""
        return self.has_box or self.has_vase

    @property
    def solid_obstacles(self) -> bool:
        return self.family == "pillars_goal"

    @property
    def indicator_cost(self) -> bool:
        """Whether `cost` is 1 a violating step (Safety Gym's default) instead of the depth."""
        return self.family == "hazards_goal"

    @property
    def lidar_range(self) -> float:
        """The pseudo lidar's reading falls linearly to 0 at this distance; inf: exponentially."""
        return 3.0 if self.family == "hazards_goal" else math.inf

    @property
    def decodable_lidars(self) -> tuple[str, ...]:
        """Lidars whose readings hold the exact bearing and distance of the one object they see."""
        if self.lidar_range < math.inf:  # the linear one sees nothing beyond its range
            return ()
        single = {"goal", "box", *(("pillars", "hazards") if self.num_obstacles == 1 else ())}
        return tuple(f"{name}_lidar" for name in LIDARS[self.family] if name in single)

    @property
    def d_min(self) -> float:
        """Distance robot centre to obstacle centre at which a violation begins.

        Hazards: their radius. Pillars: radius + robot radius, where the sphere touches (the
        authors' size + robot_keepout - 0.3 with their robot_keepout of 0.4).
        """
        return self.obstacle_size + (ROBOT_RADIUS if self.solid_obstacles else 0.0)

    @property
    def observation_layout(self) -> dict[str, slice]:
        """Sensor block -> slice of the flat observation, blocks in alphabetical order."""
        sizes = {"accelerometer": 3, "gyro": 3, "magnetometer": 3, "velocimeter": 3}
        sizes |= {f"{name}_lidar": LIDAR_BINS for name in LIDARS[self.family]}
        layout, start = {}, 0
        for name in sorted(sizes):
            layout[name] = slice(start, start + sizes[name])
            start += sizes[name]
        return layout

    @property
    def setting_names(self) -> list[str]:
        """The fields that `with_settings` changes."""
        return sorted({f.name for f in fields(self)} - {"name", "family", "version"})

    def with_settings(self, **settings: Any) -> NavigationTask:
        """A copy with some fields changed. Raises ValueError naming an unknown setting."""
        unknown = sorted(set(settings) - set(self.setting_names))
        if unknown:
            raise ValueError(
                f"{self.name} has no setting {unknown[0]!r}; "
                f"settings: {', '.join(self.setting_names)}"
            )
        return replace(self, **settings)


def _pillars_goal(size: float) -> NavigationTask:
    return NavigationTask(f"Pillars-{size:.2f}-Goal", "pillars_goal", size, num_obstacles=4)


def _hazards_push(size: float) -> NavigationTask:
    return NavigationTask(f"Hazards-{size:.2f}-Push", "hazards_push", size, num_obstacles=1)


NAVIGATION_TASKS = {
    task.name: task
    for task in (_pillars_goal(0.15), _pillars_goal(0.30), _hazards_push(0.15), _hazards_push(0.30))
}

POINT_GOAL = NavigationTask(
    "PointGoal1",
    "hazards_goal",
    obstacle_size=0.2,
    num_obstacles=8,
    obstacle_keepout=0.18,
    goal_keepout=0.305,
    box_keepout=0.15,
    extent=1.5,
)

REGISTERED_TASKS = NAVIGATION_TASKS | {POINT_GOAL.name: POINT_GOAL}
