"""Unsafe sets in a plane of constant psi, as drawings read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from safemr import paper

Array = NDArray[Any]


@dataclass(frozen=True)
class Slice:
    """Everything at one heading difference psi [rad]; arrays [X, Y]."""

    psi: float
    truth: Array
    handcrafted: Array
    learned: Mapping[str, Sequence[Array]]  # variant -> one array a seed
    adversarial: Array | None = None  # V against adversarial traffic
    method: str = paper.METHOD  # the one of the learned that is drawn in a whole line
