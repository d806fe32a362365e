"""Resolving a configuration once: `snakemake -n` without importing torch or a simulator.

A plan depends on the configuration and on the sources only, so it is kept in
``<results root>/.work/plan.json`` under a key of both; only plans that passed every check get
there.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

from safemr import atomic, runs
from safemr import tasks as tasks_of
from safemr.config import Config

_SOURCES = Path(__file__).resolve().parents[1]


def plan_for(config: Config) -> runs.Plan:
    """`safemr.runs.resolve`, remembered.

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
    plan = runs.resolve(config)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"key": key, "plan": dataclasses.asdict(plan)})
        atomic.write(path, text.encode(), durable=False)
    except OSError:
        pass  # only slower the next time
    return plan


def _key(config: Config) -> str:
    digest = hashlib.sha256(repr(config).encode())
    for package in ("envs", "safemr"):
        for source in sorted((_SOURCES / package).rglob("*.py")):
            digest.update(source.relative_to(_SOURCES).as_posix().encode() + source.read_bytes())
    return digest.hexdigest()


def _from_json(saved: dict[str, Any]) -> runs.Plan:
    points = {label: (a, b) for label, (a, b) in saved.pop("points").items()}
    tasks = {
        name: tasks_of.Described(task["entry"], tasks_of.Traits(**task["traits"]))
        for name, task in saved.pop("tasks").items()
    }
    groups = {name: tuple(runs.Run(**entry) for entry in group) for name, group in saved.items()}
    return runs.Plan(**groups, points=points, tasks=tasks)
