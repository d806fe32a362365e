"""The configuration file: what may be written in it, and clear errors for everything else.

`load` reads ``config/config.yaml`` (and what ``--configfile`` and ``--config`` put over it) into a
`Config`: structure, types and ranges. Names of tasks, algorithms and hyperparameters are checked
where they are resolved into runs, in `safemr.runs`. Nothing here imports torch or an environment.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safemr.errors import UserError
from safemr.strict_yaml import read_yaml, show, typed

FAMILIES = ("off_policy", "on_policy")
WANDB_MODES = ("disabled", "offline", "online")
LARGEST_SEED = 2**31 - 1
LARGEST_COUNT = 10**10
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,59}")
_ROOT = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*(/[A-Za-z0-9_][A-Za-z0-9._-]*)*")
_SOURCES = {"benchmarks", "config", "docs", "envs", "profiles", "safemr", "tests", "workflow"}


@dataclass(frozen=True)
class Variant:
    """One entry of ``algorithms``: a module of `safemr.algorithms` and what differs from it."""

    algorithm: str
    overrides: Mapping[str, Any]


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
class Evaluation:
    """The deterministic evaluation: how often in a run, how many episodes, which first seed."""

    points: int
    episodes: int
    seed: int


@dataclass(frozen=True)
class UnseenLayouts:
    """Final policies on layouts that no run was evaluated on: how many, and the first seed."""

    episodes: int
    seed: int


@dataclass(frozen=True)
class Config:
    """A validated configuration; see config/config.yaml for the meaning of each key."""

    tasks: tuple[str, ...]
    task_variants: Mapping[str, TaskVariant]  # of those tasks that are not registered ones
    algorithms: Mapping[str, Variant]
    seeds: tuple[int, ...]
    budget: Mapping[str, int]
    log_points: int
    evaluation: Evaluation
    unseen_layouts: UnseenLayouts | None
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
    top = _Section(raw, "the config", _TOP_LEVEL)
    evaluation = _Section(top.required("evaluation"), "evaluation", ("points", "episodes", "seed"))
    wandb = _Section(top.get("wandb", {}), "wandb", ("mode", "project"))
    safe = _Section(top.get("safe", {}), "safe", ("cost_tolerance", "zero_violation_share"))
    tasks = _tasks(top.required("tasks"), "tasks")
    mode = wandb.get("mode", "disabled")
    if mode not in WANDB_MODES:
        raise unknown("wandb mode", mode, WANDB_MODES)
    config = Config(
        tasks=tuple(tasks),
        task_variants={name: variant for name, variant in tasks.items() if variant},
        algorithms=_variants(top.required("algorithms"), "algorithms"),
        seeds=_seeds(top.required("seeds"), "seeds"),
        budget=_budget(top.required("budget"), "budget"),
        log_points=_integer(top.get("log_points", 50), "log_points", 1),
        evaluation=Evaluation(
            _integer(evaluation.required("points"), "evaluation.points", 1),
            _integer(evaluation.required("episodes"), "evaluation.episodes", 1),
            _integer(evaluation.get("seed", 10_000), "evaluation.seed", 0, LARGEST_SEED),
        ),
        unseen_layouts=_unseen(top.get("unseen_layouts")),
        task_overrides={
            name: _task_overrides(value, f"task_overrides.{name}")
            for name, value in _labelled(top.get("task_overrides", {}), "task_overrides")
        },
        sensitivity=_sensitivity(top.get("sensitivity"), top.required("seeds")),
        aircraft=_aircraft(top.get("aircraft"), top.required("seeds")),
        outside={
            label: _outside(value, f"outside.{label}")
            for label, value in _labelled(top.get("outside", {}), "outside")
        },
        results_root=_root(top.get("results_root", "results"), "results_root"),
        figures_root=_root(top.get("figures_root", "paper_figures"), "figures_root"),
        allow_missing=_flag(top.get("allow_missing", False), "allow_missing"),
        wandb_mode=mode,
        wandb_project=checked_name(wandb.get("project", "safemr"), "wandb.project"),
        cost_tolerance=_number(safe.get("cost_tolerance", 1.0), "safe.cost_tolerance", 0, math.inf),
        zero_violation_share=_number(
            safe.get("zero_violation_share", 0.95), "safe.zero_violation_share", 0, 1
        ),
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


def unknown(kind: str, name: Any, known: Iterable[str], where: str = "") -> UserError:
    """The error for a name that does not exist, with the nearest one that does."""
    names = sorted(known)
    close = difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)
    listing = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    remedy = f"did you mean {close[0]!r}?" if close else f"there is {listing or 'none'}"
    return UserError(f"unknown {kind} {show(name)}{' in ' + where if where else ''}; {remedy}")


_TOP_LEVEL = (
    "tasks", "algorithms", "seeds", "budget", "log_points", "evaluation", "unseen_layouts",
    "task_overrides", "sensitivity", "aircraft", "outside", "results_root", "figures_root",
    "allow_missing", "wandb", "safe",
)  # fmt: skip


class _Section:
    """A mapping with a fixed set of keys."""

    def __init__(self, value: Any, where: str, known: Collection[str]) -> None:
        self.where = where
        self.value = _mapping(value, where)
        for key in self.value:
            if key not in known:
                raise unknown("key", key, known, where)

    def required(self, key: str) -> Any:
        if key not in self.value:
            raise UserError(f"{self.where} lacks {key!r}")
        return self.value[key]

    def get(self, key: str, default: Any = None) -> Any:
        return self.value.get(key, default)


def _mapping(value: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise UserError(f"{where} must be a mapping, not {show(value)}")
    for key in value:
        if not isinstance(key, str):
            raise UserError(f"{where}: the key {show(key)} must be text; put it in quotes")
    return value


def _labelled(value: Any, where: str) -> list[tuple[str, Any]]:
    items = [
        (checked_name(key, f"a name in {where}"), item)
        for key, item in _mapping(value, where).items()
    ]
    _distinct([key.lower() for key, _ in items], where)
    return items


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, (list, tuple)):
        raise UserError(f"{where} must be a list, not {show(value)}")
    if not value:
        raise UserError(f"{where} is empty")
    return list(value)


def _distinct(items: Sequence[Any], where: str) -> None:
    for index, item in enumerate(items):
        if item in items[:index]:
            raise UserError(f"{where} names {show(item)} twice")


def checked_name(value: Any, where: str) -> str:
    """A name as folders, figures and rules can hold it. Raises UserError for anything else."""
    if not isinstance(value, str) or not _NAME.fullmatch(value):
        raise UserError(
            f"{where} must consist of letters, digits and . _ + - (60 at most, not beginning with "
            f"a sign), not {show(value)}"
        )
    return value


def _tasks(value: Any, where: str) -> dict[str, TaskVariant | None]:
    """Names of tasks, and what each is where it is no registered one.

    A list of names, in which ``{name: {base, settings}}`` is a task with other settings, or one
    mapping of all names, those of registered tasks with nothing behind them.
    """
    parts = [value] if isinstance(value, Mapping) and value else _list(value, where)
    entries = [
        entry
        for part in parts
        for entry in (part.items() if isinstance(part, Mapping) and part else [(part, None)])
    ]
    names = [checked_name(name, f"each of {where}") for name, _ in entries]
    _distinct([name.lower() for name in names], where)
    return {
        name: _task_variant(entry, f"{where}.{name}")
        for name, (_, entry) in zip(names, entries, strict=True)
    }


def _task_variant(value: Any, where: str) -> TaskVariant | None:
    if value is None or value == {}:
        return None
    section = _Section(value, where, ("base", "settings"))
    return TaskVariant(
        checked_name(section.required("base"), f"{where}.base"),
        _mapping(section.required("settings"), f"{where}.settings"),
    )


def _integer(value: Any, where: str, low: int, high: int = LARGEST_COUNT) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise UserError(f"{where} must be an integer, not {show(value)}")
    if not low <= value <= high:
        raise UserError(f"{where} = {show(value)} must lie in [{low}, {high}]")
    return value


def _flag(value: Any, where: str) -> bool:
    if not isinstance(value, bool):
        raise UserError(f"{where} must be true or false, not {show(value)}")
    return value


def _number(value: Any, where: str, low: float = -math.inf, high: float = math.inf) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise UserError(f"{where} must be a number, not {show(value)}")
    if not low <= value <= high or not abs(value) < 1e300:
        raise UserError(f"{where} = {show(value)} must be finite and lie in [{low:g}, {high:g}]")
    return float(value)


def _seeds(value: Any, where: str) -> tuple[int, ...]:
    items = _list(value, where)
    seeds = tuple(_integer(item, f"each of {where}", 0, LARGEST_SEED) for item in items)
    _distinct(seeds, where)
    return seeds


def _budget(value: Any, where: str) -> dict[str, int]:
    budget = _Section(value, where, FAMILIES).value
    return {name: _integer(steps, f"{where}.{name}", 1) for name, steps in budget.items()}


def _variants(value: Any, where: str) -> dict[str, Variant]:
    variants = {}
    for label, entry in _labelled(value, where):
        settings = dict(_mapping(entry, f"{where}.{label}"))
        if "algorithm" not in settings:
            near = difflib.get_close_matches("algorithm", settings, n=1)
            hint = f"; did you mean it by {near[0]!r}?" if near else ""
            raise UserError(f"{where}.{label} lacks 'algorithm'{hint}")
        variants[label] = Variant(
            checked_name(settings.pop("algorithm"), f"{where}.{label}.algorithm"), settings
        )
    if not variants:
        raise UserError(f"{where} is empty")
    return variants


def _task_overrides(value: Any, where: str) -> TaskOverrides:
    section = _Section(value, where, ("settings", "budget", "hyperparameters"))
    families = _Section(section.get("hyperparameters", {}), f"{where}.hyperparameters", FAMILIES)
    return TaskOverrides(
        _mapping(section.get("settings", {}), f"{where}.settings"),
        _budget(section.get("budget", {}), f"{where}.budget"),
        {
            family: _mapping(values, f"{where}.hyperparameters.{family}")
            for family, values in families.value.items()
        },
    )


def _unseen(value: Any) -> UnseenLayouts | None:
    if not value and (value is None or isinstance(value, Mapping)):
        return None
    section = _Section(value, "unseen_layouts", ("episodes", "seed"))
    return UnseenLayouts(
        _integer(section.required("episodes"), "unseen_layouts.episodes", 1),
        _integer(section.get("seed", 20_000), "unseen_layouts.seed", 0, LARGEST_SEED),
    )


def _sensitivity(value: Any, seeds: Any) -> Sensitivity | None:
    if not value and (value is None or isinstance(value, Mapping)):
        return None
    section = _Section(value, "sensitivity", ("task", "algorithm", "points", "seeds"))
    points = []
    for point in _list(section.required("points"), "sensitivity.points"):
        if not isinstance(point, (list, tuple)) or len(point) != 2:
            raise UserError(f"each of sensitivity.points must be a pair [a, b], not {show(point)}")
        a, b = (_number(x, "each number of sensitivity.points", 0) for x in point)
        points.append((a, b))
    _distinct(points, "sensitivity.points")
    return Sensitivity(
        checked_name(section.required("task"), "sensitivity.task"),
        checked_name(section.required("algorithm"), "sensitivity.algorithm"),
        tuple(points),
        _seeds(section.get("seeds", seeds), "sensitivity.seeds"),
    )


def _aircraft(value: Any, seeds: Any) -> Aircraft | None:
    if not value and (value is None or isinstance(value, Mapping)):
        return None
    section = _Section(value, "aircraft", ("task", "algorithms", "seeds"))
    return Aircraft(
        checked_name(section.get("task", "Aircraft"), "aircraft.task"),
        _variants(section.required("algorithms"), "aircraft.algorithms"),
        _seeds(section.get("seeds", seeds), "aircraft.seeds"),
    )


def _outside(value: Any, where: str) -> Outside:
    section = _Section(value, where, ("algorithm", "version", "steps", "hyperparameters"))
    return Outside(
        checked_name(section.required("algorithm"), f"{where}.algorithm"),
        _integer(section.get("version", 1), f"{where}.version", 1),
        _integer(section.required("steps"), f"{where}.steps", 1),
        _mapping(section.get("hyperparameters", {}), f"{where}.hyperparameters"),
    )


def _root(value: Any, where: str) -> Path:
    if not isinstance(value, str) or not _ROOT.fullmatch(value):
        raise UserError(
            f"{where} must be a relative path of plain names (no '..', no hidden folder), "
            f"not {show(value)}"
        )
    if Path(value).parts[0] in _SOURCES:
        raise UserError(f"{where} = {value!r} lies among the sources; choose another folder")
    if Path(value).exists() and not Path(value).is_dir():
        raise UserError(f"{where} = {value!r} is a file; choose a folder")
    return Path(value)


def main(arguments: Sequence[str]) -> None:
    """Check configuration files, each put over the ones before it.

    Raises:
        UserError: as `load` does.
    """
    load(arguments)
