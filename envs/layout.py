"""Random layouts: where robot, goal, box and obstacles start (Safety Gym's rejection scheme).

The distributions are those of Safety Gym; the draws come from a `numpy.random.Generator`, so they
depend on the seed alone, but single layouts differ from those of its legacy generator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.tasks import NavigationTask

DRAWS_PER_OBJECT = 100
LAYOUT_ATTEMPTS = 10_000
GOAL_DRAWS = 10_000

Array = NDArray[np.float64]
Disc = tuple[Array, float]  # centre [2] and keepout radius


class LayoutError(ValueError):
    """No layout satisfies the keepouts, or none was found."""


@dataclass(frozen=True)
class Layout:
    """Positions in m, world frame; yaw angles in rad."""

    robot: Array  # [3] x, y, yaw
    goal: Array  # [2]
    obstacles: Array  # [M, 2]
    obstacle_yaws: Array  # [M]
    box: Array | None  # [3] x, y, yaw of the box or the vase


def sample_layout(task: NavigationTask, rng: np.random.Generator) -> Layout:
    """A layout with at least the sum of two keepouts between any two objects.

    Objects are placed in the order robot, goal, box, obstacles, vase, each with up to 100 draws; if
    one finds no room, all start again. The goal is then drawn anew against the others, as Safety
    Gym does: that second goal is the one in force. Raises LayoutError after 10,000 attempts.
    """
    keepouts = [task.robot_keepout, task.goal_keepout]
    keepouts += [task.box_keepout] * task.has_box
    keepouts += [task.obstacle_keepout] * task.num_obstacles
    keepouts += [task.box_keepout] * task.has_vase
    for _ in range(LAYOUT_ATTEMPTS):
        placed: list[Disc] = []
        for keepout in keepouts:
            xy = _draw(task, rng, keepout, placed, DRAWS_PER_OBJECT)
            if xy is None:
                break
            placed.append((xy, keepout))
        else:
            break
    else:
        raise LayoutError(_impossible(task, f"no layout was found in {LAYOUT_ATTEMPTS} attempts"))
    positions = [xy for xy, _ in placed]
    yaws = rng.uniform(0.0, 2 * np.pi, len(placed))
    goal = sample_goal(task, rng, placed[:1] + placed[2:])
    if goal is None:
        raise LayoutError(_impossible(task, f"no goal was found in {GOAL_DRAWS} draws"))
    first, free = 2 + task.has_box, 2 if task.has_box else -1
    obstacles = slice(first, first + task.num_obstacles)
    return Layout(
        robot=np.append(positions[0], yaws[0]),
        goal=goal,
        obstacles=np.array(positions[obstacles]),
        obstacle_yaws=yaws[obstacles],
        box=np.append(positions[free], yaws[free]) if task.has_free_body else None,
    )


def sample_goal(
    task: NavigationTask, rng: np.random.Generator, others: Sequence[Disc]
) -> Array | None:
    """A goal position [2] clear of the other objects, or None after 10,000 draws."""
    for _ in range(GOAL_DRAWS // DRAWS_PER_OBJECT):
        goal = _draw(task, rng, task.goal_keepout, others, DRAWS_PER_OBJECT)
        if goal is not None:
            return goal
    return None


def _draw(
    task: NavigationTask,
    rng: np.random.Generator,
    keepout: float,
    others: Sequence[Disc],
    draws: int,
) -> Array | None:
    """The first of `draws` uniform points that is clear of the others, or None."""
    limit = task.extent - keepout
    points = rng.uniform(-limit, limit, (draws, 2))
    if not others:
        return points[0]
    centres = np.array([xy for xy, _ in others])
    spacings = np.array([other + keepout for _, other in others])
    gaps = points[:, None, :] - centres
    clear = (np.hypot(gaps[..., 0], gaps[..., 1]) >= spacings).all(axis=1)
    first = int(clear.argmax())
    return points[first] if clear[first] else None


def _impossible(task: NavigationTask, what: str) -> str:
    return (
        f"{task.name}: {what} for {task.num_obstacles} obstacles with keepout "
        f"{task.obstacle_keepout} m in a square of half-width {task.extent} m; use fewer "
        "obstacles, smaller keepouts or a larger extent"
    )
