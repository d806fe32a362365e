"""Printed tables read back: the inverse of `Table.markdown`, to show them in another form."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from safemr.errors import UserError

_BAR = re.compile(r"(?<!\\)\|")  # one inside a cell is written \|
_NUMBER = re.compile(r"[+-]?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?")
_INTERVAL = re.compile(r"(?<=[\d%]) (?:± \d\S*|\[[^\]]*,[^\]]*\])")


@dataclass(frozen=True)
class Printed:
    """What a reader of a table sees; every row has a cell for each heading."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]


def read(path: Path) -> Printed:
    """The table in a file that `Table.write` made.

    Raises:
        UserError: the file cannot be read, or holds something else.
    """
    remedy = f"delete {path} and make it again with `make.py all`"
    try:
        caption, _, *lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is no table of this program ({error}): {remedy}") from error
    rows = [_cells(line) for line in lines if line.startswith("|")]
    notes = tuple(line for line in lines if line and not line.startswith("|"))
    whole = caption.startswith("**") and caption.endswith("**") and len(rows) > 1
    if not whole or {len(row) for row in rows} != {len(rows[0])}:
        raise UserError(f"{path} is no table of this program: {remedy}")
    return Printed(caption[2:-2], rows[0], tuple(rows[2:]), notes)


def number(cell: str) -> float | None:
    """What a cell is sorted by: the number that it begins with, and 0 for "none of 64"."""
    if re.match(r"none of \d", cell):
        return 0.0
    found = _NUMBER.match(cell)
    return float(found[0].replace(",", "")) if found else None


def pieces(cell: str) -> list[tuple[bool, str]]:
    """A cell in pieces that join to it, True before those that are the interval of a number."""
    cut: list[tuple[bool, str]] = []
    end = 0
    for found in _INTERVAL.finditer(cell):
        cut += [(False, cell[end : found.start()]), (True, found[0])]
        end = found.end()
    return [(is_interval, text) for is_interval, text in [*cut, (False, cell[end:])] if text]


def _cells(line: str) -> tuple[str, ...]:
    return tuple(cell.strip().replace("\\|", "|") for cell in _BAR.split(line)[1:-1])
