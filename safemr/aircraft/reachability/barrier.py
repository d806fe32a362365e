"""The analytic barrier: the surfaces of which the unsafe set's boundary is made.

The encounter is lost where the separation is d_min and cannot be kept from falling. That part of
the collision circle is bounded by d_dot = 0. For equal speeds these are two curves

    (x, y) = +- d_min (cos(psi / 2), sin(psi / 2)),    0 < psi < 2 pi,

and the whole circle at psi = 0, where both fly in parallel and the separation rests. Followed
backwards with the turn rates that are optimal there, they sweep out sheets (Mitchell, Bayen and
Tomlin 2005, section V, after Merz 1972): from the + curve, traffic to the left, the evader turns
right, a = -1; from the - curve it turns left; from parallel flight (traffic of constant rate only)
away from the traffic's rate. Each state on a sheet can be flown to contact and no nearer, so
V >= 0 on all of them: V = 0 up to where two of them meet, V > 0 beyond. For constant traffic they
are the whole boundary. Only the exact flow enters, no grid: the sheets are an independent test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from envs.aircraft import AircraftDynamics
from safemr.aircraft.reachability.grid import Floats
from safemr.aircraft.reachability.solver import Solution


@dataclass(frozen=True)
class _Sheet:
    """One family of characteristics: turn rates (a, b) backwards from a curve of contact."""

    name: str
    side: float  # of the curve: +1, -1, or 0 for parallel flight
    a: float
    b: float

    def contact(self, d_min: float, angle: Floats) -> Floats:
        """States [..., 3] of the curve: ``angle`` is psi, or the bearing in parallel flight."""
        if self.side == 0:
            x, y, psi = np.cos(angle), np.sin(angle), np.zeros_like(angle)
        else:
            x, y, psi = self.side * np.cos(angle / 2), self.side * np.sin(angle / 2), angle
        return np.stack([d_min * x, d_min * y, psi], axis=-1)


def _families(dynamics: AircraftDynamics) -> list[_Sheet]:
    if dynamics.speed != dynamics.other_speed:
        raise ValueError("the barrier is known in closed form for equal speeds only")
    families = []
    for name, side, others in (("+", 1.0, max), ("-", -1.0, min)):
        a, b = -side * dynamics.turn_limit, others(dynamics.other_turns)
        families.append(_Sheet(name, side, a, b))
        # Equal rates never leave parallel flight. Traffic that reacts would not fly into it at one
        # rate: there the boundary has a part, between + and -, that is not covered here.
        if a != b and len(dynamics.other_turns) == 1:
            families.append(_Sheet(f"parallel {name}", 0.0, a, b))
    return families


def _characteristics(
    dynamics: AircraftDynamics, sheet: _Sheet, angle: Floats, tau: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """States [m, n, 3] at times ``tau`` [m, n] before contact at ``angle`` [m].

    Also whether the separation was at least d_min at all of a path's times up to that one.
    """
    contact = sheet.contact(dynamics.d_min, angle)[:, None, :]
    states = dynamics.flow(contact, sheet.a, sheet.b, -tau)
    clear = np.logical_and.accumulate(dynamics.separation(states) >= dynamics.d_min - 1e-9, axis=1)
    states[..., 2] %= 2 * np.pi
    return states, clear


def sheets(
    dynamics: AircraftDynamics, angles: int = 360, times: int = 60, horizon: float = 2.8
) -> dict[str, Floats]:
    """States [n, 3] of each sheet: ``angles`` characteristics of ``times`` points over ``horizon``.

    Raises ValueError for unequal speeds.
    """
    angle = np.linspace(0.0, 2 * np.pi, angles, endpoint=False) + np.pi / angles
    tau = np.tile(np.linspace(0.0, horizon, times), (angles, 1))
    result = {}
    for sheet in _families(dynamics):
        states, clear = _characteristics(dynamics, sheet, angle, tau)
        result[sheet.name] = states[clear]
    return result


def slice_curves(
    dynamics: AircraftDynamics, psi: float, points: int = 561, horizon: float = 2.8
) -> dict[str, Floats]:
    """Positions [n, 2] in which the sheets cut the plane of heading difference ``psi``."""
    result = {}
    for sheet in _families(dynamics):
        closing = sheet.b - sheet.a  # d psi / dt
        if sheet.side == 0:
            angle = np.linspace(0.0, 2 * np.pi, points)
            end = np.full(points, (np.sign(closing) * -psi) % (2 * np.pi) / abs(closing))
        else:
            end = np.linspace(0.0, horizon, points)
            angle = (psi + closing * end) % (2 * np.pi)
        # Along each path to its end, to see that it stays clear of the disc.
        tau = end[:, None] * np.linspace(0.0, 1.0, 57)
        states, clear = _characteristics(dynamics, sheet, angle, tau)
        result[sheet.name] = states[clear[:, -1] & (end <= horizon), -1, :2]
    return result


def boundary_error(
    solution: Solution, degrees: Sequence[float] = (60, 120, 180, 240, 300)
) -> float:
    """Largest distance [m] from a solution's boundary to the barrier or the collision circle.

    Over slices of constant psi, for traffic of constant turn rate, whose barrier is complete.
    Raises ValueError for other traffic.
    """
    if len(solution.dynamics.other_turns) != 1:
        raise ValueError("the barrier is complete for traffic of constant turn rate only")
    grid, errors = solution.grid, []
    plane = grid.plane()
    for psi in np.radians(degrees):
        value = solution(np.concatenate([plane, np.full((*plane.shape[:2], 1), psi)], axis=-1))
        row, column = np.nonzero((value[:-1] <= 0) != (value[1:] <= 0))
        share = value[row, column] / (value[row, column] - value[row + 1, column])
        crossing = plane[row, column] + share[:, None] * np.array([grid.spacing[0], 0.0])
        to_disc = np.abs(np.linalg.norm(crossing, axis=-1) - solution.dynamics.d_min)
        curves = np.concatenate(list(slice_curves(solution.dynamics, psi).values()))
        to_sheet = np.linalg.norm(crossing[:, None] - curves[None], axis=-1).min(axis=1)
        errors.append(np.minimum(to_disc, to_sheet).max())
    return float(max(errors))
