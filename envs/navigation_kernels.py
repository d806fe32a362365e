"""Numerics of the navigation tasks, compiled: state -> kinematics, rewards, costs, observation.

All functions work on the stacked arrays of N worlds, one world after the other, so that a world
gives the same bits alone and in a batch. Shapes: qpos [N, nq], qvel and qacc [N, nv], start [N, 3]
(x, y, yaw of the robot body), goal [N, 2], obstacles [N, M, 2], pose [N, 3] (x, y, heading),
velocity [N, 2], d and d_dot [N, M], contacts [N, 2], distances [N, 2].
"""
# mypy: disallow-untyped-defs=False

from __future__ import annotations

import math

import numba
import numpy as np
from numba import types
from numba.extending import intrinsic

from envs import tasks
from envs.compiled import njit

# Numba keeps compiled code until this file changes, and constants are part of it: what comes from
# another module is therefore written out here and compared.
_LIDAR_BINS = 16
if _LIDAR_BINS != tasks.LIDAR_BINS:
    raise ImportError("envs/navigation_kernels.py and envs/tasks.py state different LIDAR_BINS")
BIN_WIDTH = 2 * math.pi / _LIDAR_BINS
GRAVITY = 9.81
MAGNETIC_FIELD = 0.5  # along world -y
ROBOT_Z, GOAL_Z = 0.1, 0.16  # m, heights of the body origins
HUGE = 1e10  # MuJoCo's own limit (mjMAXVAL) for a state that has diverged

# Rows of the array that `score` fills, in order; all but the first are keys of `info`.
SCORES = (
    "reward",
    "reward_approach",
    "reward_push",
    "reward_goal",
    "cost",
    "cost_indicator",
    "cost_contact",
)
GOAL_REWARD = 1.0
DIVERGENCE_REWARD = -10.0


@intrinsic
def _as_pointer(typing_context, address):
    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float64)(address), generate


@njit()
def _array_at(address, length):
    return numba.carray(_as_pointer(address), (length,))  # type: ignore[call-arg]


@njit()
def write_controls(addresses, actions):
    """Copy actions [N, 2], clipped to [-1, 1], into MuJoCo's ctrl, whose addresses are column 3.

    Returns -1, or the first world whose action is not finite, and then nothing was copied.
    """
    for i in range(actions.shape[0]):
        if not (math.isfinite(actions[i, 0]) and math.isfinite(actions[i, 1])):
            return i
    for i in range(actions.shape[0]):
        ctrl = _array_at(addresses[i, 3], 2)
        for j in range(2):
            ctrl[j] = min(max(actions[i, j], -1.0), 1.0)
    return -1


@njit()
def read_states(addresses, qpos, qvel, qacc, diverged):
    """Copy MuJoCo's qpos, qvel and qacc (addresses [N, 4], columns 0 to 2) into the stacks.

    diverged [N] says where a number is NaN or beyond MuJoCo's limit; such a world is not copied.
    """
    for i in range(qpos.shape[0]):
        new_qpos = _array_at(addresses[i, 0], qpos.shape[1])
        new_qvel = _array_at(addresses[i, 1], qvel.shape[1])
        new_qacc = _array_at(addresses[i, 2], qacc.shape[1])
        diverged[i] = False
        for values in (new_qpos, new_qvel, new_qacc):
            for value in values:
                if not abs(value) <= HUGE:
                    diverged[i] = True
        if not diverged[i]:
            qpos[i] = new_qpos
            qvel[i] = new_qvel
            qacc[i] = new_qacc


@njit()
def kinematics(qpos, qvel, start, obstacles, pose, velocity, d, d_dot, reach, near):
    """World pose and velocity of the robot, distance and rate (positive: away) to each obstacle.

    The slide joints turn with the body, so qpos is a displacement in the frame of the start.
    near [N] starts with the worlds where an obstacle's centre is closer than `reach`; returns
    their number.
    """
    count = 0
    for i in range(qpos.shape[0]):
        c, s = math.cos(start[i, 2]), math.sin(start[i, 2])
        pose[i, 0] = start[i, 0] + c * qpos[i, 0] - s * qpos[i, 1]
        pose[i, 1] = start[i, 1] + s * qpos[i, 0] + c * qpos[i, 1]
        pose[i, 2] = start[i, 2] + qpos[i, 2]
        velocity[i, 0] = c * qvel[i, 0] - s * qvel[i, 1]
        velocity[i, 1] = s * qvel[i, 0] + c * qvel[i, 1]
        closest = math.inf
        for j in range(obstacles.shape[1]):
            dx, dy = obstacles[i, j, 0] - pose[i, 0], obstacles[i, j, 1] - pose[i, 1]
            distance = math.sqrt(dx * dx + dy * dy)
            d[i, j] = distance
            if distance > 0.0:
                d_dot[i, j] = -(velocity[i, 0] * dx + velocity[i, 1] * dy) / distance
            else:  # every direction leads away from the centre
                d_dot[i, j] = math.hypot(velocity[i, 0], velocity[i, 1])
            closest = min(closest, distance)
        if closest < reach:
            near[count] = i
            count += 1
    return count


@njit()
def task_distances(pose, qpos, goal, has_box, distances):
    """The distances whose decrease is rewarded: approach and push.

    With a box: robot to box and box to goal, in 3-D between body origins. Without: planar
    distance robot to goal, and 0.
    """
    for i in range(pose.shape[0]):
        if has_box:
            x, y, z = qpos[i, 3], qpos[i, 4], qpos[i, 5]
            dx, dy, dz = x - pose[i, 0], y - pose[i, 1], z - ROBOT_Z
            distances[i, 0] = math.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = x - goal[i, 0], y - goal[i, 1], z - GOAL_Z
            distances[i, 1] = math.sqrt(dx * dx + dy * dy + dz * dz)
        else:
            dx, dy = goal[i, 0] - pose[i, 0], goal[i, 1] - pose[i, 1]
            distances[i, 0] = math.sqrt(dx * dx + dy * dy)
            distances[i, 1] = 0.0


@njit()
def score(
    before,
    after,
    has_box,
    goal_size,
    hazard_size,
    indicator_cost,
    d,
    contacts,
    diverged,
    scores,
    goal_met,
):
    """Rewards and costs of one step, SCORES [7, N] and goal_met [N], from the task's distances.

    Cost: pillars (hazard_size 0): contacts of the robot's sphere, contacts[:, 0]; hazards: depth
    inside, summed, or with indicator_cost whether inside any. The contact count is Safety Gym's,
    with the arrow, contacts[:, 1].
    """
    for i in range(before.shape[0]):
        if diverged[i]:
            scores[:, i] = 0.0
            scores[0, i] = DIVERGENCE_REWARD
            goal_met[i] = False
            continue
        goal_met[i] = after[i, 1 if has_box else 0] <= goal_size
        approach, push = before[i, 0] - after[i, 0], before[i, 1] - after[i, 1]
        goal = GOAL_REWARD if goal_met[i] else 0.0
        cost, contact = contacts[i, 0], contacts[i, 1]
        if hazard_size > 0.0:
            cost = 0.0
            for j in range(d.shape[1]):
                cost += max(hazard_size - d[i, j], 0.0)
            contact = 1.0 if cost > 0.0 else 0.0
            if indicator_cost:
                cost = contact
        scores[0, i] = approach + push + goal
        scores[1, i] = approach
        scores[2, i] = push
        scores[3, i] = goal
        scores[4, i] = cost
        scores[5, i] = 1.0 if cost > 0.0 else 0.0
        scores[6, i] = contact


@njit()
def _add_to_lidar(bins, pose, c, s, x, y, lidar_range):
    """Safety Gym's pseudo lidar for one point: its signal into its bin and, aliased, beside.

    The signal is exp(-distance), or with a finite range 1 - distance / range, at least 0.
    """
    dx, dy = x - pose[0], y - pose[1]
    angle = math.atan2(c * dy - s * dx, c * dx + s * dy) % (2 * math.pi)
    position = angle / BIN_WIDTH
    fraction = position - math.floor(position)
    index = int(position) % _LIDAR_BINS
    distance = math.sqrt(dx * dx + dy * dy)
    if lidar_range < math.inf:
        signal = max(0.0, lidar_range - distance) / lidar_range
    else:
        signal = math.exp(-distance)
    after, before = (index + 1) % _LIDAR_BINS, (index - 1) % _LIDAR_BINS
    bins[index] = max(bins[index], signal)
    bins[after] = max(bins[after], fraction * signal)
    bins[before] = max(bins[before], (1.0 - fraction) * signal)


@njit()
def observe(pose, qpos, qvel, qacc, obstacles, goal, blocks, lidar_range, observation):
    """The flat observation [N, obs] (zeros on entry), in closed form from the state.

    blocks: first columns of accelerometer, gyro, magnetometer, velocimeter, goal lidar, obstacle
    lidar, lidar of box or vase (-1: neither). Sensors are in the body frame at the body origin.
    """
    for i in range(pose.shape[0]):
        out = observation[i]
        c, s = math.cos(qpos[i, 2]), math.sin(qpos[i, 2])
        out[blocks[0]] = c * qacc[i, 0] + s * qacc[i, 1]
        out[blocks[0] + 1] = c * qacc[i, 1] - s * qacc[i, 0]
        out[blocks[0] + 2] = GRAVITY
        out[blocks[1] + 2] = qvel[i, 2]
        out[blocks[3]] = c * qvel[i, 0] + s * qvel[i, 1]
        out[blocks[3] + 1] = c * qvel[i, 1] - s * qvel[i, 0]
        c, s = math.cos(pose[i, 2]), math.sin(pose[i, 2])
        out[blocks[2]] = -MAGNETIC_FIELD * s
        out[blocks[2] + 1] = -MAGNETIC_FIELD * c
        bins = out[blocks[4] : blocks[4] + _LIDAR_BINS]
        _add_to_lidar(bins, pose[i], c, s, goal[i, 0], goal[i, 1], lidar_range)
        bins = out[blocks[5] : blocks[5] + _LIDAR_BINS]
        for j in range(obstacles.shape[1]):
            x, y = obstacles[i, j, 0], obstacles[i, j, 1]
            _add_to_lidar(bins, pose[i], c, s, x, y, lidar_range)
        if blocks[6] >= 0:
            bins = out[blocks[6] : blocks[6] + _LIDAR_BINS]
            _add_to_lidar(bins, pose[i], c, s, qpos[i, 3], qpos[i, 4], lidar_range)


def observation_blocks(layout: dict[str, slice]) -> np.ndarray:
    """The `blocks` argument of `observe` for an observation layout."""
    obstacles = next(name for name in ("pillars_lidar", "hazards_lidar") if name in layout)
    names = ("accelerometer", "gyro", "magnetometer", "velocimeter", "goal_lidar", obstacles)
    free = [layout[name].start for name in ("box_lidar", "vase_lidar") if name in layout]
    return np.array([*(layout[name].start for name in names), *(free or [-1])])
