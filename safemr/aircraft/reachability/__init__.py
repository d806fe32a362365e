"""The true unsafe set of the aircraft encounter: solver, analytic barrier, grid-free bound."""

from __future__ import annotations

from safemr.aircraft.reachability.grid import Grid
from safemr.aircraft.reachability.solver import (
    ADVERSARIAL,
    CASES,
    CONSTANT,
    VERSION,
    Solution,
    load_or_solve,
    solve,
)

__all__ = [
    "ADVERSARIAL",
    "CASES",
    "CONSTANT",
    "VERSION",
    "Grid",
    "Solution",
    "load_or_solve",
    "solve",
]
