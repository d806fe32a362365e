"""Runs that were begun and have no record yet, as their work folders tell; no torch is imported.

A run works in ``<results root>/.work/<digest>/`` (`safemr.experiment.checkpoints`), which goes when
its record is written, so what is read here may vanish meanwhile.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from safemr.experiment import records
from safemr.experiment.locks import is_held

ATTEMPTS, LOCK = "attempts.jsonl", "lock"


class Begun(NamedTuple):
    """A run that was begun."""

    work: Path  # its folder, named by the run's digest
    label: str  # ``SafeMR Pillars-0.15-Goal seed 0``
    rows: Sequence[records.Row]  # logged so far
    running: bool  # whether a live process holds it
    failure: str | None  # why training cannot go on

    @property
    def step(self) -> int:
        """The step of its last row."""
        return int(self.rows[-1]["step"]) if self.rows else 0

    def last(self, metric: str) -> float:
        """The newest value of a metric that is not logged in every row; nan before the first."""
        logged = (row.get(metric, float("nan")) for row in reversed(self.rows))
        return next((value for value in logged if value == value), float("nan"))

    @property
    def seconds_per_step(self) -> float:
        """Wall seconds a step so far, evaluations included; nan before the first row."""
        return self.last("time_wall_s") / self.step if self.step else float("nan")


def read_attempts(work: Path) -> list[dict[str, Any]]:
    """The attempts at an unfinished run, and how they failed; a torn line is left out."""
    events = []
    for line in (work / ATTEMPTS).read_text().splitlines():
        with contextlib.suppress(ValueError):
            events.append(json.loads(line))
    return events


def begun(root: Path) -> Iterator[Begun]:
    """Every run that was begun under a results root, in the order of their digests."""
    for work in sorted(path for path in (root / ".work").glob("*") if path.is_dir()):
        try:
            last = read_attempts(work)[-1]
        except (OSError, IndexError):
            continue
        rows: Sequence[records.Row] = ()
        with contextlib.suppress(OSError, ValueError):  # none is logged yet
            rows = records.parse_progress((work / records.PROGRESS).read_text())
        yield Begun(work, last["run"], rows, is_held(work / LOCK), last.get("reason"))
