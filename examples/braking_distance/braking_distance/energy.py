"""phi with an explicit braking distance: safe where what is left beyond d_min suffices to stop.

    phi = sigma + d_min - d + v^2 / (2 u) + t v,    v = max(-d_dot, 0)

An obstacle that is closed in on at v is stopped before in v^2 / (2 u) by a deceleration u, after a
time t in which nothing is done yet; sigma is the margin that is left. The paper's phi has one
weight, k, for what are two things here. Where phi does not depend on d_dot no action changes it at
once: t > 0 keeps that from happening at v = 0.
"""

from __future__ import annotations

from safemr.certificates.energy import Array
from safemr.certificates.families import Parameter

VERSION = 1

PARAMETERS = {
    "sigma": Parameter(start=0.2, low=0.05, high=1.0, metres=1),  # margin beyond d_min [m]
    "u": Parameter(start=1.0, low=0.2, high=10.0, metres=1),  # deceleration [m/s^2]
    "t": Parameter(start=0.3, low=0.05, high=2.0),  # reaction time [s]
}


def phi(d: Array, d_dot: Array, d_min: Array, sigma: Array, u: Array, t: Array) -> Array:
    """The energy [m], one value per obstacle."""
    closing = -d_dot * (d_dot < 0)
    return sigma + d_min - d + closing**2 / (2.0 * u) + t * closing


def magnitude(d_min: Array, sigma: Array, u: Array, t: Array, a: float, b: float) -> Array:
    """a (sigma + d_min) + b (1 / (2 u) + t): phi in contact at rest, and what unit speed adds."""
    return a * (sigma + d_min) + b * (1.0 / (2.0 * u) + t)
