"""From a configuration to the runs it asks for, each with its complete resolved settings.

A run is identified by the digest of its resolved configuration: algorithm name and version,
every hyperparameter, task version and settings, budget, evaluation and seed. Whatever changes the
numbers changes the digest, and with it the folder of the record.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safemr import paper
from safemr.errors import UserError
from safemr.experiment import records
from safemr.experiment.catalogue import Algorithm, hyperparameters, load_algorithm, variants_of
from safemr.experiment.catalogue import algorithm_names as algorithm_names
from safemr.experiment.config import Config, Variant
from safemr.experiment.roles import Variants
from safemr.experiment.sections import told
from safemr.experiment.task_entries import ForeignTask as ForeignTask
from safemr.experiment.task_entries import check_name as check_name
from safemr.experiment.task_entries import describe_foreign as describe_foreign
from safemr.experiment.task_entries import describe_task as describe_task
from safemr.experiment.task_entries import described as described
from safemr.experiment.task_entries import fitted_interface as fitted_interface
from safemr.experiment.task_entries import installed as installed
from safemr.experiment.task_entries import is_id as is_id
from safemr.experiment.task_entries import task_names as task_names
from safemr.learning.hyperparameters import Setting
from safemr.learning.interface import Interface
from safemr.names import unknown
from safemr.tasks import OPTIONS, Described, base_of, settings_of, task_settings


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

    @property
    def seeds_told(self) -> str:
        """For captions: the seeds on the navigation tasks, and the variants with others."""
        return seeds_told(self.navigation)


def seeds_told(runs: Iterable[Run]) -> str:
    """For a caption: the seeds of most variants, and the variants with others."""
    of: dict[str, set[int]] = {}
    for run in runs:
        of.setdefault(run.variant, set()).add(run.seed)
    said = {variant: told(seeds) for variant, seeds in of.items()}
    ((most, _),) = Counter(said.values()).most_common(1) or [("", 0)]
    others: dict[str, list[str]] = {}
    for variant, seeds in said.items():
        if seeds != most:
            others.setdefault(seeds, []).append(variant)
    rest = "; ".join(f"{', '.join(names)}: {seeds}" for seeds, names in others.items())
    return f"{most} ({rest})" if rest else most


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
    if algorithm.certificate is not None and not described(task).traits.distances:
        raise UserError(
            f"{where} on {task['name']}: {algorithm.name} has an energy function, and the "
            "environment reports no d and d_dot; report them (safemr check "
            f"{task.get('id', '')}), or choose an algorithm without one"
        )
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
    if algorithm.package is not None:
        described["package"] = algorithm.package
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
                # A file laid over another may leave no algorithm of a family for which that one
                # has settings: these then set nothing, and must only be names that there are.
                concerned = [one for one in algorithms if one.family == family] or [
                    one for one in map(load_algorithm, algorithm_names()) if one.family == family
                ]
                names = {name for algorithm in concerned for name in algorithm.settable}
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
            for seed in variant.seeds or seeds:
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
        variants: dict[str, Variant] = {}
        points: dict[str, tuple[float, float]] = {}
        for a, b in part.points:
            overrides = {**base.overrides, "a": a, "b": b}
            same = hyperparameters(algorithm, overrides, where) == own
            label = part.variant if same else f"{part.variant}[{a:g},{b:g}]"
            if label in points:
                raise UserError(
                    f"sensitivity.points: {list(points[label])} and {[a, b]} have the same label, "
                    f"{label}; remove one"
                )
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
        if isinstance(variant, ForeignTask):
            if given:
                raise UserError(f"task_overrides.{name}.settings belong into {where}.settings")
            return describe_foreign(name, variant, where)
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
        without_seed = {name: value for name, value in run.config.items() if name != "seed"}
        key = (run.task, records.config_digest(without_seed))
        if labels.setdefault(key, run.variant) != run.variant:
            raise UserError(
                f"{labels[key]!r} and {run.variant!r} are the same algorithm with the same "
                f"hyperparameters on {run.task}; remove one"
            )
    names: dict[str, str] = {}
    for name, task in plan.tasks.items():
        options = [task.entry.get(option) for option in OPTIONS]
        same = records.canonical_json([base_of(task.entry), settings_of(task.entry), options])
        if names.setdefault(same, name) != name:
            raise UserError(f"{names[same]!r} and {name!r} are the same task; remove one")
