"""A regular grid over relative states (x, y, psi), periodic in psi, and interpolation on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.compiled import njit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Grid:
    """Nodes at both ends of x and y, and at psi = 0, 2 pi / N, ... (2 pi is node 0 again).

    A number of angles divisible by six puts nodes on the six slices that are compared.
    """

    x_range: tuple[float, float] = (-6.0, 20.0)
    y_range: tuple[float, float] = (-13.0, 13.0)
    shape: tuple[int, int, int] = (197, 197, 120)  # nodes in x, y, psi

    def __post_init__(self) -> None:
        for name, (low, high) in (("x_range", self.x_range), ("y_range", self.y_range)):
            if not (np.isfinite(low) and np.isfinite(high) and low < high):
                raise ValueError(f"{name} must be an interval, not ({low}, {high})")
        if len(self.shape) != 3 or min(self.shape) < 2:
            raise ValueError(f"shape must be three counts of at least 2, not {self.shape}")

    @property
    def x(self) -> Floats:
        return np.linspace(*self.x_range, self.shape[0])

    @property
    def y(self) -> Floats:
        return np.linspace(*self.y_range, self.shape[1])

    @property
    def psi(self) -> Floats:
        return np.linspace(0.0, 2 * np.pi, self.shape[2], endpoint=False)

    @property
    def spacing(self) -> tuple[float, float, float]:
        """Steps in x [m], y [m] and psi [rad]."""
        (x0, x1), (y0, y1), (nx, ny, npsi) = self.x_range, self.y_range, self.shape
        return (x1 - x0) / (nx - 1), (y1 - y0) / (ny - 1), 2 * np.pi / npsi

    def plane(self) -> Floats:
        """Positions [nx, ny, 2] of one slice of constant psi."""
        return np.stack(np.meshgrid(self.x, self.y, indexing="ij"), axis=-1)

    def contains(self, states: Floats) -> NDArray[np.bool_]:
        """Whether the positions of states [..., 3] (or [..., 2]) are on the grid."""
        x, y = states[..., 0], states[..., 1]
        inside_x = (x >= self.x_range[0]) & (x <= self.x_range[1])
        return inside_x & (y >= self.y_range[0]) & (y <= self.y_range[1])

    def interpolate(self, values: NDArray[np.float32], states: Floats) -> Floats:
        """Trilinear interpolation of values [npsi, nx, ny] at states [..., 3].

        Positions off the grid raise ValueError; psi is taken modulo 2 pi.
        """
        if not np.all(self.contains(states)):
            raise ValueError(f"states outside x {self.x_range}, y {self.y_range} of the grid")
        flat = np.ascontiguousarray(states.reshape(-1, 3))
        low = np.array([self.x_range[0], self.y_range[0]])
        return _trilinear(values, flat, low, np.array(self.spacing)).reshape(states.shape[:-1])

    def as_dict(self) -> dict[str, Any]:
        """The grid in plain types, for file names and headers."""
        return {"x": list(self.x_range), "y": list(self.y_range), "shape": list(self.shape)}


@njit()
def _trilinear(
    values: NDArray[np.float32], states: Floats, low: Floats, spacing: Floats
) -> Floats:  # pragma: no cover - compiled
    npsi, nx, ny = values.shape
    result = np.empty(len(states))
    for s in range(len(states)):
        u = (states[s, 0] - low[0]) / spacing[0]
        v = (states[s, 1] - low[1]) / spacing[1]
        w = (states[s, 2] / spacing[2]) % npsi
        i, j = min(int(u), nx - 2), min(int(v), ny - 2)
        lower = min(int(w), npsi - 1)
        upper = (lower + 1) % npsi
        u, v, w = u - i, v - j, w - lower
        total = 0.0
        for plane, weight in ((lower, 1.0 - w), (upper, w)):
            near = (1.0 - v) * values[plane, i, j] + v * values[plane, i, j + 1]
            far = (1.0 - v) * values[plane, i + 1, j] + v * values[plane, i + 1, j + 1]
            total += weight * ((1.0 - u) * near + u * far)
        result[s] = total
    return result
