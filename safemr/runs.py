"""From a configuration to the runs it asks for, each with its complete resolved settings.

A run is identified by the digest of its resolved configuration: algorithm name and version,
every hyperparameter, task version and settings, budget, evaluation and seed. Whatever changes the
numbers changes the digest, and with it the folder of the record.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import inspect
import json
import math
import pkgutil
import types
import typing
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safemr import environments, records
from safemr.config import FAMILIES, Config, Variant, unknown
from safemr.errors import UserError
from safemr.strict_yaml import show


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
    base variant is that variant: nothing is trained twice.
    """

    navigation: tuple[Run, ...]
    sensitivity: tuple[Run, ...]
    aircraft: tuple[Run, ...]
    outside: tuple[Run, ...]
    points: Mapping[str, tuple[float, float]]

    @property
    def trained(self) -> tuple[Run, ...]:
        """Every run of `safemr` once."""
        everything = (*self.navigation, *self.sensitivity, *self.aircraft)
        return tuple({run.path: run for run in everything}.values())

    @property
    def runs(self) -> tuple[Run, ...]:
        """Every run, the outside ones last."""
        return (*self.trained, *self.outside)


@dataclass(frozen=True)
class Algorithm:
    """What a module of `safemr.algorithms` says about itself."""

    name: str
    version: int
    family: str
    hyperparameters: type[Any]  # the frozen dataclass ``Config``
    trainer: type[Any]


def algorithm_names() -> list[str]:
    """The modules in `safemr.algorithms`: one file is one algorithm."""
    package = importlib.import_module("safemr.algorithms")
    return sorted(module.name for module in pkgutil.iter_modules(package.__path__))


@functools.cache
def load_algorithm(name: str, where: str = "") -> Algorithm:
    """Import an algorithm by name and check the module's contract."""
    if name not in algorithm_names():
        raise unknown("algorithm", name, algorithm_names(), where)
    environments.register_tasks()  # an algorithm may import from that package
    file = f"safemr/algorithms/{name}.py"
    try:
        module = importlib.import_module(f"safemr.algorithms.{name}")
    except Exception as error:  # whatever is wrong in that file, its author wants to know where
        reason = str(error).partition("\n")[0]
        raise UserError(f"{file} does not import: {type(error).__name__}: {reason}") from error
    for part in ("VERSION", "Config", "Trainer"):
        if not hasattr(module, part):
            raise UserError(f"{file} must define {part}")
    family = getattr(module.Trainer, "family", None)
    if family not in FAMILIES:
        raise UserError(f"{file}: Trainer.family must be one of {', '.join(FAMILIES)}")
    return Algorithm(name, module.VERSION, family, module.Config, module.Trainer)


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
    try:
        environment = gymnasium.make(f"{name}-v0", disable_env_checker=True, **settings)
    except Exception as error:  # the environment's own validation, whatever its type
        known = _setting_names(name)
        for setting in settings:
            if known and setting not in known:
                raise unknown("setting", setting, known, f"task {name}") from error
        reason = str(error).partition(" was raised from the environment creator")[0]
        raise UserError(f"task {name}: {reason.partition(chr(10))[0]}") from error
    version = int(environment.unwrapped.task_version)
    environment.close()
    return version


def _setting_names(name: str) -> list[str]:
    gymnasium = importlib.import_module("gymnasium")
    constructor = type(gymnasium.make(f"{name}-v0", disable_env_checker=True).unwrapped).__init__
    parameters = list(inspect.signature(constructor).parameters.values())[1:]
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters):
        return []
    return [p.name for p in parameters]


def describe_task(name: str, settings: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """The ``task`` entry of a run's config: name, version and settings."""
    if name not in task_names():
        raise unknown("task", name, task_names(), where)
    try:
        text = records.canonical_json(settings)
    except (TypeError, ValueError) as error:
        raise UserError(f"settings of task {name}: {error}") from error
    return {"name": name, "version": _task_version(name, text), "settings": dict(settings)}


def hyperparameters(
    algorithm: Algorithm, overrides: Mapping[str, Any], where: str
) -> dict[str, Any]:
    """The complete hyperparameters of an algorithm, defaults included, types and ranges checked."""
    hints = typing.get_type_hints(algorithm.hyperparameters)
    names = {field.name for field in dataclasses.fields(algorithm.hyperparameters) if field.init}
    values = {}
    for name, value in overrides.items():
        if name not in names:
            raise unknown("hyperparameter", name, names, f"{where} ({algorithm.name})")
        values[name] = coerce(value, hints[name], f"{where}: {name}")
    try:
        complete = algorithm.hyperparameters(**values)
    except (UserError, ValueError) as error:
        raise UserError(f"{where}: {error}") from error
    return dataclasses.asdict(complete)


def coerce(value: Any, hint: Any, where: str) -> Any:
    """``value`` as the annotated type, or a UserError. Integers pass as floats, nothing else."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is Any:
        return value
    if origin is typing.Literal:
        if not any(value == choice and type(value) is type(choice) for choice in arguments):
            raise unknown("value", value, map(str, arguments), where)
        return value
    if origin in (typing.Union, types.UnionType):
        for option in arguments:
            try:
                return coerce(value, option, where)
            except UserError:
                continue
    elif origin in (tuple, list) and isinstance(value, (list, tuple)):
        variadic = origin is list or arguments[-1:] == (Ellipsis,)
        types_of = [arguments[0]] * len(value) if variadic else list(arguments)
        if len(types_of) == len(value):
            return origin(coerce(v, t, where) for v, t in zip(value, types_of, strict=True))
    elif hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if abs(value) < math.inf and abs(value) < 1e300:
            return float(value)
    elif (hint is None or hint is type(None)) and value is None:
        return None
    elif hint in (int, str, bool) and type(value) is hint:
        return value
    name = getattr(hint, "__name__", str(hint)) if origin is None else str(hint)
    raise UserError(f"{where} must be {name}, not {show(value)}")


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
) -> Run:
    """A run from its parts: `describe_task`, `load_algorithm` and `hyperparameters`."""
    described = {"name": algorithm.name, "version": algorithm.version, "hyperparameters": values}
    return _run(task, described, variant, seed, steps, log_every, evaluation)


def _run(
    task: Mapping[str, Any],
    algorithm: Mapping[str, Any],
    variant: str,
    seed: int,
    steps: int,
    log_every: int,
    evaluation: Mapping[str, int],
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
        aircraft = list(
            resolver.grid(
                part_of.task,
                part_of.algorithms,
                part_of.seeds,
                "aircraft.algorithms",
                "aircraft.task",
            )
        )
    plan = Plan(
        tuple(navigation), tuple(sensitivity), tuple(aircraft), tuple(resolver.outside()), points
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
        for task, overrides in config.task_overrides.items():
            describe_task(task, overrides.settings, "task_overrides")
            for family, values in overrides.hyperparameters.items():
                names = {
                    field.name
                    for algorithm in algorithms
                    if algorithm.family == family
                    for field in dataclasses.fields(algorithm.hyperparameters)
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
        for label, variant in variants.items():
            algorithm = load_algorithm(variant.algorithm)
            shared = overrides.hyperparameters.get(algorithm.family, {}) if overrides else {}
            names = {field.name for field in dataclasses.fields(algorithm.hyperparameters)}
            # What makes the variant what it is stands above what tunes a family to a task.
            chosen = {k: v for k, v in shared.items() if k in names} | dict(variant.overrides)
            values = hyperparameters(algorithm, chosen, f"{section}.{label}")
            steps = self._steps(task, algorithm.family)
            for seed in seeds:
                yield make_run(
                    described,
                    algorithm,
                    values,
                    variant=label,
                    seed=seed,
                    steps=steps,
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
            for label, entry in self.config.outside.items():
                algorithm = {
                    "name": entry.algorithm,
                    "version": entry.version,
                    "hyperparameters": dict(entry.hyperparameters),
                }
                for seed in self.config.seeds:
                    schedule = self._schedule(entry.steps)
                    yield _run(described, algorithm, label, seed, entry.steps, **schedule)

    def _task(self, name: str, section: str) -> dict[str, Any]:
        overrides = self.config.task_overrides.get(name)
        return describe_task(name, overrides.settings if overrides else {}, section)

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
