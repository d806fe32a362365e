"""A unicycle that collects goals among moving discs: an environment of your own for `safemr`.

Nothing here imports `safemr`. What it asks for is in `_info`: the cost of a step, and for each disc
the distance d [m] and its rate d_dot [m/s]; `d_min` is the distance to be kept. An episode has two
to four discs, so that d has two to four entries.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

DT = 0.1  # [s]
HALF_WIDTH = 2.0  # of the square that goals lie and discs move in [m]
MOST = 4  # discs


class UnicycleDiscs(gymnasium.Env):
    """State: position [m], heading [rad] and speed [m/s]. Action: speed and turning rate wanted.

    The speed follows with a lag of two steps. disc_speed: of every disc [m/s]. The reward is the
    way gained towards the goal [m], and 1 when it is reached, whereupon another one is drawn.
    """

    d_min = 0.35  # from the centre of a disc [m]
    num_obstacles = MOST
    task_version = 1

    def __init__(self, disc_speed: float = 0.2) -> None:
        self.disc_speed = disc_speed
        # [m/s] and [rad/s].
        self.action_space = Box(np.array([-0.5, -2.0]), np.array([1.0, 2.0]), dtype=np.float64)
        # Speed, then the goal's and each disc's place, and each disc's velocity, as the robot sees
        # them. Only the speed has bounds.
        limit = np.full(3 + 4 * MOST, np.inf)
        limit[0] = 1.0
        self.observation_space = Box(-limit, limit, dtype=np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        count = int(self.np_random.integers(2, MOST + 1))
        self.place, self.speed = np.zeros(2), 0.0
        self.heading = self.np_random.uniform(-np.pi, np.pi)
        angle = self.np_random.uniform(-np.pi, np.pi, (2, count))
        away = self.np_random.uniform(0.8, HALF_WIDTH, count)
        self.discs = away[:, None] * np.column_stack((np.cos(angle[0]), np.sin(angle[0])))
        self.velocities = self.disc_speed * np.column_stack((np.cos(angle[1]), np.sin(angle[1])))
        self._draw_goal()
        return self._observation(), self._info()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        wanted, turning = np.clip(action, self.action_space.low, self.action_space.high)
        before = np.linalg.norm(self.goal - self.place)
        self.speed += 0.5 * (wanted - self.speed)
        self.heading += DT * turning
        self.place = self.place + DT * self._velocity()
        self.discs += DT * self.velocities
        outside = np.abs(self.discs) > HALF_WIDTH
        self.velocities = np.where(
            outside, -np.sign(self.discs) * np.abs(self.velocities), self.velocities
        )
        after = np.linalg.norm(self.goal - self.place)
        reached = bool(after < 0.3)
        if reached:
            self._draw_goal()
        reward = float(before - after) + reached
        info = self._info()
        info |= {"cost": float((info["d"] < self.d_min).any()), "goal_met": reached}
        return self._observation(), reward, False, False, info

    def _velocity(self) -> np.ndarray:
        return self.speed * np.array([np.cos(self.heading), np.sin(self.heading)])

    def _draw_goal(self) -> None:
        self.goal = self.np_random.uniform(-0.8 * HALF_WIDTH, 0.8 * HALF_WIDTH, 2)

    def _info(self) -> dict[str, Any]:
        """Distance to each disc and its rate."""
        way = self.discs - self.place
        d = np.linalg.norm(way, axis=1)
        d_dot = ((self.velocities - self._velocity()) * way).sum(1) / np.maximum(d, 1e-6)
        return {"d": d, "d_dot": d_dot}

    def _observation(self) -> np.ndarray:
        """What the robot sees, the nearest disc first; a disc that is not there is far ahead."""
        cos, sin = np.cos(self.heading), np.sin(self.heading)
        turn = np.array([[cos, -sin], [sin, cos]])  # row vectors into the robot's frame
        way = self.discs - self.place
        near = np.argsort(np.linalg.norm(way, axis=1))
        places = np.tile([2.0 * HALF_WIDTH, 0.0], (MOST, 1))
        velocities = np.zeros((MOST, 2))
        places[: len(near)] = way[near] @ turn
        velocities[: len(near)] = (self.velocities[near] - self._velocity()) @ turn
        goal = (self.goal - self.place) @ turn
        return np.concatenate(([self.speed], goal, places.ravel(), velocities.ravel()))


gymnasium.register(id="UnicycleDiscs-v1", entry_point=UnicycleDiscs, max_episode_steps=150)
