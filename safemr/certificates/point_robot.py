"""The point robot away from contact, vectorised: constants, one environment step, braking.

The certificate search evaluates some ten million (state, action) pairs, which the simulator cannot
do in minutes. Without contact the robot is a planar rigid body with linear drag, and MuJoCo's
semi-implicit Euler step of it is a few lines; tests hold this model to the simulator within 1e-9,
and every counterexample found with it is confirmed in the simulator.

While an action is held for several steps, either amplifies round-off: an error of the turn rate
changes the servo's next substep by about -5 times itself, which only the torque's limit ends, some
hundredfold to a thousandfold a step. What phi becomes under one action is then known to 1e-2 at
worst after five steps, the least over a grid of actions to 1e-4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointRobot:
    """Constants of Safety Gym's point robot (docs/environments.md), SI units.

    A sphere at the origin and a cube, its nose, ahead of it; both of density 1 kg/m^3.
    """

    radius: float = 0.1  # m
    nose_centre: float = 0.1  # m ahead of the origin
    nose_half: float = 0.05  # m, half the edge of the cube
    gear: float = 0.3  # both actuators
    force_limit: float = 0.05  # before the gear: thrust saturates at |a0| = 0.05
    servo_gain: float = 0.3  # the yaw servo's torque is gear clip(a1 - 0.3 psi_dot, +-limit)
    damping: float = 0.01  # N s / m
    yaw_damping: float = 0.005  # N m s
    substep: float = 0.002  # s
    substeps: int = 10
    max_turn_rate: float = 3.0  # rad/s, what the servo reaches

    @property
    def sphere_mass(self) -> float:
        """kg"""
        return 4 / 3 * np.pi * self.radius**3

    @property
    def nose_mass(self) -> float:
        """kg"""
        return (2 * self.nose_half) ** 3

    @property
    def mass(self) -> float:
        """Sphere and nose, kg."""
        return self.sphere_mass + self.nose_mass

    @property
    def inertia(self) -> float:
        """About the origin, kg m^2."""
        cube = (2 * self.nose_half) ** 2 / 6 + self.nose_centre**2
        return 2 / 5 * self.sphere_mass * self.radius**2 + self.nose_mass * cube

    @property
    def step_s(self) -> float:
        """Duration of one environment step, s."""
        return self.substep * self.substeps

    @property
    def thrust(self) -> float:
        """Largest thrust, N."""
        return self.gear * self.force_limit

    @property
    def max_speed(self) -> float:
        """Terminal speed under full thrust, m/s."""
        return self.thrust / self.damping

    def deceleration(self, u: Array, braking: str) -> Array:
        """A(u), m/s^2: full thrust against the motion plus drag, or drag alone (robot sideways)."""
        drag = self.damping * u / self.mass
        return drag + self.thrust / self.mass if braking == "aligned brake" else drag

    def step(self, pose: Array, velocity: Array, actions: Array) -> tuple[Array, Array]:
        """Pose [S, 3] = x, y, heading and velocity [S, 3] one environment step later.

        Semi-implicit Euler as MuJoCo does it: (M + h D) acceleration = force - D velocity - bias,
        with the centrifugal force of the offset centre of mass as the bias.
        """
        x, y, heading = pose.T.copy()
        vx, vy, rate = velocity.T.copy()
        commands = np.clip(actions, -1.0, 1.0)
        thrust = self.gear * np.clip(commands[:, 0], -self.force_limit, self.force_limit)
        moment, h = self.nose_mass * self.nose_centre, self.substep
        linear, angular = self.mass + h * self.damping, self.inertia + h * self.yaw_damping
        for _ in range(self.substeps):
            cosine, sine = np.cos(heading), np.sin(heading)
            error = commands[:, 1] - self.servo_gain * rate
            torque = self.gear * np.clip(error, -self.force_limit, self.force_limit)
            along = thrust + moment * rate**2
            fx, fy = along * cosine - self.damping * vx, along * sine - self.damping * vy
            turn = torque - self.yaw_damping * rate + moment * (sine * fx - cosine * fy) / linear
            spin = turn / (angular - moment**2 / linear)
            vx += h * (fx + moment * sine * spin) / linear
            vy += h * (fy - moment * cosine * spin) / linear
            rate += h * spin
            x, y, heading = x + h * vx, y + h * vy, heading + h * rate
        return np.stack([x, y, heading], -1), np.stack([vx, vy, rate], -1)


ROBOT = PointRobot()
