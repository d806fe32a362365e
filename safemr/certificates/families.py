"""Families of energy functions: phi with named parameters, each family one file.

The paper's family, phi of zeta = [sigma, k, n], is `PAPER`. Another one is a module of any package
(`safemr.packages`) that has

    VERSION = 1                      # raised when its numbers change
    PARAMETERS = {                   # in the order of phi's arguments
        "sigma": Parameter(start=0.1, low=0.0, high=1.0, metres=1),
        "u": Parameter(start=1.0, low=0.1, high=10.0, metres=1),
    }

    def phi(d, d_dot, d_min, sigma, u): ...

with phi per obstacle, of arrays of one shape, and safe where phi <= 0. It works on numpy arrays and
on torch tensors alike, is differentiable in the parameters, and falls with d and with d_dot. It may
have ``magnitude(d_min, sigma, u, a, b)``, the regularization term of weights a and b (`magnitude`
is what it is otherwise), and ``METRES``, the power of metres in phi's own unit, which is 1 where
nothing is said.

What the learners (`safemr.algorithms.fac` and what extends it), the certificate's check, the
comparison on the aircraft and the figures need follows from these.
"""

from __future__ import annotations

import functools
import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from safemr import packages
from safemr.certificates import energy
from safemr.certificates.energy import Array
from safemr.errors import UserError, show
from safemr.names import unknown
from safemr.paper import Zeta

# Columns of records and keys of examples that no parameter may be called.
_TAKEN = {
    *("step", "a", "b", "eta", "length_scale", "task", "base", "settings", "state", "margin"),
    *("family", "kind", "variant", "seed", "certificate", "states", "temperature", "updates"),
    *("action_repeat", "action_scale", "volume_ratio", "iou", "effort", "covers"),
}
_TAKEN_PREFIXES = ("train_", "eval_", "time_", "certificate_", "multiplier", "policy_")


@dataclass(frozen=True)
class Parameter:
    """A parameter of a family: where learning starts, and the box that it stays in.

    metres: the power of metres in its unit: 1 for m, m/s and m/s^2, 0 for s, -1 for 1/m. With it a
    certificate in other units of length is the same one in metres.
    """

    start: float
    low: float
    high: float
    metres: float = 0.0


@dataclass(frozen=True)
class EnergyFamily:
    """phi(d, d_dot, d_min, *parameters) [...] of d and d_dot [...], and what belongs to it."""

    name: str  # "paper", or the module's
    version: int
    names: tuple[str, ...]  # of the parameters, in the order of phi's arguments
    parameters: tuple[Parameter, ...]  # none: those of the paper's are hyperparameters by name
    phi: Callable[..., Array]
    magnitude: Callable[..., Array]  # of d_min, the parameters and the weights a and b
    metres: float = 1.0  # power of metres in phi's unit

    def at(self, values: Sequence[float]) -> Parameters:
        """The parameters as one thing that knows its family, in the order of `names`."""
        return Zeta(*values) if self is PAPER else Values(self, values)

    def in_metres(
        self, values: Sequence[float], length_scale: float
    ) -> tuple[tuple[float, ...], float]:
        """The parameters of the same unsafe set with lengths in metres instead of units of
        ``length_scale`` [m], and what phi is multiplied by."""
        if self is PAPER:
            return energy.in_metres(values, length_scale), length_scale ** values[2]
        scaled = (
            value * length_scale**parameter.metres
            for value, parameter in zip(values, self.parameters, strict=True)
        )
        return tuple(scaled), length_scale**self.metres


class Values(tuple[float, ...]):
    """The parameters of another family than the paper's, whose are a `Zeta`."""

    family: EnergyFamily

    def __new__(cls, family: EnergyFamily, values: Sequence[float]) -> Values:
        if len(values) != len(family.names):
            raise ValueError(f"{family.name} has the parameters {', '.join(family.names)}")
        made = super().__new__(cls, map(float, values))
        made.family = family
        return made

    def _asdict(self) -> dict[str, float]:  # as a named tuple has it
        return dict(zip(self.family.names, self, strict=True))


Parameters: TypeAlias = Zeta | Values

PAPER = EnergyFamily("paper", 1, Zeta._fields, (), energy.energy, energy.magnitude)


def family_of(values: Parameters) -> EnergyFamily:
    """The family whose parameters these are."""
    return values.family if isinstance(values, Values) else PAPER


def phi_at(d: Array, d_dot: Array, d_min: Array, values: Parameters) -> Array:
    """phi per obstacle at some parameters, of the shape of d and d_dot."""
    return family_of(values).phi(d, d_dot, d_min, *values)


def magnitude(phi: Callable[..., Array]) -> Callable[..., Array]:
    """The regularization term of a family that says none, from its phi at two points.

    a phi(0, 0) + b (phi(0, -1) - phi(0, 0)): the energy in contact at rest, and what one unit of
    closing speed adds. Of the paper's phi these are (sigma + d_min)^n and k (Eq. sisadd).
    """

    def term(d_min: Array, *values: Array) -> Array:
        *parameters, a, b = values
        zero = 0.0 * parameters[0]  # a number, array or tensor, as the parameters are
        at_rest = phi(zero, zero, d_min, *parameters)
        return a * at_rest + b * (phi(zero, zero - 1.0, d_min, *parameters) - at_rest)

    return term


def full_name(name: str) -> str:
    """The name under which a record knows a family: "paper" or a module's.

    Raises UserError for a name that nothing has.
    """
    if name == PAPER.name or packages.is_outside(name):
        return name
    registered = packages.registered(packages.CERTIFICATES)
    if name not in registered:
        error = unknown("family of energy functions", name, [PAPER.name, *registered])
        raise UserError(f"{error}; one of yours is named by its module, PACKAGE.MODULE")
    return registered[name]


@functools.cache
def named(name: str) -> EnergyFamily:
    """A family by its name in a configuration.

    Raises:
        UserError: there is none, or its module breaks the contract; naming it and the remedy.
    """
    name = full_name(name)
    if name == PAPER.name:
        return PAPER
    module = packages.imported(name)
    for part in ("VERSION", "PARAMETERS", "phi"):
        if not hasattr(module, part):
            raise UserError(f"{name} must define {part}; see safemr.certificates.families")
    if type(module.VERSION) is not int or module.VERSION < 1:
        raise UserError(f"{name}: VERSION must be an integer from 1 on, not {show(module.VERSION)}")
    parameters = _checked(module.PARAMETERS, name)
    made = EnergyFamily(
        name,
        module.VERSION,
        tuple(parameters),
        tuple(parameters.values()),
        module.phi,
        getattr(module, "magnitude", None) or magnitude(module.phi),
        float(getattr(module, "METRES", 1.0)),
    )
    _try(made)
    return made


def _checked(parameters: Any, where: str) -> Mapping[str, Parameter]:
    if not isinstance(parameters, Mapping) or not parameters:
        raise UserError(f"{where}: PARAMETERS must map names to Parameter(start, low, high)")
    for name, parameter in parameters.items():
        if not isinstance(name, str) or not re.fullmatch(r"[a-z][a-z0-9_]{0,19}", name):
            raise UserError(f"{where}: {show(name)} is no name of a parameter: use a-z, 0-9 and _")
        if name in _TAKEN or name.startswith(_TAKEN_PREFIXES):
            raise UserError(f"{where}: no parameter can be called {name}, as records have that")
        if not isinstance(parameter, Parameter):
            raise UserError(f"{where}: {name} must be a Parameter(start, low, high)")
        box = (parameter.low, parameter.start, parameter.high)
        if not all(map(math.isfinite, box)) or sorted(box) != list(box):
            raise UserError(f"{where}: {name} must have low <= start <= high, all finite")
    return parameters


# Where phi is tried: distances and rates around a contact at _CONTACT, in any unit.
_CONTACT = 0.5
_DISTANCES, _RATES = np.array([0.25, 0.5, 0.7, 1.0, 2.0, 5.0, 20.0]), np.linspace(-2.0, 2.0, 9)


def _try(family: EnergyFamily) -> None:
    """Raises UserError for a phi that does not do what the module above promises."""

    def require(holds: bool, what: str, remedy: str) -> None:
        if not holds:
            raise UserError(f"{family.name}: {what}; {remedy}")

    names = ", ".join(family.names)
    for function, arguments in (("phi", "d, d_dot, d_min"), ("magnitude", "d_min")):
        given = [0.0] * (len(arguments.split(",")) + len(family.names) + 2 * (function != "phi"))
        try:
            inspect.signature(getattr(family, function)).bind(*given)
        except TypeError as error:
            weights = ", a, b" * (function != "phi")
            raise UserError(
                f"{family.name}: {function} must take ({arguments}, {names}{weights}): {error}"
            ) from error
    d, rate = np.meshgrid(_DISTANCES, _RATES, indexing="ij")
    start = [parameter.start for parameter in family.parameters]
    for index, parameter in enumerate(family.parameters):
        for end in ("start", "low", "high"):
            values = [*start[:index], np.float64(getattr(parameter, end)), *start[index + 1 :]]
            where = f"at {family.names[index]} = {getattr(parameter, end):g}"
            try:
                with np.errstate(all="ignore"):
                    phi = np.asarray(family.phi(d, rate, _CONTACT, *values), float)
                    size = float(family.magnitude(_CONTACT, *values, 1.0, 1.0))
            except Exception as error:  # whatever is wrong in that file
                reason = str(error).partition("\n")[0]
                raise UserError(
                    f"{family.name} fails {where}: {type(error).__name__}: {reason}"
                ) from error
            require(
                phi.shape == d.shape,
                f"phi has shape {phi.shape} for d of shape {d.shape}",
                "give one value an obstacle, of the shape of d and d_dot",
            )
            finite = bool(np.isfinite(phi).all()) and math.isfinite(size)
            require(finite, f"phi or its magnitude is not finite {where}", "narrow the box")
            for axis, name in enumerate(("d", "d_dot")):
                falls = bool((np.diff(phi, axis=axis) <= 1e-9 * (1.0 + np.abs(phi).max())).all())
                require(
                    falls,
                    f"phi rises with {name} {where}",
                    "it is large near an obstacle that comes nearer: check signs",
                )
    doubled, factor = family.in_metres(start, 2.0)
    same = np.allclose(
        family.phi(2.0 * d, 2.0 * rate, 2.0 * _CONTACT, *doubled),
        factor * np.asarray(family.phi(d, rate, _CONTACT, *start)),
    )
    require(
        same,
        "phi in other units of length is another function",
        "say the powers of metres in units: Parameter(..., metres=1) and, for phi's own, METRES",
    )
