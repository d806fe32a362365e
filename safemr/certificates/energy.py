"""The energy function phi of the safety certificate and everything derived from it.

This is the only place where phi is written. Every function works on numpy arrays and on torch
tensors, and is differentiable in the parameters zeta = [sigma, k, n] when they are tensors.

Equation numbers are the labels in the paper's source: ``sis`` (phi), ``cstr0`` (the constraint),
``sisadd`` (the magnitude). Lengths may be in any unit as long as it is one: a caller that measures
in units of ``length_scale`` divides d, d_dot and d_min by it first (`scaled`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

# d, d_dot, sigma, ... are floats, numpy arrays or torch tensors; the formulas do not care.
Array = Any


def energy(d: Array, d_dot: Array, d_min: Array, sigma: Array, k: Array, n: Array) -> Array:
    """phi(s) = (sigma + d_min)^n - d^n - k d_dot (Eq. sis), one value per obstacle.

    d [m] and d_dot [m/s] may have any common shape; phi_0 is (sigma, k, n) = (0, 0, 1) and
    phi_h is (0.3, k, 2) of the same formula.
    """
    return (sigma + d_min) ** n - d**n - k * d_dot


def largest(phi: Array) -> Array:
    """Maximum over obstacles, the last axis: [..., M] -> [...]."""
    return phi.amax(-1) if hasattr(phi, "amax") else phi.max(-1)


def constraint(phi: Array, phi_next: Array, eta: float) -> Array:
    """g = phi(s') - max(phi(s) - eta_D, 0), satisfied where g < 0 (Eq. cstr0).

    The gradient at the kink phi = eta_D is that of the inactive branch, 0.
    """
    shifted = phi - eta
    return phi_next - shifted * (shifted > 0)


def magnitude(d_min: Array, sigma: Array, k: Array, n: Array, a: float, b: float) -> Array:
    """a (sigma + d_min)^n + b k, the magnitude regularization term (Eq. sisadd)."""
    return a * (sigma + d_min) ** n + b * k


def scaled(d: Array, d_dot: Array, d_min: Array, length_scale: float) -> tuple[Array, Array, Array]:
    """(d, d_dot, d_min) in units of ``length_scale`` [m]; seconds stay seconds."""
    return d / length_scale, d_dot / length_scale, d_min / length_scale


def in_metres(zeta: Sequence[float], length_scale: float) -> tuple[float, float, float]:
    """The zeta in metres with the same unsafe set as ``zeta`` in units of ``length_scale``.

    Multiplying phi by L^n shows it: [sigma, k, n] becomes [L sigma, L^(n-1) k, n].
    """
    sigma, k, n = zeta
    return length_scale * sigma, length_scale ** (n - 1) * k, n


def softplus(x: Array) -> Array:
    """log(1 + e^x), elementwise."""
    return x.logaddexp(x.new_zeros(())) if hasattr(x, "logaddexp") else np.logaddexp(0.0, x)


def corrected(phi: Array, contact: Array, correction: Array, smoothing: float) -> Array:
    """The soft maximum of ``contact`` and phi + gate ``correction``; all of one shape.

    ``contact`` is d_min - d, which is phi_0. The result exceeds the larger of the two by at most
    tau log 2, tau = ``smoothing``, so it is positive in the whole collision disc. The gate
    1 - e^((d_min - d) / tau) is 0 in the disc, and nearly 1 from a few tau outside.
    """
    outside = -(contact * (contact < 0))
    gate = 1.0 - np.e ** (-outside / smoothing)
    return contact + smoothing * softplus((phi + gate * correction - contact) / smoothing)


def mean_positive_part(phi: Array, smoothing: float) -> Array:
    """E[tau log(1 + e^(phi / tau))], tau = ``smoothing``: the magnitude of any energy, a number."""
    return smoothing * softplus(phi / smoothing).mean()
