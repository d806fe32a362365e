"""The value function of the encounter: the smallest separation that the evader cannot prevent.

    V(s) = max over the evader, min over the traffic, of min over t of d(s(t)) - d_min,

the greatest solution of V = min(l, max_a min_b V(F(s, a, b))) with l = d - d_min and the exact flow
F over one control period. Value iteration from V = l gives the problem with horizon k dt after k
sweeps, decreasing with k. Interpolation is trilinear; the turn rates are the extreme ones and zero,
which lose nothing here: the flow's Hamiltonian is affine in a and in b.

The evader moves first and the traffic answers (max min), which favours the traffic; by Isaacs'
condition the order vanishes with dt.

States that leave the grid take V = l: the separation they have, with no later approach. Seen from
the grid this can only raise V, and only where a path returns. The unsafe sets end well inside the
default grid, so their boundary does not depend on it; enlarging the grid is the test of that.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import zipfile
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from envs.aircraft import AircraftDynamics
from envs.compiled import njit
from safemr.aircraft.reachability.grid import Floats, Grid
from safemr.errors import UserError

VERSION = 1  # part of a cached solution's name: raise it when solve() changes what it returns
VALUE_RANGE = (-1.0, 8.0)  # [m] values are clipped: depth and distance beyond these are not wanted

CONSTANT = AircraftDynamics(other_turns=(1.0,))
ADVERSARIAL = AircraftDynamics(other_turns=(-1.0, 0.0, 1.0))
CASES = {"A": CONSTANT, "B": ADVERSARIAL}  # named as in the reference slices


@dataclass(frozen=True)
class Solution:
    """V on a grid, with how it was reached."""

    dynamics: AircraftDynamics
    grid: Grid
    horizon: float  # [s] looked ahead
    value: NDArray[np.float32]  # [npsi, nx, ny]
    volumes: Floats  # [sweeps + 1] share of nodes with V <= 0 times the grid's volume
    changes: Floats  # [sweeps] largest change of V in a sweep [m]
    seconds: float  # of processor time

    def __call__(self, states: Floats) -> Floats:
        """V at states [..., 3] on the grid."""
        return self.grid.interpolate(self.value, states)

    def evade(self, states: Floats) -> Floats:
        """Turn rates [...] that maximise the worst next value: the evader's optimal feedback."""
        rates = _evader_turns(self.dynamics)
        worst = np.stack([self.worst_next(states, a) for a in rates])
        return rates[np.argmax(worst, axis=0)]

    def worst_next(self, states: Floats, a: float) -> Floats:
        """V [...] one control period later, with turn rate ``a`` and the traffic's worst reply."""
        nexts = np.stack([self.dynamics.flow(states, a, b) for b in self.dynamics.other_turns])
        clipped = nexts.copy()
        clipped[..., 0] = np.clip(nexts[..., 0], *self.grid.x_range)
        clipped[..., 1] = np.clip(nexts[..., 1], *self.grid.y_range)
        off = self.dynamics.separation(nexts) - self.dynamics.d_min
        return np.where(self.grid.contains(nexts), self(clipped), off).min(axis=0)

    def save(self, path: Path) -> None:
        """Write an npz without pickles, atomically."""
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{os.getpid()}")
        header = json.dumps(_header(self.dynamics, self.grid, self.horizon))
        with partial.open("wb") as file:
            np.savez_compressed(
                file,
                header=np.array(header),
                value=self.value,
                volumes=self.volumes,
                changes=self.changes,
                seconds=np.array(self.seconds),
            )
        partial.replace(path)


def _header(dynamics: AircraftDynamics, grid: Grid, horizon: float) -> dict[str, object]:
    return {
        "version": VERSION,
        "dynamics": {**asdict(dynamics), "other_turns": list(dynamics.other_turns)},
        "grid": grid.as_dict(),
        "horizon": horizon,
        "value_range": list(VALUE_RANGE),
    }


def load_or_solve(
    cache: Path | None, dynamics: AircraftDynamics, grid: Grid | None = None, horizon: float = 2.8
) -> Solution:
    """`solve`, kept in the folder ``cache`` under a name made of all its parameters."""
    grid = grid or Grid()
    if cache is None:
        return solve(dynamics, grid, horizon)
    header = json.dumps(_header(dynamics, grid, horizon))
    path = cache / f"value-{hashlib.sha256(header.encode()).hexdigest()[:12]}.npz"
    if not path.exists():
        solution = solve(dynamics, grid, horizon)
        solution.save(path)
        return solution
    try:
        with np.load(path, allow_pickle=False) as stored:
            if str(stored["header"]) != header:
                raise ValueError("its header is of other parameters")
            return Solution(
                dynamics,
                grid,
                horizon,
                stored["value"],
                stored["volumes"],
                stored["changes"],
                float(stored["seconds"]),
            )
    except OSError as error:
        reason = error.strerror or error
        raise UserError(f"cached solution {path} cannot be read: {reason}") from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"cached solution {path} is damaged ({error}): delete it") from error


def solve(dynamics: AircraftDynamics, grid: Grid | None = None, horizon: float = 2.8) -> Solution:
    """Value iteration over ``horizon`` seconds (a whole number of control periods).

    One thread; memory is twice the grid in float32. A sweep stops early nowhere: the number of
    sweeps is the horizon, so that solutions of two horizons can be compared.
    """
    grid = grid or Grid()
    sweeps = round(horizon / dynamics.dt)
    if sweeps < 1 or abs(sweeps * dynamics.dt - horizon) > 1e-9:
        raise ValueError(f"horizon {horizon} must be a positive multiple of dt = {dynamics.dt}")
    started = time.process_time()
    separation = dynamics.separation(grid.plane()).astype(np.float32) - np.float32(dynamics.d_min)
    clipped = np.clip(separation, *VALUE_RANGE).astype(np.float32)
    value = np.repeat(clipped[None], grid.shape[2], axis=0)
    cell = float(np.prod(grid.spacing))
    volumes, changes = [cell * np.count_nonzero(value <= 0)], []
    moves = _moves(dynamics, grid)
    for _ in range(sweeps):
        following = np.empty_like(value)
        changes.append(_sweep(value, following, *moves, np.float32(dynamics.d_min)))
        value = following
        volumes.append(cell * np.count_nonzero(value <= 0))
    seconds = time.process_time() - started
    return Solution(dynamics, grid, horizon, value, np.array(volumes), np.array(changes), seconds)


def _evader_turns(dynamics: AircraftDynamics) -> Floats:
    return np.array([-dynamics.turn_limit, 0.0, dynamics.turn_limit])


def _moves(
    dynamics: AircraftDynamics, grid: Grid
) -> tuple[Floats, Floats, Floats, NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]:
    """The flow in the form that `_sweep` reads, positions counted in grid steps.

    Within a slice of constant psi, one pair of turn rates moves node (i, j) to
    origin + slope (i, j), and into the same two slices with the same weights; the latter depend
    only on the difference of the rates.
    """
    own, other = _evader_turns(dynamics), np.array(dynamics.other_turns)
    corner, step = np.array([grid.x_range[0], grid.y_range[0]]), np.array(grid.spacing[:2])
    shift = np.stack(
        dynamics.shift(grid.psi[:, None, None], own[:, None], other[None, :]), axis=-1
    )  # [npsi, own, other, 2]
    cos, sin = np.cos(own * dynamics.dt), np.sin(own * dynamics.dt)
    rotation = np.array([[cos, sin], [-sin, cos]]).transpose(2, 0, 1)  # [own, 2, 2]
    origin = (np.einsum("auv,pabv->pabu", rotation, corner + shift) - corner) / step
    slope = rotation * step[None, None, :] / step[None, :, None]
    differences, group = np.unique(np.round(other[None, :] - own[:, None], 12), return_inverse=True)
    turns = differences * dynamics.dt / grid.spacing[2]
    below = np.floor(turns)
    return (
        np.concatenate([corner, step]),
        np.ascontiguousarray(origin),
        np.ascontiguousarray(slope),
        group.reshape(len(own), len(other)),
        below.astype(np.int64),
        (turns - below).astype(np.float32),
    )


@njit()
def _sweep(
    value: NDArray[np.float32],
    following: NDArray[np.float32],
    frame: Floats,
    origin: Floats,
    slope: Floats,
    group: NDArray[np.int64],
    below: NDArray[np.int64],
    weight: NDArray[np.float32],
    d_min: np.float32,
) -> float:  # pragma: no cover - compiled
    """following = min(value, max_a min_b value(F)); returns the largest change.

    Since V only falls, a node whose V some turn rate keeps is done: starting with the rate that
    was best at the previous node, most nodes cost one look-up.
    """
    npsi, nx, ny = value.shape
    owns, others = origin.shape[1], origin.shape[2]
    blended = np.empty((len(below), nx, ny), np.float32)
    largest = np.float32(0.0)
    favourite = 0
    for p in range(npsi):
        for g in range(len(below)):
            lower, upper = (p + below[g]) % npsi, (p + below[g] + 1) % npsi
            for i in range(nx):
                for j in range(ny):
                    first = value[lower, i, j]
                    blended[g, i, j] = first + weight[g] * (value[upper, i, j] - first)
        for i in range(nx):
            for j in range(ny):
                present = value[p, i, j]
                best = np.float32(-np.inf)
                preferred = favourite
                for c in range(owns):
                    a = preferred + c if preferred + c < owns else preferred + c - owns
                    worst = np.float32(np.inf)
                    for b in range(others):
                        u = origin[p, a, b, 0] + slope[a, 0, 0] * i + slope[a, 0, 1] * j
                        v = origin[p, a, b, 1] + slope[a, 1, 0] * i + slope[a, 1, 1] * j
                        if u < 0 or v < 0 or u > nx - 1 or v > ny - 1:
                            off = np.hypot(frame[0] + u * frame[2], frame[1] + v * frame[3])
                            q = np.float32(off) - d_min
                        else:
                            k, m = min(int(u), nx - 2), min(int(v), ny - 2)
                            fu, fv = np.float32(u - k), np.float32(v - m)
                            g = group[a, b]
                            near, far = blended[g, k, m], blended[g, k + 1, m]
                            near += fv * (blended[g, k, m + 1] - near)
                            far += fv * (blended[g, k + 1, m + 1] - far)
                            q = near + fu * (far - near)
                        worst = min(worst, q)
                        if worst <= best:
                            break
                    if worst > best:
                        best, favourite = worst, a
                    if best >= present:
                        break
                reached = min(present, best)
                following[p, i, j] = reached
                largest = max(largest, present - reached)
    return float(largest)
