"""What a drawing needs of one navigation world; neither a simulator nor compiled code."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from envs.layout import sample_layout
from envs.tasks import NavigationTask

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """Positions in m, angles in rad, world frame."""

    task: NavigationTask
    robot: Array  # [3] x, y, heading
    goal: Array  # [2]
    obstacles: Array  # [M, 2]
    box: Array | None  # [3] x, y, yaw
    vase: Array | None  # [3] x, y, yaw


def first_scene(task: NavigationTask, seed: int) -> Scene:
    """The scene at the start of an episode whose world was given this seed."""
    layout = sample_layout(task, seeding.np_random(seed)[0])
    return Scene(
        task=task,
        robot=layout.robot,
        goal=layout.goal,
        obstacles=layout.obstacles,
        box=layout.box if task.has_box else None,
        vase=layout.box if task.has_vase else None,
    )
