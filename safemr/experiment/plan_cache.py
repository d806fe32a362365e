"""Resolving a configuration once: `snakemake -n` without importing torch or a simulator.

A plan depends on the configuration and on the sources only, so it is kept in
``<results root>/.work/plan.json`` under a key of both; only plans that passed every check get
there.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from typing import Any

from safemr import files, packages
from safemr import tasks as tasks_of
from safemr.experiment import planning
from safemr.experiment.config import Config
from safemr.experiment.roles import Variants
from safemr.experiment.task_entries import ForeignTask
from safemr.files import REPOSITORY


def plan_for(config: Config) -> planning.Plan:
    """`safemr.experiment.planning.resolve`, remembered.

    Raises:
        UserError: as `resolve` does.
    """
    path = config.results_root / ".work" / "plan.json"
    key = _key(config)
    try:
        saved = json.loads(path.read_text())
        if saved["key"] == key:
            return _from_json(saved["plan"])
    except (OSError, ValueError, KeyError, TypeError):
        pass  # absent, damaged or of another version: resolve it again
    plan = planning.resolve(config)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"key": key, "plan": dataclasses.asdict(plan)})
        files.write(path, text.encode(), durable=False)
    except OSError:
        pass  # only slower the next time
    return plan


def _key(config: Config) -> str:
    digest = hashlib.sha256(repr(config).encode())
    for package in ("envs", "safemr"):
        for source in sorted((REPOSITORY / package).rglob("*.py")):
            digest.update(source.relative_to(REPOSITORY).as_posix().encode() + source.read_bytes())
    for module in _modules(config):
        digest.update(f"{module}:{packages.digest(module)}".encode())
    return digest.hexdigest()


def _modules(config: Config) -> list[str]:
    """The modules of other packages that a configuration names: algorithms, energies, tasks."""
    parts = (config.algorithms, config.aircraft.algorithms if config.aircraft else {})
    variants = [variant for part in parts for variant in part.values()]
    chosen = [variant.overrides for variant in variants]
    for overrides in config.task_overrides.values():
        chosen += overrides.hyperparameters.values()
    named = {
        packages.ALGORITHMS: {variant.algorithm for variant in variants},
        packages.CERTIFICATES: {str(each["family"]) for each in chosen if "family" in each},
    }
    modules = {
        packages.registered(group).get(name, name) if "." not in name else name
        for group, names in named.items()
        for name in names
    }
    tasks = [task for task in config.task_variants.values() if isinstance(task, ForeignTask)]
    registering = {task.id.rpartition(":")[0] for task in tasks} - {""}
    return sorted({*filter(packages.is_outside, modules), *registering})


def _from_json(saved: dict[str, Any]) -> planning.Plan:
    points = {label: (a, b) for label, (a, b) in saved.pop("points").items()}
    tasks = {
        name: tasks_of.Described(task["entry"], tasks_of.Traits(**task["traits"]))
        for name, task in saved.pop("tasks").items()
    }
    parts = {name: Variants(**saved.pop(name)) for name in ("grid", "encounter")}
    groups = {
        name: tuple(planning.Run(**entry) for entry in group) for name, group in saved.items()
    }
    return planning.Plan(**groups, points=points, tasks=tasks, **parts)
