"""The safety filter without an environment: states and wanted actions in, allowed actions out.

An action is kept where g = phi(s') - max(phi(s) - eta_D, 0) < 0 (Eq. cstr0), s' being the state a
decision later by the model; elsewhere `safemr.filters.choice` says what takes its place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr.certificates.bound import BoundCertificate
from safemr.certificates.certificate import Certificate
from safemr.errors import UserError, show
from safemr.filters.choice import Array, Choice, Span, nearest_safe
from safemr.filters.models import FunctionModel, Lattice, Model, OneStep, energy_of

AnyCertificate = Certificate | BoundCertificate


class Filter:
    """A certificate, its d_min [m] and a model of what follows, for N states at once.

    span: the useful range of actions; grid: candidates [N, K, A] for observations [N, D]; margin:
    an action must have g < -``margin``, a reserve for a model that errs, in units of phi.
    """

    def __init__(
        self,
        certificate: Certificate,
        d_min: float,
        model: Model,
        span: Span,
        grid: Callable[[NDArray[Any]], Array] | None = None,
        margin: float = 0.0,
    ) -> None:
        if not (isinstance(margin, int | float) and 0.0 <= margin < np.inf):
            raise UserError(f"margin = {show(margin)}: it must be a number of at least 0")
        self.certificate, self.d_min, self.model = certificate, d_min, model
        self.span, self.margin = span, float(margin)
        self._grid = grid or Lattice(span.grid())

    def choose(
        self, actions: Any, observations: NDArray[Any], d: NDArray[Any], d_dot: NDArray[Any]
    ) -> Choice:
        """What is made of actions [N, A] in states with d [m] and d_dot [m/s], [N, M].

        Raises UserError for wrong shapes and for numbers that are not finite.
        """
        wanted, seen = np.asarray(actions), np.asarray(observations)
        shape = (len(seen), len(self.span.low))
        if wanted.dtype.kind not in "fiu" or wanted.shape != shape:
            raise UserError(
                f"actions have type {wanted.dtype} and shape {wanted.shape}, not {shape}"
            )
        if wanted.dtype.kind != "f":
            wanted = wanted.astype(np.float64)
        if not np.isfinite(wanted).all():
            raise UserError(f"an action is not finite: {show(wanted.tolist())}")
        near, closing = (checked_distances(x, name) for x, name in ((d, "d"), (d_dot, "d_dot")))
        phi = energy_of(self.certificate, near, closing, self.d_min, seen)
        margins = self.model.margins(self.certificate, self.d_min, phi, seen)
        return nearest_safe(wanted, margins, self.span, self._grid(seen), margin=self.margin)


def filter_actions(
    certificate: AnyCertificate,
    model: OneStep | Model,
    actions: Any,
    *,
    observations: Any,
    d: Any,
    d_dot: Any,
    low: Any = -1.0,
    high: Any = 1.0,
    d_min: float | None = None,
    margin: float = 0.0,
) -> Choice:
    """The nearest actions that keep a certificate's constraint, or violate it least.

    actions [N, A], observations [N, D], d [m] and d_dot [m/s] [N, M]; or all of one state, without
    N, and so is the answer. ``model(observations, actions) -> d, d_dot`` is asked for rows
    [S, D], [S, A] and answers with [S, M] of the states a decision later. Actions lie between
    ``low`` and ``high``, numbers or [A]. ``d_min`` [m] is needed where the certificate is not
    bound to one, as that of `safemr.load` is. Raises UserError for what does not fit.
    """
    plain, least = unbound(certificate, d_min)
    if least is None:
        raise UserError("give d_min, the distance to be kept [m]: this certificate has none")
    wanted, seen = np.asarray(actions), np.asarray(observations)
    single = wanted.ndim == 1
    if single:
        wanted, seen, d, d_dot = (
            wanted[None],
            seen[None],
            np.asarray(d)[None],
            np.array(d_dot)[None],
        )
    if wanted.ndim != 2:
        raise UserError(f"actions of shape {np.shape(actions)}: give [N, A], or [A] of one state")
    ends = (np.broadcast_to(np.asarray(end, np.float64), wanted.shape[1:]) for end in (low, high))
    looked = model if isinstance(model, Model) else FunctionModel(model)
    made = Filter(plain, least, looked, Span(*ends), margin=margin)
    choice = made.choose(wanted, seen, d, d_dot)
    return of_one(choice) if single else choice


def unbound(certificate: Any, d_min: float | None) -> tuple[Certificate, float | None]:
    """The certificate itself and its d_min: the one given, or the one that it is bound to.

    Raises UserError for anything else.
    """
    least = d_min
    if isinstance(certificate, BoundCertificate):
        least = certificate.d_min if d_min is None else d_min
        certificate = certificate.certificate
    if not isinstance(certificate, Certificate):
        raise UserError(
            f"{show(certificate)} is no certificate: give that of a record, "
            "safemr.load(folder).certificate, or "
            "safemr.EnergyCertificate(name, safemr.Zeta(sigma, k, n))"
        )
    number = isinstance(least, int | float | np.number) and not isinstance(least, bool)
    if least is not None and not (number and 0.0 < least < np.inf):
        raise UserError(f"d_min = {show(least)}: it must be a positive number [m]")
    return certificate, None if least is None else float(least)


def of_one(choice: Choice) -> Choice:
    """That of a single state, without the first axis."""
    parts = (choice.actions, choice.intervened, choice.distance, choice.margin, choice.feasible)
    return Choice(*(part[0] for part in parts))


def checked_distances(values: Any, name: str, rows: int | None = None) -> Array:
    """d or d_dot [N, M]. Raises UserError for another shape and for what is not finite."""
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError):
        raise UserError(f"{name} is no array of numbers: one entry an obstacle is asked") from None
    if array.ndim != 2 or array.shape[1] < 1 or (rows is not None and len(array) != rows):
        raise UserError(f"{name} has shape {array.shape}: one entry an obstacle is asked")
    if not np.isfinite(array).all():
        raise UserError(f"{name} is not finite: {show(array.tolist())}")
    return array
