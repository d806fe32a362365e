"""Compare the solver with reference slices: ``safemr slices FILE.npz``.

The file holds axes ``x`` [nx], ``y`` [ny] and ``psi`` [npsi] (rad), and for each array NAME
``NAME_value`` [npsi, nx, ny], V in metres, clipped or not, and possibly ``NAME_unsafe`` (V <= 0).
Names begin with the case: A for traffic that turns at +1 rad/s, B for adversarial traffic.

Two numbers a slice: nodes whose sign is wrong although the reference is farther than 0.1 m from 0,
and intersection over union (IoU) of the unsafe sets, by 200,000 random points between the nodes.
The verdict is over the arrays A_dp and B_dp, made by value iteration on the exact flow, or over all
arrays of a file that has neither; the others are shown for information: a level-set solution smears
the slice psi = 0, and an Euler step solves another problem.

Exit status: 0 within bounds, 1 out of bounds, 2 for a file that cannot be used.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from safemr.aircraft.reachability.grid import Floats
from safemr.aircraft.reachability.solver import CASES, Solution, load_or_solve
from safemr.errors import UserError

MARGIN = 0.1  # [m] nodes nearer to V = 0 may differ in sign
LEAST_IOU = 0.995
ROUNDING = 1e-3  # [m] of the stored values
DECISIVE = ("A_dp", "B_dp")


@dataclass(frozen=True)
class Reference:
    """One array of slices."""

    name: str
    x: Floats
    y: Floats
    psi: Floats
    value: Floats  # [npsi, nx, ny]

    @property
    def case(self) -> str:
        return self.name[0]


@dataclass(frozen=True)
class Comparison:
    """A solution against one slice."""

    name: str
    psi: float
    nodes: int
    disagreements: int
    iou: float

    @property
    def within_bounds(self) -> bool:
        return self.disagreements == 0 and self.iou >= LEAST_IOU


def read_references(path: Path) -> list[Reference]:
    """The arrays of a file of slices. Raises UserError, with what is wrong with the file."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = dict(stored.items())
    except FileNotFoundError as error:
        raise UserError(f"{path} does not exist") from error
    except Exception as error:  # what is not an npz archive fails in many ways
        raise UserError(f"{path} cannot be read as an npz file: {error}") from error
    axes = [_axis(path, arrays, name) for name in ("x", "y", "psi")]
    names = sorted(key.removesuffix("_value") for key in arrays if key.endswith("_value"))
    if not names:
        raise UserError(f"{path} has no array NAME_value")
    return [_reference(path, arrays, name, *axes) for name in names]


def _axis(path: Path, arrays: dict[str, NDArray], name: str) -> Floats:
    if name not in arrays:
        raise UserError(f"{path} has no axis {name!r}; it needs x, y and psi")
    axis = arrays[name]
    numeric = axis.ndim == 1 and axis.size > 0 and axis.dtype.kind in "fiu"
    if not (numeric and np.all(np.isfinite(axis))):
        raise UserError(f"{path}: axis {name!r} must be a list of finite numbers")
    if name == "psi" and np.any(np.abs(axis) > 2 * np.pi):
        raise UserError(f"{path}: axis 'psi' must be in rad, within [-2 pi, 2 pi]")
    if name != "psi" and (axis.size < 2 or np.any(np.diff(axis) <= 0)):
        raise UserError(f"{path}: axis {name!r} must rise, with at least two nodes")
    return axis.astype(float)


def _reference(
    path: Path, arrays: dict[str, NDArray], name: str, x: Floats, y: Floats, psi: Floats
) -> Reference:
    value = arrays[f"{name}_value"]
    if name[:1] not in CASES:
        raise UserError(f"{path}: {name!r} begins with neither case name, {' nor '.join(CASES)}")
    if value.shape != (len(psi), len(x), len(y)):
        raise UserError(
            f"{path}: {name}_value has shape {value.shape}, the axes psi, x, y give "
            f"{(len(psi), len(x), len(y))}"
        )
    if value.dtype.kind not in "fiu" or not np.all(np.isfinite(value)):
        raise UserError(f"{path}: {name}_value must hold finite numbers")
    unsafe = arrays.get(f"{name}_unsafe", value <= 0)
    # The flags are of values before rounding.
    if unsafe.shape != value.shape or np.any((unsafe != (value <= 0)) & (np.abs(value) > ROUNDING)):
        raise UserError(f"{path}: {name}_unsafe contradicts {name}_value")
    return Reference(name, x, y, psi, value.astype(float))


def compare(solution: Solution, reference: Reference, samples: int = 200_000) -> list[Comparison]:
    """Each slice of ``reference`` against ``solution``; the random points are always the same.

    Raises UserError for slices that reach beyond the solution's grid.
    """
    grid = solution.grid
    corners = np.array([[reference.x[0], reference.y[0]], [reference.x[-1], reference.y[-1]]])
    if not np.all(grid.contains(corners)):
        raise UserError(
            f"slices of {reference.name} reach from {corners[0]} to {corners[1]}, beyond the grid "
            f"x {grid.x_range}, y {grid.y_range}"
        )
    points = np.random.default_rng(0).uniform(corners[0], corners[1], (samples, 2))
    nodes = np.stack(np.meshgrid(reference.x, reference.y, indexing="ij"), axis=-1)
    result = []
    for psi, value in zip(reference.psi, reference.value, strict=True):
        ours = solution(_at(nodes, psi))
        wrong = ((ours <= 0) != (value <= 0)) & (np.abs(value) > MARGIN)
        between = _bilinear(reference.x, reference.y, value, points)
        iou = intersection_over_union(solution(_at(points, psi)) <= 0, between <= 0)
        result.append(Comparison(reference.name, psi, value.size, int(wrong.sum()), iou))
    return result


def intersection_over_union(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """|A and B| / |A or B| of sampled sets, 1 for two empty ones."""
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else 1.0


def _at(positions: Floats, psi: float) -> Floats:
    return np.concatenate([positions, np.full((*positions.shape[:-1], 1), psi)], axis=-1)


def _bilinear(x: Floats, y: Floats, value: Floats, points: Floats) -> Floats:
    i = np.clip(np.searchsorted(x, points[:, 0], "right") - 1, 0, len(x) - 2)
    j = np.clip(np.searchsorted(y, points[:, 1], "right") - 1, 0, len(y) - 2)
    u = (points[:, 0] - x[i]) / (x[i + 1] - x[i])
    v = (points[:, 1] - y[j]) / (y[j + 1] - y[j])
    near = value[i, j] + v * (value[i, j + 1] - value[i, j])
    far = value[i + 1, j] + v * (value[i + 1, j + 1] - value[i + 1, j])
    return near + u * (far - near)


def compare_all(references: list[Reference], cache: Path | None) -> Iterator[Comparison]:
    """Every slice of every array, each case being solved (or loaded) once."""
    solutions: dict[str, Solution] = {}
    for reference in references:
        if reference.case not in solutions:
            solutions[reference.case] = load_or_solve(cache, CASES[reference.case])
        yield from compare(solutions[reference.case], reference)


def main(arguments: list[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="safemr slices",
        description="Compare the reachability solver with reference slices.",
    )
    parser.add_argument("file", type=Path, help="npz file of slices")
    parser.add_argument("--cache", type=Path, help="folder in which solutions are kept")
    options = parser.parse_args(arguments)
    try:
        references = read_references(options.file)
        names = [reference.name for reference in references]
        decisive = [name for name in names if name in DECISIVE] or names
        passed = True
        for result in compare_all(references, options.cache):
            decides = result.name in decisive
            passed &= result.within_bounds or not decides
            verdict = "ok" if result.within_bounds else "OUT OF BOUNDS"
            print(
                f"{result.name:12s} psi {np.degrees(result.psi):6.1f} deg: "
                f"{result.disagreements:4d} of {result.nodes} nodes disagree, "
                f"IoU {result.iou:.4f}  {verdict if decides else 'for information'}",
                flush=True,
            )
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    bounds = f"bounds: no disagreement where |V| > {MARGIN}, IoU at least {LEAST_IOU}"
    print(f"{'within' if passed else 'OUT OF'} bounds ({bounds}; arrays {', '.join(decisive)})")
    return 0 if passed else 1
