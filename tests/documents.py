"""Documents and records, as tests of what documents say read them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PAIR = ("SafeMR", "JointSIS")


def text_of(document: str) -> str:
    """Without line breaks."""
    return " ".join(document.split())


def column(path: Path, name: str) -> np.ndarray:
    """A column of progress.csv, nan where it has no value."""
    with path.open() as lines:
        return np.array([float(row.get(name) or "nan") for row in csv.DictReader(lines)])


def only(pattern: str) -> Path:
    (path,) = ROOT.glob(f"results/{pattern}/progress.csv")
    return path


def window(path: Path, name: str, low: float, high: float) -> float:
    """Mean over the rows after step ``low`` until ``high``."""
    steps = column(path, "step")
    return float(np.nanmean(column(path, name)[(steps > low) & (steps <= high)]))


def cells(document: str, *first: str) -> list[str]:
    """The cells of the one table row that begins with these."""
    begin = "| " + " | ".join(first) + " |"
    (row,) = (line for line in document.splitlines() if line.startswith(begin))
    return [cell.strip() for cell in row.strip("|").split("|")][len(first) :]
