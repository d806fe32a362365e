"""The nearest action that keeps a constraint, or the one that violates it least.

Nothing here knows what the constraint is: it is a function g of rows of actions, kept where g < 0.
*Nearest* is by the Euclidean norm of the components, each divided by half of its useful range and
clipped to it first: the point robot's thrust saturates at 0.05, so that 1.0 is no farther from
-0.05 than 0.05 is. A distance of 2 is then the whole range of one component.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr.errors import UserError, show

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
# (rows [B], actions [B, K, A]) -> g [B, K] of those states among the N that are looked at.
Margins = Callable[[Rows, NDArray[Any]], Array]

CANDIDATES = 256  # actions of a grid at most
ROUNDS = 3  # of the refinement, each at half the spacing of the last
FIRST_SPACING = 0.25  # of the refinement, in half ranges
LINE = np.linspace(0.125, 1.0, 8)  # places between the best action so far and the wanted one


@dataclass(frozen=True)
class Span:
    """The useful range of actions: low [A] < high [A]."""

    low: Array
    high: Array

    def __post_init__(self) -> None:
        if not (np.isfinite(self.low).all() and np.isfinite(self.high).all()):
            raise UserError(
                f"actions between {show(self.low.tolist())} and {show(self.high.tolist())} cannot "
                "be searched: give the action space finite bounds"
            )
        if not (self.low < self.high).all():
            raise UserError("the action space has a component without a range: low must be < high")

    @property
    def half(self) -> Array:
        """Half of the range of each component, the unit of distances."""
        return (self.high - self.low) / 2

    def clip(self, actions: NDArray[Any]) -> Array:
        return np.clip(np.asarray(actions, np.float64), self.low, self.high)

    def distance(self, actions: NDArray[Any], wanted: NDArray[Any]) -> Array:
        """Norm [...] of the difference in half ranges; arrays [..., A]."""
        gap = (self.clip(actions) - self.clip(wanted)) / self.half
        return np.sqrt((gap**2).sum(-1))

    def grid(self) -> Array:
        """[K, A] actions that cover the range, its ends included: a lattice or, where that would be
        too coarse, seeded random points and the centre."""
        size = len(self.low)
        points = int(CANDIDATES ** (1 / size) + 1e-9)
        if points >= 3:
            points -= 1 - points % 2  # an odd number has the centre
            axis = np.linspace(-1.0, 1.0, min(points, 41))
            unit = np.array(list(itertools.product(axis, repeat=size)))
        else:
            random = np.random.default_rng(0).uniform(-1.0, 1.0, (CANDIDATES, size))
            unit = np.concatenate([np.zeros((1, size)), np.eye(size), -np.eye(size), random])
        return (self.low + self.high) / 2 + unit * self.half


@dataclass(frozen=True)
class Choice:
    """What a filter made of N wanted actions."""

    actions: NDArray[Any]  # [N, A] of the wanted ones' type
    intervened: NDArray[np.bool_]  # [N] whether it is another one
    distance: Array  # [N] of it from the wanted one, in half ranges; 0 where it is that one
    margin: Array  # [N] g of it by the model: kept where < 0
    feasible: NDArray[np.bool_]  # [N] whether an action was found that keeps the constraint


def nearest_safe(
    wanted: NDArray[Any], margins: Margins, span: Span, grid: Array, *, margin: float = 0.0
) -> Choice:
    """Wanted actions [N, A] where g < -``margin``; elsewhere the nearest candidate for which that
    holds or, without any, the one with the least g.

    Candidates are ``grid`` [N, K, A], the wanted action within the span, that action with each
    component replaced by those of the grid, and a refinement around the best of these. Whatever is
    chosen has been evaluated in the type in which it is given.
    """
    everyone = np.arange(len(wanted))
    g = margins(everyone, wanted[:, None])[:, 0]
    bad = np.flatnonzero(~(g < -margin))
    actions, distance, feasible = wanted.copy(), np.zeros(len(wanted)), np.ones(len(wanted), bool)
    if len(bad):
        search = _Search(wanted[bad], bad, margins, span, margin)
        search.offer(_crossed(grid[bad], search.target))
        size = wanted.shape[1]
        pattern = _pattern(size) * span.half
        for spacing in FIRST_SPACING * 0.5 ** np.arange(ROUNDS):
            line = search.best[:, None] + LINE[:, None] * (search.target - search.best)[:, None]
            around = search.best[:, None] + spacing * pattern
            search.offer(np.concatenate([line, around], 1))
        actions[bad], g[bad] = search.best, search.g
        feasible[bad] = search.g < -margin
        distance[bad] = span.distance(search.best, search.target)
    return Choice(actions, (actions != wanted).any(1), distance, g, feasible)


class _Search:
    """The best candidates so far of the rows ``bad``."""

    def __init__(
        self, wanted: NDArray[Any], bad: Rows, margins: Margins, span: Span, margin: float
    ) -> None:
        self.bad, self.margins, self.span, self.margin = bad, margins, span, margin
        self.kind = wanted.dtype
        self.target = span.clip(wanted)  # [B, A]
        self.best = np.empty(wanted.shape, wanted.dtype)
        self.g = np.full(len(bad), np.inf)

    def offer(self, candidates: Array) -> None:
        """Candidates [B, K, A] beside the best so far; that one stays where none is better."""
        given = self.span.clip(candidates).astype(self.kind)
        g = self.margins(self.bad, given)
        if np.isfinite(self.g).all():
            given = np.concatenate([self.best[:, None], given], 1)
            g = np.concatenate([self.g[:, None], g], 1)
        gap = self.span.distance(given, self.target[:, None])
        near = np.where(g < -self.margin, gap, math.inf)
        chosen = np.where(np.isfinite(near).any(1), near.argmin(1), g.argmin(1))
        rows = np.arange(len(given))
        self.best, self.g = given[rows, chosen], g[rows, chosen]


def _crossed(grid: Array, target: Array) -> Array:
    """[B, K', A]: a grid, the target, and the target with one component of the grid's."""
    parts = [grid, target[:, None]]
    if grid.shape[2] > 1:
        for component in range(grid.shape[2]):
            values = np.sort(grid[:, :, component], 1)
            kept = np.flatnonzero((np.diff(values, axis=1) > 0).any(axis=0))  # the same for all
            values = values[:, [0, *(kept + 1)]]
            crossed = np.repeat(target[:, None], values.shape[1], 1)
            crossed[:, :, component] = values
            parts.append(crossed)
    return np.concatenate(parts, 1)


def _pattern(size: int) -> Array:
    """Directions [P, A] of a refinement: a lattice of up to three components, else the axes."""
    if size <= 3:
        axis = (-1.0, -0.5, 0.0, 0.5, 1.0) if size < 3 else (-1.0, 0.0, 1.0)
        return np.array([p for p in itertools.product(axis, repeat=size) if any(p)])
    return np.concatenate([np.eye(size), -np.eye(size)])
