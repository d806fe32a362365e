"""What a run asks of a machine or a scheduler, by its configuration alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# Peaks in MB: of a trainer in one process 958, and 141 for each Snakemake around it; Ray's own
# processes and its store; each of the parallel trainer's.
ALONE, OF_RAY = 1500, 500
EACH = {"samplers": 550, "buffers": 500, "learners": 550}


def _counts(config: Mapping[str, Any]) -> dict[str, int]:
    """The parallel trainer's processes (`safemr.parallel`) of each kind; none for other runs."""
    values = config["algorithm"]["hyperparameters"]
    return {kind: int(values[kind]) for kind in EACH} if EACH.keys() <= values.keys() else {}


def cores(config: Mapping[str, Any]) -> int:
    """Cores of a run: one, or one a process."""
    return 1 + sum(_counts(config).values())


def memory_mb(config: Mapping[str, Any]) -> int:
    """Memory of a run [MB]."""
    counts = _counts(config)
    processes = sum(EACH[kind] * count for kind, count in counts.items())
    return ALONE + (OF_RAY + processes if counts else 0)
