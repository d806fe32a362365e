"""What an environment from outside has and lacks, found by making it and playing a little.

`examined` is asked once for a task and a process; the same answers make the batches of a run
(`safemr.foreign`) and the lines of ``safemr check``.
"""

from __future__ import annotations

import functools
import importlib
import json
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, parse_env_id
from gymnasium.vector import AutoresetMode

from safemr.environments import bounded
from safemr.errors import UserError, show

PLAYED = 50  # steps of random actions, in which what is missing is noticed
# Whose lines are not where an environment's fault is.
CALLERS = tuple(
    str(Path(path).resolve().parent) for path in (__file__, gymnasium.__file__, np.__file__)
)
INTERFACE = (
    "Gymnasium calls reset(seed=, options=) for (observation, info) and step(action) for "
    "(observation, reward, terminated, truncated, info)"
)


@dataclass
class Found:
    """What there is of a `safemr.environments.SafetyEnvs`, and what is to be done.

    ``num_obstacles`` is 0 where d and d_dot are not reported. ``facts`` are pairs for a person to
    read; ``problems`` lines with what is missing and the remedy; ``lacks`` the same of what only
    algorithms with an energy function need.
    """

    mode: str = "sync"
    version: int = 0
    d_min: float = 1.0
    num_obstacles: int = 0
    max_episode_steps: int = 0
    facts: list[tuple[str, str]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    lacks: list[str] = field(default_factory=list)


def examined(task: Mapping[str, Any]) -> Found:
    """What the environment of a task with an ``id`` has.

    Raises:
        UserError: it cannot be found, made or played at all.
    """
    asked = {name: value for name, value in task.items() if name not in ("name", "version")}
    return _examined(str(task["name"]), json.dumps(asked, sort_keys=True))


def first_line(error: BaseException) -> str:
    """An exception in one line."""
    text = str(error).partition("\n")[0]
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def failure(error: BaseException) -> str:
    """An exception of an environment in one line, with the place in its source where it has one."""
    lines = traceback.extract_tb(error.__traceback__)
    own = [line for line in lines if not line.filename.startswith(CALLERS)]
    place = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    return first_line(error) + place


def spec_of(identity: str, label: str) -> EnvSpec:
    """The registration of an id, whose module is imported.

    Raises:
        UserError: naming the id and whether its module or its registration is missing.
    """
    module, colon, name = identity.rpartition(":")
    if colon:
        try:
            importlib.import_module(module)
        except Exception as error:  # whatever is wrong with it, its author wants to know
            missing = error.name if isinstance(error, ModuleNotFoundError) else None
            if missing and (module == missing or module.startswith(f"{missing}.")):
                raise UserError(
                    f"{label}: there is no package {missing}; install it, or put the folder "
                    "that it lies in into PYTHONPATH"
                ) from error
            raise UserError(f"{label}: {module} does not import: {first_line(error)}") from error
    try:
        return gymnasium.spec(name)
    except gymnasium.error.Error as error:
        where = f"{module} registers no {name}" if colon else f"Gymnasium knows no {name}"
        raise UserError(
            f"{label}: {where} ({first_line(error)}); write package:Name-v0 and let the package "
            "call gymnasium.register when it is imported"
        ) from error


@functools.cache
def _examined(name: str, asked: str) -> Found:
    task, label = json.loads(asked), f"task {name}"
    spec, found = spec_of(task["id"], label), Found()
    world = _made(task, spec, found, label)
    found.version = _version(spec, world)
    try:
        for space in ("action_space", "observation_space"):
            if not isinstance(_attribute(world, space), gymnasium.Space):
                raise UserError(f"{label}: it has no {space}; make it one of gymnasium.spaces")
        _spaces(world, found)
        _limit(world, task, found)
        _play(world, task, found, label)
    finally:
        world.close()
    return found


class FirstOfMany:
    """The first world of a vector environment, looked at like a scalar one."""

    def __init__(self, envs: Any) -> None:
        self.envs = envs
        self.observation_space = envs.single_observation_space
        self.action_space = envs.single_action_space
        self.spec = envs.spec

    def get_wrapper_attr(self, name: str) -> Any:
        return getattr(self.envs, name)

    def reset(self, seed: int | None = None) -> tuple[Any, dict[str, Any]]:
        observations, infos = self.envs.reset(seed=seed)
        return observations[0], self._first(infos)

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        observations, rewards, ends, cuts, infos = self.envs.step(np.array([action, action]))
        done = bool(ends[0] or cuts[0])
        told = self._first(infos.get("final_info", {}) if done else infos)
        return observations[0], rewards[0], ends[0], cuts[0], told

    @staticmethod
    def _first(infos: Mapping[str, Any]) -> dict[str, Any]:
        arrays = {name: value for name, value in infos.items() if np.ndim(value) > 0}
        return {name: value[0] for name, value in arrays.items() if not name.startswith("_")}

    def close(self) -> None:
        self.envs.close()


def _made(task: Mapping[str, Any], spec: EnvSpec, found: Found, label: str) -> Any:
    """One environment, or the first of a batch where batches are the environment's own."""
    settings, asked = dict(task.get("settings", {})), task.get("vectorization")
    own = spec.vector_entry_point is not None
    if asked == "vector_entry_point" and not own:
        raise UserError(f"{label}: it has no vector entry point; leave vectorization out")
    reason = ""
    try:
        if own and asked in (None, "vector_entry_point"):
            envs = gymnasium.make_vec(
                task["id"], 2, vectorization_mode="vector_entry_point", **settings
            )
            restart = (envs.metadata or {}).get("autoreset_mode")
            plain = isinstance(envs.single_observation_space, gymnasium.spaces.Box)
            if restart == AutoresetMode.SAME_STEP and plain:
                found.mode = "vector_entry_point"
                found.facts.append(("batches", "its own (vector entry point)"))
                return FirstOfMany(envs)
            envs.close()
            reason = f"; its own restart by {show(restart)}" if plain else "; of its own no Box"
            if spec.entry_point is None or asked:
                raise UserError(
                    f"{label}: its vector environment restarts by {show(restart)} and observes "
                    f"{show(envs.single_observation_space)}; make them AutoresetMode.SAME_STEP "
                    "and a Box"
                )
        found.mode = asked or "sync"
        found.facts.append(("batches", f"Gymnasium's ({found.mode}){reason}"))
        return gymnasium.make(task["id"], disable_env_checker=True, **settings)
    except UserError:
        raise
    except Exception as error:  # the environment's own, whatever its type
        raise UserError(f"{label}: it cannot be made: {first_line(error)}") from error


def _attribute(world: Any, name: str) -> Any:
    try:
        return world.get_wrapper_attr(name)
    except AttributeError:
        return None


def _version(spec: EnvSpec, world: Any) -> int:
    """Its ``task_version``, or the one in its id: what changes numbers raises it."""
    said = _attribute(world, "task_version")
    return int(said if said is not None else parse_env_id(spec.id)[2] or 0)


def _spaces(world: Any, found: Found) -> None:
    space = world.action_space
    if not isinstance(space, gymnasium.spaces.Box) or space.dtype.kind != "f":
        found.problems.append(
            f"its actions are {show(space)}; the algorithms here act continuously: make "
            "action_space a Box of floats"
        )
    elif not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        found.problems.append(f"its actions {show(space)} have no bounds; give the Box finite ones")
    elif not (space.low < space.high).all():
        found.problems.append(f"its actions {show(space)} cannot move; make low less than high")
    else:
        found.facts.append(("actions", f"{space.low.size}, scaled from [-1, 1] to its bounds"))
    try:
        flat = gymnasium.spaces.flatten_space(world.observation_space)
    except NotImplementedError:
        flat = None
    if not isinstance(flat, gymnasium.spaces.Box):
        found.problems.append(
            f"its observations are {show(world.observation_space)}; make them a Box, or what "
            "gymnasium.spaces.flatten can make one of"
        )
        return
    columns = bounded(flat)
    found.facts.append(
        (
            "observations",
            f"{columns.size}: {columns.sum()} scaled by their bounds, {(~columns).sum()} by "
            "running statistics",
        )
    )


def _limit(world: Any, task: Mapping[str, Any], found: Found) -> None:
    said = (
        _attribute(world, "max_episode_steps"),
        task.get("settings", {}).get("max_episode_steps"),
        getattr(world.spec, "max_episode_steps", None),
    )
    limit = next((value for value in said if value is not None), None)
    if isinstance(limit, bool) or not isinstance(limit, int | np.integer) or limit < 1:
        found.problems.append(
            "its episodes have no limit; register it with max_episode_steps, or set "
            "task.max_episode_steps=STEPS"
        )
        return
    found.max_episode_steps = int(limit)
    found.facts.append(("episode", f"{limit} steps at most"))


def _play(world: Any, task: Mapping[str, Any], found: Found, label: str) -> None:
    """Some steps of random actions: what is reported, and what is wrong with it."""
    told: dict[str, list[Any]] = {"reset": [], "step": []}
    space, played = world.action_space, 0
    space.seed(0)
    try:
        observation, info = world.reset(seed=0)
        told["reset"].append(info)
        for played in range(1, PLAYED + 1):
            observation, reward, terminated, truncated, info = world.step(space.sample())
            told["step"].append(info)
            if not world.observation_space.contains(observation):
                width = np.shape(observation)
                if width != (world.observation_space.shape or width):
                    found.problems.append(
                        f"an observation has shape {width}, its space "
                        f"{world.observation_space.shape}; return what observation_space says"
                    )
                    break
            if isinstance(observation, np.ndarray) and not np.isfinite(observation).all():
                found.problems.append(f"the observation of step {played} is not finite; it must be")
                break
            if not np.isfinite(float(reward)):
                found.problems.append(f"the reward of step {played} is {reward}; it must be finite")
                break
            if terminated or truncated:
                told["reset"].append(world.reset()[1])
    except UserError:
        raise
    except Exception as error:
        where = f"step {played}" if played else "its reset"
        reason = failure(error)
        if reason == first_line(error):  # none of its lines: it is not called as it should be
            reason += f"; {INTERFACE}"
        raise UserError(f"{label}: {where} fails: {reason}") from error
    lacking = [info for info in told["step"] if "cost" not in info]
    if lacking:
        found.problems.append(
            "a step's info lacks 'cost'; report the cost of the step, 0 where nothing is violated"
        )
    else:
        found.facts.append(("cost", "reported"))
    _distances(world, task, found, [*told["reset"], *told["step"]], told["reset"][0])


def _distances(
    world: Any, task: Mapping[str, Any], found: Found, infos: list[Any], first: Mapping[str, Any]
) -> None:
    """d, d_dot and d_min, or why no energy function can be learned."""
    reporting = [info for info in infos if "d" in info or "d_dot" in info]
    if not reporting:
        found.lacks.append(
            "no info has 'd' and 'd_dot', the distance to each obstacle and its rate; report both "
            "in reset and step to train an energy function (safemr, joint_sis, fac)"
        )
        if task.get("num_obstacles") or task.get("d_min"):
            found.problems.append("it has a d_min or num_obstacles but reports no 'd'; report it")
        return
    for name in ("d", "d_dot"):
        if any(name not in info for info in infos):
            found.problems.append(
                f"an info has no {name!r} while others have distances; report d and d_dot, one "
                "number an obstacle, in every reset and step"
            )
            return
        wrong = next((info[name] for info in infos if np.ndim(info[name]) != 1), None)
        if wrong is not None:
            found.problems.append(
                f"{name!r} is {show(wrong)}; make it an array of one number an obstacle"
            )
            return
    if any(
        np.isnan(np.asarray(info[name], float)).any() for info in infos for name in ("d", "d_dot")
    ):
        found.problems.append("'d' or 'd_dot' is nan; d = inf says that an obstacle is not there")
        return
    if any(len(info["d"]) != len(info["d_dot"]) for info in infos):
        found.problems.append("'d' and 'd_dot' have different lengths; both have one an obstacle")
        return
    most = max(len(info["d"]) for info in infos)
    said = task.get("num_obstacles") or _attribute(world, "num_obstacles")
    found.num_obstacles = int(said if said is not None else len(first["d"]))
    if found.num_obstacles < max(most, 1):
        found.problems.append(
            f"'d' has up to {most} entries and num_obstacles is {found.num_obstacles}; set "
            f"task.num_obstacles={max(most, 1)}"
        )
    own, given = _attribute(world, "d_min"), task.get("d_min")
    if own is not None and given is not None and float(own) != float(given):
        found.problems.append(
            f"d_min is {own} in the environment and {given} in the configuration; leave the second "
            "out, or change the first by a setting of the environment"
        )
    value = own if own is not None else given
    if value is None:
        found.problems.append(
            "d_min, the distance to be kept, is missing; make it an attribute of the environment, "
            "or set task.d_min=METRES"
        )
    elif (
        isinstance(value, bool)
        or not isinstance(value, int | float | np.number)
        or not (0.0 < float(value) < np.inf)
    ):
        found.problems.append(f"d_min is {show(value)}; make it a positive number")
    else:
        found.d_min = float(value)
        found.facts.append(("obstacles", f"{found.num_obstacles} at most, d_min = {found.d_min:g}"))
