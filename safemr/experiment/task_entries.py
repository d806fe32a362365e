"""What a run's configuration says of its task and of how the task is met, checked where it is run.

The entry of a task is its name, version and settings, and the registered task behind another name
(`safemr.tasks`); an interface fits a task or is refused.
"""

from __future__ import annotations

import functools
import importlib
import json
from collections.abc import Mapping
from typing import Any

from safemr import environments
from safemr.errors import UserError, show
from safemr.experiment import records
from safemr.learning.interface import Interface
from safemr.names import unknown
from safemr.tasks import (
    Described,
    Traits,
    base_of,
    make_envs,
    name_of,
    settings_of,
    task_settings,
    traits,
)
from safemr.tasks import Task as TaskOrName


@functools.cache
def task_names() -> list[str]:
    """The tasks that the environment package registers, by their names without ``-v0``."""
    gymnasium = importlib.import_module("gymnasium")
    environments.register_tasks()

    def ours(entry_point: Any) -> bool:
        module = entry_point if isinstance(entry_point, str) else entry_point.__module__
        return module.partition(":")[0].partition(".")[0] == environments.PACKAGE

    specs = gymnasium.registry.values()
    return sorted(spec.id.removesuffix("-v0") for spec in specs if ours(spec.entry_point))


@functools.cache
def _task_version(name: str, settings_json: str) -> int:
    gymnasium = importlib.import_module("gymnasium")
    settings = json.loads(settings_json)
    known = gymnasium.make(f"{name}-v0", disable_env_checker=True).unwrapped.setting_names
    for setting in settings:  # before Gymnasium sees them: it has keywords of its own, as `task`
        if setting not in known:
            raise unknown("setting", setting, known, f"task {name}")
        if settings[setting] is None:
            raise UserError(f"task {name}: the setting {setting} has no value; leave it out")
    try:  # a batch, since that is what learners train on
        environment: Any = make_envs({"name": name, "settings": settings}, 1)
    except Exception as error:  # the environment's own validation, whatever its type
        reason = str(error).partition(chr(10))[0].removeprefix(f"{name}: ")
        raise UserError(f"task {name}: {reason}") from error
    version = int(environment.task_version)
    environment.close()
    return version


def describe_task(
    name: str, settings: Mapping[str, Any], where: str = "", *, base: str | None = None
) -> dict[str, Any]:
    """The ``task`` entry of a run's config: name, version and settings.

    base: the registered task of which ``name`` is a variant; then the entry says it, too.
    """
    registered = name if base is None else base
    if registered not in task_names():
        raise unknown("task", registered, task_names(), where)
    if base is not None and name.lower() in (known.lower() for known in task_names()):
        raise UserError(f"{name!r} is the name of a registered task; give {where} another one")
    try:
        text = records.canonical_json(settings)
    except (TypeError, ValueError) as error:
        raise UserError(f"settings of task {name}: {error}") from error
    entry = {"name": name, "version": _task_version(registered, text), "settings": dict(settings)}
    return entry if base is None else {**entry, "base": base}


def installed(task: TaskOrName) -> dict[str, Any]:
    """The entry of a task as the installed environments have it: what a new run would say."""
    base = None if name_of(task) == base_of(task) else base_of(task)
    return describe_task(name_of(task), settings_of(task), base=base)


def described(entry: Mapping[str, Any]) -> Described:
    """A task's entry with the traits of its environment."""
    return Described(entry, _traits(records.canonical_json(entry)))


@functools.cache
def _traits(entry_json: str) -> Traits:
    envs = make_envs(json.loads(entry_json), 1)  # the batched one, which is what runs are made of
    found = traits(envs)
    envs.close()
    return found


def check_name(entry: Mapping[str, Any], where: str, remedy: str) -> None:
    """A registered task under its own name has its own settings, the simulation's apart.

    Raises:
        UserError: naming ``where`` and the setting that makes another task of it.
    """
    changed = task_settings(entry["settings"])
    if "base" not in entry and changed:
        name, value = next(iter(changed.items()))
        raise UserError(
            f"{where}: {name} = {show(value)} makes another task of {entry['name']}, which needs a "
            f"name of its own: {remedy}"
        )


def fitted_interface(
    interface: Interface, task: Mapping[str, Any], where: str = "interface"
) -> Interface:
    """An interface as it is on a task: its lidars named, the fit with the environment checked.

    Raises:
        UserError: it does not fit; naming ``where`` and the task.
    """
    return _fitted(interface, records.canonical_json(task), where)


@functools.cache
def _fitted(interface: Interface, entry_json: str, where: str) -> Interface:
    if interface == Interface():
        return interface
    entry = json.loads(entry_json)
    envs = make_envs(entry, 1)
    try:
        return interface.fitted(envs, where)
    except UserError as error:
        raise UserError(f"task {name_of(entry)}: {error}") from error
    finally:
        envs.close()
