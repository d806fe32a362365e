"""Scripted controllers: the reference lines that learned returns are read against.

They see the whole state (`envs.scene`), know nothing of costs, and are evaluated exactly like a
trained policy, so that they stand in the tables as ordinary entries. A learned return below
`BoxToucher`'s, for instance, has not involved pushing.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from safemr import paper
from safemr.certificates.point_robot import ROBOT
from safemr.experiment.planning import installed
from safemr.learning.evaluation import evaluate
from safemr.measure.store import Measurements
from safemr.tasks import Task, make_envs, name_of, traits

Array = NDArray[np.float64]

SCORE_COLUMNS = ["task", "variant", "seed", "metric", "value"]
CRUISE = 1.0  # m/s on the way
PUSH_SPEED = 0.5  # m/s while pushing; faster loses the box
TOUCH = 0.52  # m from the box's centre, where the nose all but meets its corner
BEHIND = 0.7  # m behind the box's centre, where a push is lined up


class VelocityController:
    """Drives the point robot at a wanted velocity; subclasses say which. `act` as a policy's.

    envs: the batched environment that is being acted in, for the state.
    """

    def __init__(self, envs: Any) -> None:
        self.envs = envs
        self._velocimeter = envs.observation_layout["velocimeter"]

    def wanted(self, scene: Any, velocity: Array) -> Array:
        """World velocity [2], m/s, that the robot should have in this scene."""
        raise NotImplementedError

    def act(self, observations: Array, deterministic: bool = True) -> NDArray[np.float32]:
        """Actions [N, 2] for the environment's present state; always deterministic."""
        actions = np.zeros((len(observations), 2), np.float32)
        for index, observation in enumerate(observations):
            scene = self.envs.scene(index)
            heading = scene.robot[2]
            forward = np.array([np.cos(heading), np.sin(heading)])
            left = np.array([-forward[1], forward[0]])
            speed, drift = observation[self._velocimeter][:2]
            velocity = speed * forward + drift * left
            wanted = self.wanted(scene, velocity)
            actions[index] = self._drive(wanted, velocity, forward, left, speed)
        return actions

    @staticmethod
    def _drive(
        wanted: Array, velocity: Array, forward: Array, left: Array, speed: float
    ) -> tuple[float, float]:
        # The wheels do not grip: aim a little against the drift across the wanted direction.
        length = float(np.hypot(*wanted))
        along = wanted / length if length > 0 else forward
        aim = wanted - 0.6 * (velocity - (velocity @ along) * along)
        error = float(np.arctan2(aim @ left, aim @ forward)) if length > 0.02 else 0.0
        target = float(wanted @ forward)
        thrust = 8.0 * ROBOT.mass * (target - speed) + ROBOT.damping * target
        dead_zone = 0.1 * np.sign(error) if abs(error) > 0.03 else 0.0
        return (
            float(np.clip(thrust / ROBOT.gear, -ROBOT.force_limit, ROBOT.force_limit)),
            float(np.clip(1.2 * error + dead_zone, -1.0, 1.0)),
        )


class GoalSeeker(VelocityController):
    """Goes straight to the goal, through everything."""

    def wanted(self, scene: Any, velocity: Array) -> Array:
        gap = scene.goal - scene.robot[:2]
        return ROBOT.max_speed * gap / max(np.hypot(*gap), 1e-9)


class BoxToucher(VelocityController):
    """Walks to the box and stays there without ever pushing it."""

    def wanted(self, scene: Any, velocity: Array) -> Array:
        gap = scene.box[:2] - scene.robot[:2]
        distance = float(np.hypot(*gap))
        return min(CRUISE, 1.5 * max(distance - TOUCH, 0.0)) * gap / max(distance, 1e-9)


class Pusher(VelocityController):
    """Walks around the box, lines up behind it and pushes it to the goal; ignores the hazard."""

    def wanted(self, scene: Any, velocity: Array) -> Array:
        box, robot = scene.box[:2], scene.robot[:2]
        axis = scene.goal - box
        axis = axis / max(np.hypot(*axis), 1e-9)
        normal = np.array([-axis[1], axis[0]])
        behind, aside = float((box - robot) @ axis), float((robot - box) @ normal)
        lined_up = abs(aside) < 0.1 and abs(velocity @ normal) < 0.2
        if behind > 0.3 and (lined_up or (behind < BEHIND and abs(aside) < 0.16)):
            return PUSH_SPEED * axis - 1.5 * aside * normal
        side = np.sign(aside) or 1.0
        if behind > BEHIND - 0.1:
            waypoint = box - axis * BEHIND
        elif abs(aside) < 0.5:  # in the box's way: step aside, and back if it is behind already
            waypoint = robot + side * 0.5 * normal - (behind > 0.0) * 0.5 * axis
        else:
            waypoint = box + side * 0.65 * normal - (BEHIND + 0.1) * axis
        gap = waypoint - robot
        distance = float(np.hypot(*gap))
        return min(CRUISE, 1.5 * max(distance - 0.03, 0.0)) * gap / max(distance, 1e-9)


Controllers = Mapping[str, Callable[[Any], VelocityController]]

TO_THE_GOAL: Controllers = {"scripted: ignores obstacles": GoalSeeker}
WITH_THE_BOX: Controllers = {
    "scripted: touches the box": BoxToucher, "scripted: pushes the box": Pusher
}  # fmt: skip


def controllers_of(envs: Any) -> Controllers:
    """Those that can act in these environments; none without the point robot."""
    has = traits(envs)
    if not has.point_robot:
        return {}
    return WITH_THE_BOX if has.pushes_box else TO_THE_GOAL


def controller_scores(
    tasks: Sequence[Task] = paper.TASKS,
    *,
    seeds: Sequence[int] = (0, 1, 2, 3, 4),
    episodes: int = 20,
) -> pd.DataFrame:
    """Score table (task, variant, seed, metric, value) of the controllers that fit each task.

    A seed is one evaluation of `episodes` layouts of its own. Tasks without the point robot give
    no rows.
    """
    rows = []
    for task in tasks:
        envs = make_envs(task, episodes)
        for name, controller in controllers_of(envs).items():
            for seed in seeds:
                # Layouts apart from those of the runs' evaluations, and of each other.
                scores = evaluate(controller(envs), envs, 1_000_000 + seed * episodes)
                rows += [
                    (name_of(task), name, seed, f"eval_{key}", value)
                    for key, value in scores.items()
                ]
        envs.close()
    return pd.DataFrame(rows, columns=SCORE_COLUMNS)


def measured_scores(
    measurements: Measurements,
    tasks: Sequence[Task],
    *,
    seeds: int,
    episodes: int,
) -> pd.DataFrame:
    """`controller_scores` for seeds 0 to ``seeds`` - 1, kept task by task."""
    rows: list[dict[str, Any]] = []
    for task in tasks:
        inputs = {"task": installed(task), "seeds": seeds, "episodes": episodes}

        def measure(task: Task = task) -> Any:
            scores = controller_scores((task,), seeds=range(seeds), episodes=episodes)
            return scores.to_dict("records")

        rows += measurements.rows("controllers", name_of(task), inputs, measure)
    return pd.DataFrame(rows, columns=SCORE_COLUMNS)


def main(arguments: Sequence[str] | None = None) -> int:
    """`safemr controllers --out scores.csv [--task ...] [--episodes N] [--seeds N]`."""
    parser = argparse.ArgumentParser(prog="safemr controllers", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="CSV to write")
    parser.add_argument("--task", action="append", help="default: the paper's four")
    parser.add_argument("--episodes", type=int, default=20, help="a seed")
    parser.add_argument("--seeds", type=int, default=5, help="how many evaluations")
    options = parser.parse_args(arguments)
    scores = controller_scores(
        options.task or paper.TASKS, seeds=range(options.seeds), episodes=options.episodes
    )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    scores.to_csv(options.out, index=False, lineterminator="\n")
    return 0
