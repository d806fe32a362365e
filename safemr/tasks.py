"""What a task is to the pipeline: its name, its environment, and what that environment has.

A run's config says its task as a mapping: ``name``, ``version``, ``settings`` and, where the name
is not a registered one, ``base``, the registered task that the settings change. A task with other
settings is another task and has its own name, so that what is said of a name (the paper's values,
its claims) never meets numbers of something else. A task from outside has an ``id`` of Gymnasium
(``package:Name-v0``) and what else `safemr.foreign` needs to know (`OPTIONS`). Whoever needs an
environment of a run asks `make_envs`; whether a drawing, a check or a controller makes sense for a
task, its `Traits` say.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

from safemr.environments import SafetyEnvs, register_tasks

# The ``task`` entry of a run's config (`safemr.experiment.planning.describe_task`), or the name of
# a registered task, which then has its own settings.
Task: TypeAlias = "str | Mapping[str, Any]"

# Settings of how a task is simulated, not of what it is: they make no other task of it.
SIMULATION = ("sleep",)

# Of a task from outside: the distance to be kept [m], the most obstacles at once, how it is
# batched.
OPTIONS = ("d_min", "num_obstacles", "vectorization")
MODES = ("sync", "async", "vector_entry_point")  # values of vectorization


@dataclass(frozen=True)
class Traits:
    """What the environment of a task has; a new kind of task answers here and nowhere else.

    There is no other word for a task's kind: whether it gets certificates, rollouts or controllers
    is asked of what it has, never of what it is called.
    """

    point_robot: (
        bool  # of which `safemr.certificates.point_robot` is a model; its scenes can be drawn
    )
    pushes_box: bool
    action_dim: int
    episode_steps: int | None  # the most steps of an episode, where the environment says so
    distances: bool = True  # it reports d and d_dot, which every energy function needs


@dataclass(frozen=True)
class Described:
    """A task of a plan: its entry in the config of its runs, and its traits."""

    entry: Mapping[str, Any]
    traits: Traits


def name_of(task: Task) -> str:
    """What the task is called in tables and folders."""
    return task if isinstance(task, str) else str(task["name"])


def base_of(task: Task) -> str:
    """The registered task behind it; of one from outside, Gymnasium's id."""
    if isinstance(task, str):
        return task
    return str(task.get("id") or task.get("base", task["name"]))


def settings_of(task: Task) -> dict[str, Any]:
    """The keyword arguments of its environment."""
    return {} if isinstance(task, str) else dict(task.get("settings", {}))


def is_foreign(task: Task) -> bool:
    """Whether its environment comes from outside, by an id of Gymnasium."""
    return not isinstance(task, str) and "id" in task


def task_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Those of some settings that make another task of the registered one."""
    return {name: value for name, value in settings.items() if name not in SIMULATION}


def make_envs(task: Task, num_envs: int) -> SafetyEnvs:
    """A batched environment of a task; all of them are made here.

    Raises:
        UserError: one from outside lacks something (`safemr check` says all of it).
    """
    import gymnasium

    if is_foreign(task):
        from safemr.foreign import foreign_envs

        return foreign_envs(cast("Mapping[str, Any]", task), num_envs)
    register_tasks()
    made = gymnasium.make_vec(
        f"{base_of(task)}-v0",
        num_envs,
        vectorization_mode="vector_entry_point",
        **settings_of(task),
    )
    return cast(SafetyEnvs, made)  # Gymnasium's type has neither d_min nor snapshots


def traits(environment: Any) -> Traits:
    """What an environment, scalar or batched, has."""
    task = getattr(environment, "task", None)
    return Traits(
        point_robot="velocimeter" in getattr(environment, "observation_layout", ()),
        pushes_box=bool(getattr(task, "has_box", False)),
        action_dim=math.prod(_action_space(environment).shape),
        episode_steps=getattr(environment, "max_episode_steps", None),
        distances=getattr(environment, "reports_distances", True),
    )


def _action_space(environment: Any) -> Any:
    """That of one environment, also where there is a batch."""
    return getattr(environment, "single_action_space", None) or environment.action_space
