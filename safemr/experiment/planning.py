"""From a configuration to the runs it asks for, each with its complete resolved settings.

A run is identified by the digest of its resolved configuration: algorithm name and version,
every hyperparameter, task version and settings, budget, evaluation and seed. Whatever changes the
numbers changes the digest, and with it the folder of the record.
"""

from __future__ import annotations

import functools
import importlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safemr import environments, paper
from safemr.errors import UserError, show
from safemr.experiment import records
from safemr.experiment.catalogue import Algorithm, hyperparameters, load_algorithm, variants_of
from safemr.experiment.catalogue import algorithm_names as algorithm_names
from safemr.experiment.config import Config, Variant
from safemr.experiment.roles import Variants
from safemr.learning.hyperparameters import Setting
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


@dataclass(frozen=True)
class Run:
    """One training run: where it stands in figures (task, variant, seed), and its config."""

    task: str
    variant: str
    seed: int
    config: Mapping[str, Any]

    @functools.cached_property
    def path(self) -> Path:
        """The record's folder, relative to the results root."""
        return records.record_path(self.config, self.variant)

    @functools.cached_property
    def resolved(self) -> str:
        """The canonical JSON of the config."""
        return records.canonical_json(self.config)

    @property
    def digest(self) -> str:
        return records.config_digest(self.config)


@dataclass(frozen=True)
class Plan:
    """All runs of a configuration.

    ``points`` maps the variant label of each sensitivity point to (a, b). A point that equals its
    base variant is that variant: nothing is trained twice. ``tasks`` are those of its runs.
    ``grid`` and ``encounter`` are the variants on the navigation tasks and on the aircraft.
    """

    navigation: tuple[Run, ...]
    sensitivity: tuple[Run, ...]
    aircraft: tuple[Run, ...]
    outside: tuple[Run, ...]
    points: Mapping[str, tuple[float, float]]
    tasks: Mapping[str, Described]
    grid: Variants
    encounter: Variants

    @property
    def trained(self) -> tuple[Run, ...]:
        """Every run of `safemr` once."""
        everything = (*self.navigation, *self.sensitivity, *self.aircraft)
        return tuple({run.path: run for run in everything}.values())

    @property
    def runs(self) -> tuple[Run, ...]:
        """Every run, the outside ones last."""
        return (*self.trained, *self.outside)


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


def check_setting(
    algorithm: Algorithm,
    values: Mapping[str, Any],
    task: Mapping[str, Any],
    steps: int,
    where: str,
    action_repeat: int = 1,
) -> None:
    """Refuse hyperparameters that cannot work on a task, as `describe_task` gives it, in a budget.

    Raises:
        UserError: it names the hyperparameter, and what it may be there.
    """
    check = getattr(algorithm.hyperparameters(**values), "check_setting", None)
    if check is None:  # an algorithm that does without `safemr.learning.hyperparameters`
        return
    try:
        has = described(task).traits
        check(Setting(has.action_dim, has.episode_steps or steps, steps, action_repeat))
    except UserError as error:
        raise UserError(f"{where} on {task['name']}: {error}") from error


def make_run(
    task: Mapping[str, Any],
    algorithm: Algorithm,
    values: Mapping[str, Any],
    *,
    variant: str,
    seed: int,
    steps: int,
    log_every: int,
    evaluation: Mapping[str, int],
    interface: Interface | None = None,
) -> Run:
    """A run from its parts: `describe_task`, `load_algorithm`, `hyperparameters`, and
    `fitted_interface` where the learner does not meet the environment as it is."""
    described = {"name": algorithm.name, "version": algorithm.version, "hyperparameters": values}
    return _run(task, described, variant, seed, steps, log_every, evaluation, interface)


def _run(
    task: Mapping[str, Any],
    algorithm: Mapping[str, Any],
    variant: str,
    seed: int,
    steps: int,
    log_every: int,
    evaluation: Mapping[str, int],
    interface: Interface | None = None,
) -> Run:
    config = {
        "schema": records.SCHEMA,
        "task": dict(task),
        "algorithm": dict(algorithm),
        "seed": seed,
        "steps": steps,
        "log_every": log_every,
        "evaluation": dict(evaluation),
    }
    if interface is not None and interface.entry():
        config["interface"] = interface.entry()
    try:
        records.canonical_json(config)
    except (TypeError, ValueError) as error:
        raise UserError(f"the settings of {variant} on {task['name']}: {error}") from error
    return Run(task["name"], variant, seed, config)


def resolve(config: Config) -> Plan:
    """All runs of a configuration; every name in it is checked, also where no run uses it."""
    resolver = _Resolver(config)
    navigation = [
        run
        for task in config.tasks
        for run in resolver.grid(task, config.algorithms, config.seeds, "algorithms", "tasks")
    ]
    points: dict[str, tuple[float, float]] = {}
    sensitivity: list[Run] = []
    if config.sensitivity:
        variants, points = resolver.points()
        part = config.sensitivity
        sensitivity = list(
            resolver.grid(part.task, variants, part.seeds, "sensitivity", "sensitivity.task")
        )
    aircraft: list[Run] = []
    if config.aircraft:
        part_of = config.aircraft
        if part_of.task != paper.AIRCRAFT_TASK:
            raise UserError(
                f"aircraft.task = {part_of.task!r}: the experiment's truth is solved for "
                f"{paper.AIRCRAFT_TASK} only; put other tasks into tasks"
            )
        aircraft = list(
            resolver.grid(
                part_of.task,
                part_of.algorithms,
                part_of.seeds,
                "aircraft.algorithms",
                "aircraft.task",
            )
        )
    outside = tuple(resolver.outside())
    entries = {
        run.task: run.config["task"] for run in (*navigation, *sensitivity, *aircraft, *outside)
    }
    plan = Plan(
        tuple(navigation),
        tuple(sensitivity),
        tuple(aircraft),
        outside,
        points,
        {name: described(entry) for name, entry in entries.items()},
        variants_of(config.algorithms, config.outside),
        variants_of(config.aircraft.algorithms if config.aircraft else {}),
    )
    _check_distinct(plan)
    return plan


class _Resolver:
    """The lookups that all parts of a configuration share."""

    def __init__(self, config: Config) -> None:
        self.config = config
        sections = {"algorithms": config.algorithms}
        if config.aircraft:
            sections["aircraft.algorithms"] = config.aircraft.algorithms
        algorithms = [
            load_algorithm(variant.algorithm, f"{section}.{label}")
            for section, variants in sections.items()
            for label, variant in variants.items()
        ]
        for section, variants in sections.items():
            for label, variant in variants.items():
                hyperparameters(
                    load_algorithm(variant.algorithm), variant.overrides, f"{section}.{label}"
                )
        for task in config.task_variants:
            self._task(task, f"tasks.{task}")
        for task, overrides in config.task_overrides.items():
            self._interface(task, self._task(task, "task_overrides"))
            for family, values in overrides.hyperparameters.items():
                names = {
                    name
                    for algorithm in algorithms
                    if algorithm.family == family
                    for name in algorithm.settable
                }
                for name in values.keys() - names:
                    where = f"task_overrides.{task}.hyperparameters.{family}"
                    raise unknown("hyperparameter", name, names, where)

    def grid(
        self,
        task: str,
        variants: Mapping[str, Variant],
        seeds: tuple[int, ...],
        section: str,
        task_section: str,
    ) -> Iterator[Run]:
        described = self._task(task, task_section)
        overrides = self.config.task_overrides.get(task)
        interface = self._interface(task, described)
        for label, variant in variants.items():
            algorithm = load_algorithm(variant.algorithm)
            shared = overrides.hyperparameters.get(algorithm.family, {}) if overrides else {}
            names = algorithm.settable
            # What makes the variant what it is stands above what tunes a family to a task.
            chosen = {k: v for k, v in shared.items() if k in names} | dict(variant.overrides)
            values = hyperparameters(algorithm, chosen, f"{section}.{label}")
            steps = self._steps(task, algorithm.family)
            where = f"{section}.{label}"
            check_setting(algorithm, values, described, steps, where, interface.action_repeat)
            for seed in seeds:
                yield make_run(
                    described,
                    algorithm,
                    values,
                    variant=label,
                    seed=seed,
                    steps=steps,
                    interface=interface,
                    **self._schedule(steps),
                )

    def points(self) -> tuple[dict[str, Variant], dict[str, tuple[float, float]]]:
        """The variants of the sensitivity study and their (a, b)."""
        part = self.config.sensitivity
        assert part is not None
        base = self.config.algorithms[part.variant]
        algorithm = load_algorithm(base.algorithm)
        where = f"sensitivity.{part.variant}"
        own = hyperparameters(algorithm, base.overrides, where)
        variants, points = {}, {}
        for a, b in part.points:
            overrides = {**base.overrides, "a": a, "b": b}
            same = hyperparameters(algorithm, overrides, where) == own
            label = part.variant if same else f"{part.variant}[{a:g},{b:g}]"
            variants[label], points[label] = Variant(base.algorithm, overrides), (a, b)
        return variants, points

    def outside(self) -> Iterator[Run]:
        for task in self.config.tasks:
            described = self._task(task, "tasks")
            interface = self._interface(task, described)
            for label, entry in self.config.outside.items():
                algorithm = {
                    "name": entry.algorithm,
                    "version": entry.version,
                    "hyperparameters": dict(entry.hyperparameters),
                }
                for seed in self.config.seeds:
                    schedule = self._schedule(entry.steps) | {"interface": interface}
                    yield _run(described, algorithm, label, seed, entry.steps, **schedule)

    def _interface(self, task: str, described: Mapping[str, Any]) -> Interface:
        """How learners meet a task: what the configuration says for it, or for all of `tasks`."""
        overrides = self.config.task_overrides.get(task)
        if overrides is not None and overrides.interface is not None:
            asked, where = overrides.interface, f"task_overrides.{task}.interface"
        else:  # the aircraft is met as it is
            part = self.config.sensitivity
            shared = task in self.config.tasks or (part is not None and task == part.task)
            asked, where = self.config.interface if shared else Interface(), "interface"
        return fitted_interface(asked, described, where)

    def _task(self, name: str, section: str) -> dict[str, Any]:
        """The entry of a task by its name in the configuration."""
        overrides, variant = (
            self.config.task_overrides.get(name),
            self.config.task_variants.get(name),
        )
        given = dict(overrides.settings) if overrides else {}
        if variant is None:
            if name not in task_names():
                raise unknown("task", name, [*task_names(), *self.config.task_variants], section)
            entry = describe_task(name, given, section)
            shown = ", ".join(f"{key}: {value}" for key, value in task_settings(given).items())
            remedy = f"tasks: {{NAME: {{base: {name}, settings: {{{shown[:80]}}}}}}}"
            check_name(entry, f"task_overrides.{name}.settings", remedy)
            return entry
        where = f"tasks.{name}"
        if not variant.settings:
            raise UserError(f"{where}.settings is empty: then it is {variant.base} itself")
        describe_task(variant.base, variant.settings, where)
        if task_settings(given):
            raise UserError(
                f"task_overrides.{name}.settings: {next(iter(task_settings(given)))} belongs into "
                f"{where}.settings"
            )
        return describe_task(name, {**variant.settings, **given}, where, base=variant.base)

    def _steps(self, task: str, family: str) -> int:
        overrides = self.config.task_overrides.get(task)
        budget = {**self.config.budget, **(overrides.budget if overrides else {})}
        if family not in budget:
            raise UserError(f"budget lacks {family!r}, which an algorithm on {task} needs")
        return budget[family]

    def _schedule(self, steps: int) -> dict[str, Any]:
        points = self.config.log_points
        if steps < points:
            raise UserError(f"a budget of {steps} steps is less than log_points = {points}")
        log_every = steps // points
        part = self.config.evaluation
        every = log_every * (points // part.points)
        evaluation = {"every": every, "episodes": part.episodes, "seed": part.seed}
        return {"log_every": log_every, "evaluation": evaluation}


def _check_distinct(plan: Plan) -> None:
    """Two labels for one thing would be trained twice and shown as two findings."""
    labels: dict[tuple[str, str], str] = {}
    for run in plan.runs:
        key = (run.task, run.digest)
        if labels.setdefault(key, run.variant) != run.variant:
            raise UserError(
                f"{labels[key]!r} and {run.variant!r} are the same algorithm with the same "
                f"hyperparameters on {run.task}; remove one"
            )
    names: dict[str, str] = {}
    for name, task in plan.tasks.items():
        same = records.canonical_json([base_of(task.entry), settings_of(task.entry)])
        if names.setdefault(same, name) != name:
            raise UserError(f"{names[same]!r} and {name!r} are the same task; remove one")
