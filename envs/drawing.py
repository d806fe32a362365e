"""Top-down drawings of navigation scenes; they need matplotlib but no OpenGL."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from envs.scene import Scene
from envs.tasks import ROBOT_RADIUS

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

ROBOT_COLOR = "#d62728"
OBSTACLE_COLOR = "#1f4e9c"
GOAL_COLOR = "#2ca02c"
BOX_COLOR = "#cc9a1f"
NOSE = 0.15  # m, how far the arrow reaches ahead
BOX_HALF, COLUMN_OFFSET, COLUMN_HALF = 0.2, 0.2, 0.1  # m, as in assets/hazards_push.xml
VASE_HALF = 0.1  # m, as in assets/hazards_goal.xml
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def draw_scene(
    ax: Axes, scene: Scene, trajectory: NDArray[np.float64] | None = None, margin: float = 0.3
) -> Axes:
    """Draw robot with heading, goal, obstacles, box or vase and, if given, a trajectory [T, 2].

    The dotted circles around pillars are d_min, which the robot's centre must not enter. Axes are
    in metres; the view is the square that layouts are drawn from, widened to the trajectory.
    """
    from matplotlib.patches import Circle, Polygon

    task = scene.task
    if trajectory is not None:
        path = np.asarray(trajectory)
        ax.plot(path[:, 0], path[:, 1], color=ROBOT_COLOR, lw=1.0, alpha=0.6, zorder=3)
    goal = Circle(
        _point(scene.goal), task.goal_size, fc=GOAL_COLOR, ec=GOAL_COLOR, alpha=0.45, zorder=1
    )
    ax.add_patch(goal)
    alpha = 1.0 if task.solid_obstacles else 0.5
    for xy in scene.obstacles:
        ax.add_patch(
            Circle(_point(xy), task.obstacle_size, fc=OBSTACLE_COLOR, alpha=alpha, zorder=2)
        )
        if task.d_min > task.obstacle_size:
            ax.add_patch(
                Circle(_point(xy), task.d_min, fill=False, ec=OBSTACLE_COLOR, ls=":", zorder=2)
            )
    outlines = [] if scene.box is None else _box_outlines(scene.box)
    if scene.vase is not None:
        outlines.append(_placed(VASE_HALF * SQUARE, scene.vase))
    for corners in outlines:
        ax.add_patch(Polygon(corners, closed=True, fc=BOX_COLOR, ec="none", zorder=4))
    position, heading = scene.robot[:2], scene.robot[2]
    ax.add_patch(Circle(_point(position), ROBOT_RADIUS, fc=ROBOT_COLOR, ec="none", zorder=5))
    nose = _rotated(np.array([[0.0, -0.05], [NOSE, -0.05], [NOSE, 0.05], [0.0, 0.05]]), heading)
    ax.add_patch(Polygon(nose + position, closed=True, fc=ROBOT_COLOR, ec="none", zorder=5))
    tip = _rotated(np.array([[2 * NOSE, 0.0]]), heading)[0] + position
    ax.plot(*zip(position, tip, strict=True), color="black", lw=1.0, zorder=6)
    shown = np.array([scene.robot[:2], scene.goal] if trajectory is None else [*path, scene.goal])
    lower = np.minimum(shown.min(axis=0), -task.extent) - margin
    upper = np.maximum(shown.max(axis=0), task.extent) + margin
    ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    return ax


def legend_of(scene: Scene) -> list[Artist]:
    """Entries of a legend for what `draw_scene` draws of a scene."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    task = scene.task
    dot: dict[str, Any] = {"marker": "o", "ls": "none"}
    solid = task.solid_obstacles
    entries: list[Artist] = [
        Line2D([], [], color="black", marker="o", mfc=ROBOT_COLOR, mec=ROBOT_COLOR, ms=5, lw=1.0,
               label="robot, heading"),
        Line2D([], [], **dot, color=GOAL_COLOR, alpha=0.45, ms=8, label="goal"),
        Line2D([], [], **dot, color=OBSTACLE_COLOR, alpha=1.0 if solid else 0.5, ms=6, mew=0,
               label="pillar (solid)" if solid else "hazard (flat)"),
    ]  # fmt: skip
    if task.d_min > task.obstacle_size:
        entries.append(
            Line2D([], [], color=OBSTACLE_COLOR, ls=":", label=r"$d_{\min}$ of the robot's centre")
        )
    if scene.box is not None or scene.vase is not None:
        name = "box" if scene.box is not None else "vase"
        entries.append(Patch(fc=BOX_COLOR, ec="none", label=name))
    return entries


def _box_outlines(box: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    parts = [BOX_HALF * SQUARE] + [COLUMN_HALF * SQUARE + COLUMN_OFFSET * c for c in SQUARE]
    return [_placed(part, box) for part in parts]


def _placed(points: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    return _rotated(points, pose[2]) + pose[:2]


def _point(xy: NDArray[np.float64]) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])


def _rotated(points: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    # In double precision whatever the pose has: single sines differ between processors by enough
    # to change a printed coordinate.
    c, s = np.cos(np.float64(angle)), np.sin(np.float64(angle))
    return points @ np.array([[c, s], [-s, c]])
