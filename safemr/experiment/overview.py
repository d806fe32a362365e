"""What stands under a results root: records, those with a fault, and unfinished runs; as text."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from safemr.experiment.begun import begun
from safemr.experiment.record import Record
from safemr.experiment.records import RecordError


def opened(root: Path) -> Iterator[Record | RecordError]:
    """Every record under a results root, or what is wrong with it, in the order of folders."""
    for folder in sorted(path for path in root.glob("runs/*/*/*") if path.is_dir()):
        try:
            yield Record.open(folder)
        except RecordError as error:
            yield error


def unfinished(root: Path) -> Iterator[str]:
    """One line for each run that was begun and has no record yet."""
    for run in begun(root):
        state = "in training" if run.running else "unfinished"
        state = f"failed: {run.failure}" if run.failure is not None else state
        yield f"{run.label} ({run.work}) {state}, at step {run.step}"


def aligned(rows: Sequence[Sequence[str]], left: int) -> list[str]:
    """Rows of cells as lines of columns: the first ``left`` ones flush left, the others right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            cell.ljust(width) if index < left else cell.rjust(width)
            for index, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def number(value: float, digits: int = 2) -> str:
    """A number in a cell; a dash where there is none."""
    return "-" if value != value else f"{value:.{digits}f}"
