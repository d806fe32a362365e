"""Which motions the point robot can get into: every one kept here has a trajectory from rest.

A state without a safe action refutes a certificate only if the robot can be driven there. Far from
contact the robot's motion does not depend on where it is: three numbers describe it, the velocity
along the nose, across it, and the turn rate. From rest all decisions of a small grid are tried, and
of the motions that fall into one cell the one that is farthest out is kept and tried in turn, until
nothing new comes. So the set is approximated from inside, to about a cell; `Reachable.witness` is
the way there. Any place relative to an obstacle is reached with it by starting elsewhere.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from safemr.certificates.point_robot import ROBOT

Array = NDArray[np.float64]

CELL = (0.1, 0.1, 0.5)  # m/s along the nose, m/s across it, rad/s
FARTHER = 0.004  # by how much, in the unit of `_farness`, a motion must be to take another's place

# Full thrust either way and none; turns over the range, and the servo's torque either way and none.
THRUSTS = (-ROBOT.force_limit, 0.0, ROBOT.force_limit)
TURNS = (-1.0, -0.3, 0.0, 0.3, 1.0)
TORQUES = (-ROBOT.force_limit, 0.0, ROBOT.force_limit)


@dataclass(frozen=True)
class Reachable:
    """Motions [N, 3] = (along, across, turn rate), each one decision after its parent.

    ``kept`` [K] are the rows that stand for their cells, of which no two are alike.
    """

    motions: Array
    parents: NDArray[np.int64]  # [N], of rest its own row
    actions: Array  # [N, 2], held from the parent on
    kept: NDArray[np.int64]
    action_repeat: int

    @property
    def representatives(self) -> Array:
        """One motion a cell, [K, 3]."""
        return self.motions[self.kept]

    def witness(self, index: int) -> Array:
        """Decisions [T, 2] that lead from rest to ``representatives[index]``."""
        row, found = int(self.kept[index]), []
        while self.parents[row] != row:
            found.append(self.actions[row])
            row = int(self.parents[row])
        return np.array(found[::-1]).reshape(-1, 2)


def responses(motions: Array, actions: Array, action_repeat: int) -> tuple[Array, Array, Array]:
    """What a decision does to motions [S, 3] under actions [S, A, 2].

    Returns where the robot is afterwards [S, A, 2], its velocity there [S, A, 2], both along and
    across the nose before the decision, and the next motions [S, A, 3].
    """
    count = actions.shape[1]
    velocity = np.repeat(motions, count, 0)
    pose = np.zeros_like(velocity)
    for _ in range(action_repeat):
        pose, velocity = ROBOT.step(pose, velocity, actions.reshape(-1, 2))
    cosine, sine = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    along = cosine * velocity[:, 0] + sine * velocity[:, 1]
    across = cosine * velocity[:, 1] - sine * velocity[:, 0]
    after = np.stack([along, across, velocity[:, 2]], -1)
    shape = (len(motions), count, -1)
    return (
        pose[:, :2].reshape(shape).copy(),
        velocity[:, :2].reshape(shape).copy(),
        after.reshape(shape),
    )


@functools.lru_cache(maxsize=8)
def reachable(
    action_repeat: int = 1,
    action_scale: tuple[float, ...] = (),
    cell: tuple[float, float, float] = CELL,
) -> Reachable:
    """What can be reached from rest by decisions of ``action_repeat`` control steps.

    ``action_scale``: bounds of the action's components for who cannot do more; empty: none.
    """
    motions, parents, actions = np.zeros((1, 3)), np.zeros(1, np.int64), np.zeros((1, 2))
    row_of: dict[tuple[int, ...], int] = {(0, 0, 0): 0}
    frontier = np.array([0])
    while len(frontier):
        tried = _actions(motions[frontier, 2], action_scale)
        after = responses(motions[frontier], tried, action_repeat)[2].reshape(-1, 3)
        cells, farness = np.round(after / cell).astype(int), _farness(after)
        order = np.argsort(-farness, kind="stable")
        first = np.unique(cells[order], axis=0, return_index=True)[1]
        new = []
        for index in order[first]:
            holder = row_of.get(tuple(cells[index]))
            if holder is None or farness[index] > _farness(motions[holder]) + FARTHER:
                row_of[tuple(cells[index])] = len(motions) + len(new)
                new.append(index)
        begin = len(motions)
        motions = np.concatenate([motions, after[new]])
        parents = np.concatenate([parents, frontier[np.array(new, int) // tried.shape[1]]])
        actions = np.concatenate([actions, tried.reshape(-1, 2)[new]])
        frontier = np.arange(begin, len(motions))
    kept = np.array(sorted(row_of.values()))
    return Reachable(motions, parents, actions, kept, action_repeat)


def _farness(motions: Array) -> Array:
    """Distance from rest [...] of motions [..., 3], in shares of what the actuators reach."""
    return np.linalg.norm(
        motions / (ROBOT.max_speed, ROBOT.max_speed, ROBOT.max_turn_rate), axis=-1
    )


def _actions(turn_rates: Array, action_scale: Sequence[float]) -> Array:
    """[S, A, 2]: every thrust with every turn."""
    uniform = np.broadcast_to(TURNS, (len(turn_rates), len(TURNS)))
    near = np.clip(ROBOT.servo_gain * turn_rates[:, None] + TORQUES, -1, 1)
    turns = np.concatenate([uniform, near], 1)
    shape = (len(turn_rates), len(THRUSTS), turns.shape[1])
    thrusts = np.broadcast_to(np.array(THRUSTS)[None, :, None], shape)
    grid = np.stack([thrusts, np.broadcast_to(turns[:, None], shape)], -1)
    grid = grid.reshape(len(turn_rates), -1, 2)
    return np.clip(grid, -np.array(action_scale), action_scale) if action_scale else grid
