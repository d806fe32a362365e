"""A small record, for the tests of what is written and what is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from safemr.experiment import records

CONFIG: dict[str, Any] = {
    "schema": 1,
    "task": {"name": "Pillars-0.15-Goal", "version": 1, "settings": {}},
    "algorithm": {"name": "fac", "version": 1, "hyperparameters": {"gamma": 0.99}},
    "seed": 100,
    "steps": 20,
    "log_every": 10,
    "evaluation": {"every": 10, "episodes": 2, "seed": 10000},
}
ROWS = [
    {"step": step, "eval_return": 0.1, "eval_cost": 0.0, "eval_zero_violation_share": 1.0}
    for step in (10, 20)
]
POLICY = {"weights": np.arange(6.0, dtype=np.float32).reshape(2, 3)}


def make_record(root: Path, **changes: Any) -> Path:
    config = {**CONFIG, **changes}
    folder = root / records.record_path(config, "FAC-phih")
    records.write_record(folder, config, "FAC-phih", ROWS, {}, POLICY)
    return folder
