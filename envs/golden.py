"""Replay of recorded Safety Gym trajectories: the physics and formulas, one step at a time.

    safemr golden FILE.npz ... [--tolerance 1e-9] [--sleep]

Before each step the recorded state (positions, velocities, the solver's warm start) and goal are
restored, so that errors do not accumulate: the robot's yaw servo makes free runs chaotic. Printed
is, per file, the largest error of each quantity and the number of steps where goal_met differs.
The exit status is 1 where a tolerance is passed or goal_met differs, 2 for an unusable file.
"""

from __future__ import annotations

import argparse
import json
import sys
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.layout import Layout
from envs.navigation_batch import NavigationBatch
from envs.tasks import NAVIGATION_TASKS, NavigationTask

TOLERANCE = 1e-9
ERRORS = (
    "state",
    "observation",
    "accelerometer",
    "reward",
    "cost",
    "cost_indicator",
    "cost_contact",
    "d",
    "d_dot",
)

Recording = Mapping[str, NDArray[Any]]


class GoldenFileError(ValueError):
    """A file that does not hold a complete recording."""


def load(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays of a recording. Raises GoldenFileError for a missing or damaged file."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise GoldenFileError(f"{path}: no such file") from None
    except (OSError, EOFError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise GoldenFileError(
            f"{path}: truncated or not an .npz file ({error}); copy it again"
        ) from None


def replay(recording: Recording, sleep: bool = False) -> dict[str, float]:
    """Largest absolute error of each of ERRORS, and `goal_met`, the number of mismatches.

    `state` covers positions, velocities and the warm start. The recorded `cost_indicator` is that
    of any contact. Raises KeyError if an array is missing.
    """
    config = json.loads(str(recording["config_json"]))
    batch = NavigationBatch(_task(config, sleep), 1)
    batch.worlds.place({0: _layout(recording, config)})
    state = batch.get_state()
    previous = {"qpos": "qpos0", "qvel": "qvel0", "warmstart": "warmstart0"}
    errors = dict.fromkeys((*ERRORS, "goal_met"), 0.0)
    _restore(batch, state, {name: recording[key] for name, key in previous.items()})
    _compare(errors, batch, recording["obs0"], recording["sis0"])
    goal = recording["goal_reset"]
    for step, action in enumerate(recording["action"]):
        state["worlds"]["goal"][0] = goal[:2]
        before = {
            name: recording[name][step - 1] if step else recording[key]
            for name, key in previous.items()
        }
        _restore(batch, state, before)
        reward, _, _, info = batch.step(action[None])
        goal = recording["goal_pos"][step]
        batch.worlds.move_goal(0, goal[:2])
        after = batch.worlds.get_state()
        for name in previous:
            _note(errors, "state", after[name][0], recording[name][step])
        _compare(errors, batch, recording["obs"][step], recording["sis"][step])
        _note(errors, "reward", reward[0], recording["reward"][step])
        solid = batch.task.solid_obstacles
        _note(errors, "cost", info["cost"][0], recording["cost_authors"][step])
        any_contact = info["cost_contact" if solid else "cost"][0]
        _note(errors, "cost_contact", any_contact, recording["cost_original"][step])
        _note(errors, "cost_indicator", any_contact > 0, recording["cost_indicator"][step])
        errors["goal_met"] += bool(info["goal_met"][0]) != bool(recording["goal_met"][step])
    return errors


def passes(errors: Mapping[str, float], tolerance: float = TOLERANCE) -> bool:
    """Whether every error is within the tolerance (NaN is not) and no goal_met differs."""
    return errors["goal_met"] == 0 and all(errors[name] <= tolerance for name in ERRORS)


def _compare(
    errors: dict[str, float], batch: NavigationBatch, observation: NDArray, distances: NDArray
) -> None:
    own = batch.observe()[0]
    _note(errors, "observation", own, observation)
    block = batch.task.observation_layout["accelerometer"]
    _note(errors, "accelerometer", own[block], observation[block])
    _note(errors, "d", batch.worlds.d[0], distances[:, 0])
    _note(errors, "d_dot", batch.worlds.d_dot[0], distances[:, 1])


def _note(errors: dict[str, float], name: str, own: Any, recorded: Any) -> None:
    difference = np.abs(np.asarray(own, float) - np.asarray(recorded, float)).max()
    errors[name] = float(np.maximum(errors[name], difference))  # keeps a NaN


def _restore(batch: NavigationBatch, state: dict[str, Any], before: Mapping[str, NDArray]) -> None:
    for name, value in before.items():
        state["worlds"][name][0] = value
    batch.set_state(state)


def _task(config: Mapping[str, Any], sleep: bool) -> NavigationTask:
    family, kind = {
        "goal": ("pillars_goal", "pillars"),
        "push": ("hazards_push", "hazards"),
    }[config["task"]]
    base = next(task for task in NAVIGATION_TASKS.values() if task.family == family)
    return base.with_settings(
        obstacle_size=config[f"{kind}_size"],
        num_obstacles=config[f"{kind}_num"],
        max_episode_steps=config["num_steps"],
        sleep=sleep,
    )


def _layout(recording: Recording, config: Mapping[str, Any]) -> Layout:
    objects = json.loads(str(recording["layout_json"]))
    kind = "pillar" if config["task"] == "goal" else "hazard"
    yaws = [objects[f"{kind}{j}"]["rot"] for j in range(len(recording["obst_pos"]))]
    return Layout(
        robot=np.append(recording["robot_xy0"], recording["robot_rot0"]),
        goal=recording["goal_reset"][:2],
        obstacles=recording["obst_pos"][:, :2],
        obstacle_yaws=np.array(yaws),
        box=np.zeros(3) if "box" in objects else None,  # its pose is part of the recorded state
    )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="safemr golden",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE.npz")
    parser.add_argument("--tolerance", type=float, default=TOLERANCE)
    parser.add_argument("--sleep", action="store_true", help="replay with MuJoCo's sleep flag on")
    options = parser.parse_args(arguments)
    width = max(len(path.name) for path in options.files)
    print(" ".join([f"{'file':{width}}", *(f"{name:>14}" for name in ERRORS), "goal_met"]))
    status = 0
    for path in options.files:
        try:
            recording = load(path)
            if any(name.endswith("_layout_tries") for name in recording):
                print(f"{path.name:{width}} holds layouts, no trajectory: see tests/test_layout.py")
                continue
            errors = replay(recording, options.sleep)
        except GoldenFileError as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        except KeyError as error:
            print(f"error: {path}: not a complete recording, {error} is missing", file=sys.stderr)
            return 2
        cells = [f"{errors[name]:14.1e}" for name in ERRORS]
        print(" ".join([f"{path.name:{width}}", *cells, f"{errors['goal_met']:8.0f}"]))
        if not passes(errors, options.tolerance):
            status = 1
    print("passed" if status == 0 else f"FAILED: an error above {options.tolerance:g}")
    return status
