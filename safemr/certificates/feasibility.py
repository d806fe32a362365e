"""The analytic feasibility condition of the safety-index literature for the point robot.

A certificate is feasible where some action dissipates the energy. For phi = C - d^n - k d_dot and a
robot that closes in at speed u = -d_dot with an available radial deceleration A(u),
phi_dot = n d^(n-1) u - k A(u), so phi <= -eta_D / dt needs n d^(n-1) u + eta_D / dt <= k A(u). It
matters where phi >= 0, that is for d <= (C + k u)^(1/n):

    (*)  n u (C + k u)^((n-1)/n) + eta_D / dt <= k A(u)   for all u in (0, v_max],   n >= 1,

while for n < 1 the left side is largest at the smallest distance, n u d_min^(n-1). With a constant
A this is Eq. (3) of Zhao et al. 2021 (ISSA), which the paper refers to. The condition is sufficient
where it holds for the deceleration that the robot really has in the direction of the obstacle, and
that depends on its heading: so the verdict is always given for both extremes, and for both
conventions of sigma in use, never as one word "feasible".
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from safemr.certificates.point_robot import PointRobot
from safemr.errors import UserError
from safemr.paper import Zeta

CONVENTIONS = ("inside", "outside")  # C = (sigma + d_min)^n (the paper) or sigma + d_min^n (ISSA)
BRAKINGS = ("aligned brake", "drag only")
SPEEDS = 1500  # points of the grid over (0, v_max]


def radial_requirement(
    zeta: Zeta, d_min: float, u: np.ndarray, convention: str, eta_rate: float = 0.0
) -> np.ndarray:
    """The deceleration that (*) asks for at closing speeds u: its left side divided by k, m/s^2."""
    sigma, k, n = zeta
    if convention == "inside":
        level = (sigma + d_min) ** n
    elif convention == "outside":
        level = sigma + d_min**n
    else:
        raise UserError(f"unknown convention {convention!r}: use one of {', '.join(CONVENTIONS)}")
    slope = (level + k * u) ** ((n - 1) / n) if n >= 1 else d_min ** (n - 1)
    return (n * u * slope + eta_rate) / k


def analytic_condition(
    zeta: Zeta, d_min: float, *, eta: float = 0.0, robot: PointRobot | None = None
) -> pd.DataFrame:
    """(*) on a grid of closing speeds, for both conventions and both decelerations.

    Returns four rows: convention, braking, margin (the smallest A(u) minus requirement, m/s^2),
    speed (where it is, m/s), holds. k = 0 has no finite requirement and holds nowhere.
    """
    robot = robot or PointRobot()
    u = np.linspace(0, robot.max_speed, SPEEDS + 1)[1:]
    rows = []
    for convention in CONVENTIONS:
        for braking in BRAKINGS:
            if zeta.k > 0:
                required = radial_requirement(zeta, d_min, u, convention, eta / robot.step_s)
            else:
                required = np.full_like(u, np.inf)
            margin = robot.deceleration(u, braking) - required
            worst = int(margin.argmin())
            rows.append((convention, braking, margin[worst], u[worst], bool(margin[worst] >= 0)))
    return pd.DataFrame(rows, columns=["convention", "braking", "margin", "speed", "holds"])
