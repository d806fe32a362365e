"""How small may a certificate be? Feasibility on every motion that the robot can get into.

`Encounters` are one obstacle and every motion of `safemr.certificates.reachable` at a grid of
places: distances from d_min on, bearings all around. A certificate is feasible there where each of
them has an action of the grid of `safemr.certificates.falsification` with g < 0 (Eq. cstr0).
`smallest` is the member of a family, on a grid of its parameters, of the least `unsafe_area` that
is feasible: what a certificate of this family can give at best, and the yardstick for learned ones.

A certificate that fails here fails on a state with a trajectory from rest (in free space). One that
passes may fail between the grid's points; a finer grid is an argument away.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr.certificates.energy import constraint
from safemr.certificates.falsification import action_grid, largest_distance, overlaps_obstacle
from safemr.certificates.families import EnergyFamily, Parameters, phi_at
from safemr.certificates.reachable import CELL, reachable, responses
from safemr.errors import UserError
from safemr.tasks import traits

Array = NDArray[np.float64]

BEARINGS, SPACING = 36, 0.03  # places: directions, and metres between distances
NEAR = (0.0, 0.003, 0.01)  # and these beyond d_min, where the nose turns close to the obstacle
CHUNK = 2**17  # places at once
POINTS, ZOOMS = 16, 3  # of the search: values of a parameter, and finer grids around the best
REMEMBERED = 256  # of the places that refuted a certificate, kept for the next


@dataclass(frozen=True)
class Verdict:
    """A certificate at all encounters of a set."""

    examined: int
    infeasible: int  # without an action of the grid that keeps g < 0
    worst: float  # the largest of the least g among those; -inf where there is none
    state: Array  # [5] as in `safemr.certificates.falsification`, of the worst; nan: none
    motion: int  # its index among the reachable motions; -1: none

    @property
    def feasible(self) -> bool:
        return self.infeasible == 0


class Encounters:
    """A task's robot in every reachable motion near one obstacle.

    envs: `falsification.make_simulator` of the task, asked for d_min and what its obstacles are;
    ``action_repeat`` and ``action_scale``: the learner's decisions. By the mirror symmetry of
    robot and obstacle only motions that turn to the left are looked at.
    """

    def __init__(
        self,
        envs: Any,
        action_repeat: int = 1,
        action_scale: Sequence[float] = (),
        *,
        cell: tuple[float, float, float] = CELL,
        bearings: int = BEARINGS,
        spacing: float = SPACING,
    ) -> None:
        """Raises UserError for an environment without the point robot."""
        if not traits(envs).point_robot:
            raise UserError("the motions that can be reached are known of the point robot alone")
        self.d_min, self.action_repeat = float(envs.d_min), action_repeat
        self.reachable = reachable(action_repeat, tuple(action_scale), cell)
        motions = self.reachable.representatives
        self._of = np.flatnonzero(motions[:, 2] >= 0)
        self.motions = motions[self._of]
        actions = action_grid(self.motions[:, 2], action_scale)
        self._moved, self._velocity, _ = responses(self.motions, actions, action_repeat)
        self._bearings = 2 * np.pi * (np.arange(bearings) + 0.5) / bearings - np.pi
        self._spacing = spacing
        self._envs = envs
        # How many encounters an action has kept that none before it did: the best are tried first.
        self._kept = np.zeros(actions.shape[1], np.int64)
        self.hard = np.zeros((0, 3))  # motion, place: some of what refuted certificates before
        self._speeds = np.hypot(self.motions[:, 0], self.motions[:, 1])

    def verdict(self, zeta: Parameters, eta: float = 0.0) -> Verdict:
        """All encounters up to where phi < 0 at any speed.

        Raises UserError where phi stays positive far from the obstacle.
        """
        examined = infeasible = motion = 0
        worst, worst_place = -np.inf, np.full(2, np.nan)
        hard = []
        for rows, places in self._places(zeta):
            left, least = self._without_safe_action(rows, places, zeta, eta)
            examined += len(rows)
            infeasible += len(left)
            if len(left):
                hard.append(np.column_stack([rows[left], places[left]])[:REMEMBERED])
                top = int(least.argmax())
                if least[top] > worst:
                    worst, worst_place = float(least[top]), places[left[top]]
                    motion = int(rows[left[top]])
        if hard:
            self._remember(np.concatenate(hard))
        found = np.isfinite(worst)
        state = self._state(motion, worst_place) if found else np.full(5, np.nan)
        index = int(self._of[motion]) if found else -1
        return Verdict(examined, infeasible, worst, state, index)

    def refuted(self, zeta: Parameters, eta: float = 0.0) -> bool:
        """Whether a place that refuted another certificate refutes this one: what is quickly
        told, True always being right."""
        rows, places = self.hard[:, 0].astype(int), self.hard[:, 1:]
        near = np.hypot(*places.T) <= largest_distance(zeta, self.d_min, self.action_repeat)
        for part in np.array_split(np.flatnonzero(near), 1 + len(rows) // REMEMBERED):
            if len(part) and len(self._without_safe_action(rows[part], places[part], zeta, eta)[0]):
                return True
        return False

    def remembered_worst(self, zeta: Parameters, eta: float = 0.0) -> float:
        """The largest least g at the places that refuted certificates before: how far this one is
        from keeping all of them, a continuous function of zeta, and below 0 where it does.

        Raises UserError where phi stays positive far from the obstacle.
        """
        rows, places = self.hard[:, 0].astype(int), self.hard[:, 1:]
        near = np.hypot(*places.T) <= largest_distance(zeta, self.d_min, self.action_repeat)
        rows, places = rows[near], places[near]
        phi = self._phi(places, self.motions[rows, :2], zeta)
        least = np.full(len(rows), np.inf)
        for action in range(self._moved.shape[1]):
            moved = places - self._moved[rows, action]
            after = self._phi(moved, self._velocity[rows, action], zeta)
            least = np.minimum(least, constraint(phi, after, eta))
        return float(least.max(initial=-np.inf))

    def unsafe_area(self, zeta: Parameters, points: int = 160) -> float:
        """Mean area of {phi > 0} beyond the disc of d_min [m^2], over reachable motions and all
        bearings of the velocity."""
        quantiles = (np.arange(12) + 0.5) / 12
        speeds = np.quantile(self._speeds, quantiles)
        closing = speeds[:, None] * np.cos(np.pi * quantiles)
        far = largest_distance(zeta, self.d_min)
        width = (far - self.d_min) / points
        d = self.d_min + width * (np.arange(points) + 0.5)
        phi = phi_at(d[:, None], closing.ravel()[None], self.d_min, zeta)
        return float((2 * np.pi * width * d[:, None] * (phi > 0)).sum(0).mean())

    def _places(self, zeta: Parameters) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """Motions [S] and where the obstacle is, along and across the nose [S, 2]; in parts."""
        far = largest_distance(zeta, self.d_min, self.action_repeat)
        distances = np.concatenate(
            [self.d_min + np.array(NEAR), np.arange(self.d_min + self._spacing, far, self._spacing)]
        )
        d, bearing = (part.ravel() for part in np.meshgrid(distances, self._bearings))
        states = np.zeros((len(d), 5))
        states[:, 0], states[:, 1] = d, bearing
        free = ~overlaps_obstacle(self._envs, states)
        places = np.stack([d * np.cos(bearing), d * np.sin(bearing)], -1)[free]
        step = max(1, CHUNK // len(places))
        for begin in range(0, len(self.motions), step):
            rows = np.arange(begin, min(begin + step, len(self.motions)))
            yield np.repeat(rows, len(places)), np.tile(places, (len(rows), 1))

    def _without_safe_action(
        self, rows: NDArray[np.int64], places: Array, zeta: Parameters, eta: float
    ) -> tuple[NDArray[np.int64], Array]:
        """Indices [I] of encounters that no action of the grid keeps, and their least g [I].

        One action after the other is tried on those that none has kept yet: nearly all are by the
        first.
        """
        velocity = self.motions[rows, :2]
        phi = self._phi(places, velocity, zeta)
        left, least = np.arange(len(rows)), np.full(len(rows), np.inf)
        for action in np.argsort(-self._kept, kind="stable"):
            if not len(left):
                break
            moved = places[left] - self._moved[rows[left], action]
            after = self._phi(moved, self._velocity[rows[left], action], zeta)
            g = constraint(phi[left], after, eta)
            least[left] = np.minimum(least[left], g)
            self._kept[action] += np.count_nonzero(g < 0)
            left = left[g >= 0]
        return left, least[left]

    def _phi(self, places: Array, velocity: Array, zeta: Parameters) -> Array:
        """phi [S] of an obstacle at places [S, 2] that the robot's velocity [S, 2] may lead to."""
        d = np.hypot(places[:, 0], places[:, 1])
        closing = (places[:, 0] * velocity[:, 0] + places[:, 1] * velocity[:, 1]) / d
        return phi_at(d, -closing, self.d_min, zeta)

    def _remember(self, places: Array) -> None:
        """Keep some of the places, spread over them."""
        chosen = np.linspace(0, len(places) - 1, min(len(places), REMEMBERED)).astype(int)
        self.hard = np.concatenate([self.hard, places[chosen]])

    def _state(self, motion: int, place: Array) -> Array:
        """Distance, bearing, course, speed and turn rate."""
        along, across, rate = self.motions[motion]
        bearing = np.arctan2(place[1], place[0])
        course = np.arctan2(across, along) - bearing
        course = (course + np.pi) % (2 * np.pi) - np.pi
        return np.array([np.hypot(*place), bearing, course, np.hypot(along, across), rate])


@dataclass(frozen=True)
class Smallest:
    """The result of `smallest`."""

    zeta: Parameters
    area: float  # m^2
    verdict: Verdict
    candidates: int  # on the last grid
    searched: int  # of them, those whose encounters were all looked at, on all grids


def smallest(
    encounters: Encounters,
    family: EnergyFamily,
    box: Sequence[Sequence[float]],
    *,
    points: int = POINTS,
    zooms: int = ZOOMS,
    eta: float = 0.0,
) -> Smallest:
    """The member of a family with the least unsafe area that is feasible at all encounters.

    box: least and largest value of each parameter. A grid of ``points`` values each is gone through
    in the order of the area until one is feasible; then ``zooms`` times one of nine values each
    around it, of a quarter of the spacing. Raises UserError where none is feasible.
    """
    low, high = np.array(box[0], float), np.array(box[1], float)
    axes = [np.linspace(*ends, points) for ends in zip(low, high, strict=True)]
    searched, best = 0, None
    for _ in range(zooms + 1):
        found = _first_feasible(encounters, family, axes, eta, best)
        searched += found.searched
        best = Smallest(found.zeta, found.area, found.verdict, found.candidates, searched)
        widths = [axis[1] - axis[0] if len(axis) > 1 else 0.0 for axis in axes]
        axes = [
            np.unique(np.clip(value + width * np.linspace(-1, 1, 9), *ends))
            for value, width, *ends in zip(best.zeta, widths, low, high, strict=True)
        ]
    assert best is not None
    return best


def _first_feasible(
    encounters: Encounters,
    family: EnergyFamily,
    axes: Sequence[Array],
    eta: float,
    known: Smallest | None,
) -> Smallest:
    """The first feasible one in the order of the area, or ``known`` where that comes first."""
    candidates = []
    for values in itertools.product(*axes):
        zeta = family.at([float(value) for value in values])
        try:
            candidates.append((encounters.unsafe_area(zeta, 40), zeta))
        except UserError:  # phi is positive far away: certainly not the smallest
            continue
    candidates.sort(key=lambda candidate: candidate[0])
    searched = 0
    for area, zeta in candidates:
        if known is not None and area >= known.area:
            break
        if encounters.refuted(zeta, eta):
            continue
        searched += 1
        verdict = encounters.verdict(zeta, eta)
        if verdict.feasible:
            return Smallest(zeta, area, verdict, len(candidates), searched)
    if known is None:
        raise UserError(
            f"no {family.name} certificate in the box is feasible at all encounters; widen the box"
        )
    return Smallest(known.zeta, known.area, known.verdict, len(candidates), searched)
