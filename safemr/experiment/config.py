"""The configuration file: what may be written in it, and clear errors for everything else.

`load` reads ``config/config.yaml`` (and what ``--configfile`` and ``--config`` put over it) into a
`Config`: structure, types and ranges. Names of tasks, algorithms and hyperparameters are checked
where they are resolved into runs, in `safemr.experiment.planning`. Nothing here imports torch or an
environment.
"""

from __future__ import annotations

import argparse
import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safemr.conventions import CLEAN_SHARE, COST_TOLERANCE
from safemr.errors import UserError, show
from safemr.experiment.filter_entries import Filters, read_filters
from safemr.experiment.layout_entries import Evaluation, UnseenLayouts, check_layouts
from safemr.experiment.roles import ROLES
from safemr.experiment.roots import root
from safemr.experiment.sections import (
    Section,
    checked_name,
    distinct,
    flag,
    integer,
    labelled,
    listed,
    mapping,
    number,
    seeds_in,
)
from safemr.experiment.strict_yaml import read_yaml, typed
from safemr.experiment.task_entries import ForeignTask
from safemr.learning.interface import Interface
from safemr.names import unknown

FAMILIES = ("off_policy", "on_policy")
WANDB_MODES = ("disabled", "offline", "online")


@dataclass(frozen=True)
class Variant:
    """One entry of ``algorithms``: a module of `safemr.algorithms` and what differs from it."""

    algorithm: str
    overrides: Mapping[str, Any]
    role: str | None = None  # None: that of the algorithm
    seeds: tuple[int, ...] | None = None  # None: those of the section


@dataclass(frozen=True)
class Outside:
    """An implementation outside `safemr` whose own rule writes the records."""

    algorithm: str
    version: int
    steps: int
    hyperparameters: Mapping[str, Any]


@dataclass(frozen=True)
class TaskVariant:
    """A task with a name of its own: a registered one with other settings."""

    base: str
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class TaskOverrides:
    """What differs on one task, for all algorithms of a family alike.

    ``settings`` are those of its simulation; others make another task, which `TaskVariant` names.
    """

    settings: Mapping[str, Any]
    budget: Mapping[str, int]
    hyperparameters: Mapping[str, Mapping[str, Any]]
    interface: Interface | None  # None: that of `tasks`


@dataclass(frozen=True)
class Sensitivity:
    """Points [a, b] of one variant's regularizer on one task."""

    task: str
    variant: str
    points: tuple[tuple[float, float], ...]
    seeds: tuple[int, ...]

    @property
    def is_map(self) -> bool:
        """Whether the points are all pairs of three or more a and three or more b."""
        a, b = ({point[i] for point in self.points} for i in (0, 1))
        return min(len(a), len(b)) >= 3 and len(self.points) == len(a) * len(b)


@dataclass(frozen=True)
class Aircraft:
    """The aircraft experiment: its own learners and seeds."""

    task: str
    algorithms: Mapping[str, Variant]
    seeds: tuple[int, ...]


@dataclass(frozen=True)
class Config:
    """A validated configuration; see config/config.yaml for the meaning of each key."""

    tasks: tuple[str, ...]
    # of those tasks that are not registered ones
    task_variants: Mapping[str, TaskVariant | ForeignTask]
    algorithms: Mapping[str, Variant]
    seeds: tuple[int, ...]
    budget: Mapping[str, int]
    log_points: int
    evaluation: Evaluation
    interface: Interface  # how learners meet the tasks of `tasks`, where nothing else is said
    unseen_layouts: UnseenLayouts | None
    protocol: int  # by which verdicts are reached, 1 or 2 (docs/claims.md)
    task_overrides: Mapping[str, TaskOverrides]
    sensitivity: Sensitivity | None
    aircraft: Aircraft | None
    outside: Mapping[str, Outside]
    results_root: Path
    figures_root: Path
    allow_missing: bool
    wandb_mode: str
    wandb_project: str
    cost_tolerance: float
    zero_violation_share: float
    filters: Filters | None
    sizes: bool  # whether certificates are compared with the least feasible one
    sizes_beside: Path | None  # another results root whose certificates are shown beside these


def load(files: Sequence[Path | str], overrides: Mapping[str, Any] | None = None) -> Config:
    """Read configuration files and command-line overrides.

    A later source replaces whole top-level keys of the earlier ones: what a file says about
    ``algorithms`` is all there is, and what it does not mention stays.

    Raises:
        UserError: for the first fault, naming it and, for a misspelt name, the nearest valid one.
    """
    merged: dict[str, Any] = {}
    for path in files:
        merged |= read_yaml(Path(path))
    return parse(merged | {key: typed(value) for key, value in (overrides or {}).items()})


def parse(raw: Any) -> Config:
    """Check structure, types and ranges of a configuration and return it."""
    top = Section(raw, "the config", _TOP_LEVEL)
    wandb = Section(top.get("wandb", {}), "wandb", ("mode", "project"))
    safe = Section(top.get("safe", {}), "safe", ("cost_tolerance", "zero_violation_share"))
    tasks = _tasks(top.required("tasks"), "tasks")
    algorithms = _variants(top.required("algorithms"), "algorithms")
    seeds = seeds_in(top.required("seeds"), "seeds")
    least = min(seeds)  # decides whose layouts those are that are not named
    sizes, beside = _sizes(top.get("sizes", False))
    results = root(top.get("results_root", "results"), "results_root")
    if beside and beside.resolve() == results.resolve():
        raise UserError(
            f"sizes.beside = {beside.as_posix()!r} is this configuration's own results_root: name "
            "another's, or say sizes: true"
        )
    mode = wandb.get("mode", "disabled")
    if mode not in WANDB_MODES:
        raise unknown("wandb mode", mode, WANDB_MODES)
    config = Config(
        tasks=tuple(tasks),
        task_variants={name: variant for name, variant in tasks.items() if variant},
        algorithms=algorithms,
        seeds=seeds,
        budget=_budget(top.required("budget"), "budget"),
        log_points=integer(top.get("log_points", 50), "log_points", 1),
        evaluation=Evaluation.read(top.required("evaluation"), least),
        interface=Interface.read(top.get("interface")),
        unseen_layouts=UnseenLayouts.read(top.get("unseen_layouts"), least),
        protocol=integer(top.get("protocol", 1), "protocol", 1, 2),
        task_overrides={
            name: _task_overrides(value, f"task_overrides.{name}")
            for name, value in labelled(top.get("task_overrides", {}), "task_overrides")
        },
        sensitivity=_sensitivity(top.get("sensitivity"), top.required("seeds")),
        aircraft=_aircraft(top.get("aircraft"), top.required("seeds")),
        outside={
            label: _outside(value, f"outside.{label}")
            for label, value in labelled(top.get("outside", {}), "outside")
        },
        results_root=results,
        figures_root=root(top.get("figures_root", "paper_figures"), "figures_root"),
        allow_missing=flag(top.get("allow_missing", False), "allow_missing"),
        wandb_mode=mode,
        wandb_project=checked_name(wandb.get("project", "safemr"), "wandb.project"),
        cost_tolerance=number(
            safe.get("cost_tolerance", COST_TOLERANCE), "safe.cost_tolerance", 0, math.inf
        ),
        zero_violation_share=number(
            safe.get("zero_violation_share", CLEAN_SHARE), "safe.zero_violation_share", 0, 1
        ),
        filters=read_filters(
            top.get("filters"),
            {label: variant.seeds for label, variant in algorithms.items()},
            tasks,
            seeds,
        ),
        sizes=sizes,
        sizes_beside=beside,
    )
    if config.protocol == 2 and not config.unseen_layouts:
        raise UserError(
            "protocol: 2 judges flights on unseen layouts: say unseen_layouts, too, or protocol: 1"
        )
    entries = [variant.seeds for variant in config.algorithms.values()]
    studied = config.sensitivity.seeds if config.sensitivity else None
    flown = {seed for own in (*entries, studied) for seed in own or seeds}
    check_layouts(config.evaluation, config.unseen_layouts, config.filters, flown)
    if config.sizes and not config.unseen_layouts:
        raise UserError(
            "sizes: true draws returns on unseen layouts: say unseen_layouts, too, or sizes: false"
        )
    if config.log_points % config.evaluation.points:
        raise UserError(
            f"log_points = {config.log_points} must be a multiple of evaluation.points = "
            f"{config.evaluation.points}"
        )
    clash = sorted(config.algorithms.keys() & config.outside.keys())
    if clash:
        raise UserError(f"{clash[0]!r} stands both in algorithms and in outside; rename one")
    if config.sensitivity and config.sensitivity.variant not in config.algorithms:
        raise unknown("sensitivity.algorithm", config.sensitivity.variant, config.algorithms)
    return config


_TOP_LEVEL = (
    *("tasks", "algorithms", "seeds", "budget", "log_points", "evaluation", "interface"),
    *(
        "task_overrides",
        "unseen_layouts",
        "protocol",
        "sensitivity",
        "aircraft",
        "outside",
        "results_root",
        "figures_root",
        "allow_missing",
    ),
    *("wandb", "safe", "filters", "sizes"),
)


def _sizes(value: Any) -> tuple[bool, Path | None]:
    """Whether, and beside whose: ``true``, or ``{beside: a results root}``."""
    if not isinstance(value, Mapping):
        return flag(value, "sizes"), None
    return True, root(Section(value, "sizes", ("beside",)).required("beside"), "sizes.beside")


def _tasks(value: Any, where: str) -> dict[str, TaskVariant | ForeignTask | None]:
    """Names of tasks, and what each is where it is no registered one.

    A list of names, in which ``{name: {base, settings}}`` is a task with other settings and
    ``{name: {id, ...}}`` one from outside, or one mapping of all names, those of registered tasks
    with nothing behind them.
    """
    parts = [value] if isinstance(value, Mapping) and value else listed(value, where)
    entries = [
        entry
        for part in parts
        for entry in (part.items() if isinstance(part, Mapping) and part else [(part, None)])
    ]
    names = [checked_name(name, f"each of {where}") for name, _ in entries]
    distinct([name.lower() for name in names], where)
    return {
        name: _task_variant(entry, f"{where}.{name}")
        for name, (_, entry) in zip(names, entries, strict=True)
    }


def _task_variant(value: Any, where: str) -> TaskVariant | ForeignTask | None:
    if value is None or value == {}:
        return None
    if isinstance(value, Mapping) and "id" in value:
        return ForeignTask.read(value, where)
    section = Section(value, where, ("base", "settings"))
    return TaskVariant(
        checked_name(section.required("base"), f"{where}.base"),
        mapping(section.required("settings"), f"{where}.settings"),
    )


def _budget(value: Any, where: str) -> dict[str, int]:
    budget = Section(value, where, FAMILIES).value
    return {name: integer(steps, f"{where}.{name}", 1) for name, steps in budget.items()}


def _variants(value: Any, where: str) -> dict[str, Variant]:
    variants = {}
    for label, entry in labelled(value, where):
        settings = dict(mapping(entry, f"{where}.{label}"))
        if "algorithm" not in settings:
            near = difflib.get_close_matches("algorithm", settings, n=1)
            hint = f"; did you mean it by {near[0]!r}?" if near else ""
            raise UserError(f"{where}.{label} lacks 'algorithm'{hint}")
        algorithm = checked_name(settings.pop("algorithm"), f"{where}.{label}.algorithm")
        role = settings.pop("role", None)
        if "role" in entry and role not in ROLES:
            raise unknown("role", role, ROLES, f"{where}.{label}")
        seeds = None
        if "seeds" in settings:
            seeds = seeds_in(settings.pop("seeds"), f"{where}.{label}.seeds")
        variants[label] = Variant(algorithm, settings, role, seeds)
    if not variants:
        raise UserError(f"{where} is empty")
    return variants


def _task_overrides(value: Any, where: str) -> TaskOverrides:
    section = Section(value, where, ("settings", "budget", "hyperparameters", "interface"))
    families = Section(section.get("hyperparameters", {}), f"{where}.hyperparameters", FAMILIES)
    return TaskOverrides(
        mapping(section.get("settings", {}), f"{where}.settings"),
        _budget(section.get("budget", {}), f"{where}.budget"),
        {
            family: mapping(values, f"{where}.hyperparameters.{family}")
            for family, values in families.value.items()
        },
        Interface.read(section.value["interface"], f"{where}.interface")
        if "interface" in section.value
        else None,
    )


def _sensitivity(value: Any, seeds: Any) -> Sensitivity | None:
    if not value and (value is None or isinstance(value, Mapping)):
        return None
    section = Section(value, "sensitivity", ("task", "algorithm", "points", "seeds"))
    points = []
    for point in listed(section.required("points"), "sensitivity.points"):
        if not isinstance(point, (list, tuple)) or len(point) != 2:
            raise UserError(f"each of sensitivity.points must be a pair [a, b], not {show(point)}")
        a, b = (number(x, "each number of sensitivity.points", 0) for x in point)
        points.append((a, b))
    distinct(points, "sensitivity.points")
    return Sensitivity(
        checked_name(section.required("task"), "sensitivity.task"),
        checked_name(section.required("algorithm"), "sensitivity.algorithm"),
        tuple(points),
        seeds_in(section.get("seeds", seeds), "sensitivity.seeds"),
    )


def _aircraft(value: Any, seeds: Any) -> Aircraft | None:
    if not value and (value is None or isinstance(value, Mapping)):
        return None
    section = Section(value, "aircraft", ("task", "algorithms", "seeds"))
    return Aircraft(
        checked_name(section.get("task", "Aircraft"), "aircraft.task"),
        _variants(section.required("algorithms"), "aircraft.algorithms"),
        seeds_in(section.get("seeds", seeds), "aircraft.seeds"),
    )


def _outside(value: Any, where: str) -> Outside:
    section = Section(value, where, ("algorithm", "version", "steps", "hyperparameters"))
    return Outside(
        checked_name(section.required("algorithm"), f"{where}.algorithm"),
        integer(section.get("version", 1), f"{where}.version", 1),
        integer(section.required("steps"), f"{where}.steps", 1),
        mapping(section.get("hyperparameters", {}), f"{where}.hyperparameters"),
    )


def main(arguments: Sequence[str]) -> None:
    """Check configuration files, each put over the ones before it.

    Raises:
        UserError: as `load` does.
    """
    parser = argparse.ArgumentParser(
        prog="safemr config",
        description="Check configuration files, each put over the ones before it.",
    )
    parser.add_argument("files", nargs="+", metavar="FILE")
    load(parser.parse_args(arguments).files)
