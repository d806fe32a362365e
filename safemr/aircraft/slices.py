"""Unsafe sets in a plane of constant psi, as drawings read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
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


def near_boundary(values: NDArray[Any]) -> NDArray[np.float16]:
    """Values as a picture of their zero level needs them, a quarter of the size: cut at +-1.

    Half precision is exact to 0.0005 there, and the finer the nearer to the boundary.
    """
    return np.clip(values, -1.0, 1.0).astype(np.float16)
