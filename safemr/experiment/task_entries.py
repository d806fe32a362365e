"""What a run's configuration says of its task and of how the task is met, checked where it is run.

The entry of a task is its name, version and settings, and the registered task behind another name
(`safemr.tasks`), or Gymnasium's id of an environment from outside (`ForeignTask`); an interface
fits a task or is refused.
"""

from __future__ import annotations

import functools
import importlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from safemr import environments
from safemr.errors import UserError, show
from safemr.experiment import records
from safemr.experiment.sections import Section, checked_name, integer, mapping, number
from safemr.learning.interface import Interface
from safemr.names import unknown
from safemr.tasks import (
    MODES,
    OPTIONS,
    Described,
    Traits,
    base_of,
    is_foreign,
    make_envs,
    name_of,
    settings_of,
    task_settings,
    traits,
)
from safemr.tasks import Task as TaskOrName

_ID = re.compile(r"([A-Za-z_][\w.]*:)?([\w.-]+/)?[\w.-]+")


@dataclass(frozen=True)
class ForeignTask:
    """An environment from outside: its id (``package:Name-v0``) and what is said of it.

    ``options`` are those of `safemr.tasks.OPTIONS`.
    """

    id: str
    settings: Mapping[str, Any]
    options: Mapping[str, Any]

    @classmethod
    def read(cls, value: Any, where: str) -> ForeignTask:
        """From its entry in a configuration. Raises UserError naming ``where``."""
        section = Section(value, where, ("id", "settings", *OPTIONS))
        identity = section.required("id")
        if not isinstance(identity, str) or not _ID.fullmatch(identity):
            raise UserError(f"{where}.id must be like my_package:MyTask-v0, not {show(identity)}")
        options = {name: section.value[name] for name in OPTIONS if name in section.value}
        if "d_min" in options:
            options["d_min"] = number(options["d_min"], f"{where}.d_min", 1e-9)
        if "num_obstacles" in options:
            integer(options["num_obstacles"], f"{where}.num_obstacles", 1, 10_000)
        if options.get("vectorization", MODES[0]) not in MODES:
            raise unknown("vectorization", options["vectorization"], MODES, where)
        return cls(identity, mapping(section.get("settings", {}), f"{where}.settings"), options)

    @classmethod
    def said(cls, identity: str, settings: Mapping[str, Any], where: str) -> ForeignTask:
        """From an id and settings in one: those named as options are options."""
        parts: dict[str, Any] = {"id": identity, "settings": {}}
        for name, value in settings.items():
            (parts if name in OPTIONS else parts["settings"])[name] = value
        return cls.read(parts, where)

    @property
    def name(self) -> str:
        """What it is called where nothing else is said: ``MyTask`` of my_package:MyTask-v0."""
        plain = self.id.rpartition(":")[2].rpartition("/")[2]
        return checked_name(re.sub(r"-v\d+$", "", plain), "the name of a task")


def is_id(text: str) -> bool:
    """Whether a task is said by Gymnasium's id, not by its name here."""
    return ":" in text or re.search(r"-v\d+$", text) is not None


def describe_foreign(name: str, task: ForeignTask, where: str = "") -> dict[str, Any]:
    """The ``task`` entry of a run on an environment from outside, which is made and looked at.

    Raises:
        UserError: it has the name of a registered task, or lacks something.
    """
    if name.lower() in (known.lower() for known in task_names()):
        raise UserError(f"{name!r} is the name of a registered task; give {where} another one")
    entry = {"name": name, "id": task.id, "settings": dict(task.settings), **task.options}
    try:
        records.canonical_json(entry)
    except (TypeError, ValueError) as error:
        raise UserError(f"settings of task {name}: {error}") from error
    envs: Any = make_envs(entry, 1)
    envs.close()
    return {**entry, "version": int(envs.task_version)}


@functools.cache
def task_names() -> list[str]:
    """The tasks that the environment package registers, by their names without ``-v0``."""
    gymnasium = importlib.import_module("gymnasium")
    environments.register_tasks()

    def ours(entry_point: Any) -> bool:
        module = getattr(entry_point, "__module__", entry_point)  # of others also None
        return str(module).partition(":")[0].partition(".")[0] == environments.PACKAGE

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
    if not isinstance(task, str) and is_foreign(task):
        known = {"id", "settings", *OPTIONS}
        parts = {name: value for name, value in task.items() if name in known}
        return describe_foreign(name_of(task), ForeignTask.read(parts, name_of(task)))
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
