"""Resolving a configuration once: `snakemake -n` without importing torch or a simulator.

A plan depends on the configuration and on the sources only, so it is kept in
``<results root>/.work/plan.json`` under a key of both; only plans that passed every check get
there.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
from pathlib import Path
from typing import Any

from safemr import files
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
    for task in config.task_variants.values():
        if isinstance(task, ForeignTask):
            for source in _sources(task.id):
                digest.update(source.as_posix().encode() + source.read_bytes())
    return digest.hexdigest()


def _sources(identity: str) -> list[Path]:
    """The files of the package that registers an environment; none where it is not installed."""
    package = identity.rpartition(":")[0].partition(".")[0]
    spec = importlib.util.find_spec(package) if package else None
    if spec is None:
        return []
    if spec.submodule_search_locations is None:
        return [Path(spec.origin)] if spec.origin else []
    folders = map(Path, spec.submodule_search_locations)
    return sorted(source for folder in folders for source in folder.rglob("*.py"))


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
