"""What is this run's certificate? One object for every family of energy functions.

A certificate is an energy function phi with its parameters and its unit of length; what is safe is
{phi <= 0}, and what an action must keep is `Certificate.constraint`. Formulas stand in
`safemr.certificates.energy` only; a family says how its parameters are read and applied. A phi of
named parameters alone, the paper's of zeta = [sigma, k, n] or one of another package
(`safemr.certificates.families`), is `EnergyCertificate`; another kind is a subclass that names its
family, in the file of the algorithm that trains it:

    class MyCertificate(Certificate, family="mine"): ...

An algorithm says ``CERTIFICATE = "mine"`` in its file, and one without that line has none.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol, Self

from numpy.typing import NDArray

from safemr.certificates import energy, families
from safemr.certificates.families import EnergyFamily, Parameters
from safemr.errors import UserError
from safemr.files import Arrays
from safemr.names import unknown

NETWORK = "certificate_parameters"  # in a policy file: a network, which the paper's family has not

FAMILIES: dict[str, type[Certificate]] = {}  # by name, each entered when its class is made


class Recorded(Protocol):
    """What a family asks of a record (`safemr.experiment.record.Record`)."""

    @property
    def folder(self) -> Path: ...
    @property
    def rows(self) -> Sequence[Mapping[str, float]]: ...
    @property
    def name(self) -> str: ...
    @property
    def label(self) -> str: ...
    @property
    def inputs(self) -> dict[str, Any]: ...
    @property
    def algorithm(self) -> str: ...
    @property
    def hyperparameters(self) -> Mapping[str, Any]: ...
    @property
    def interface(self) -> Any: ...
    @property
    def has_policy(self) -> bool: ...
    def policy_arrays(self) -> Arrays: ...
    def policy(self) -> Any: ...
    def certificate_family(self) -> type[Certificate]: ...


def family_named(name: str) -> type[Certificate]:
    """The class of a family. Raises UserError naming those there are."""
    if name not in FAMILIES:
        raise unknown("family of certificates", name, FAMILIES)
    return FAMILIES[name]


class Certificate(ABC):
    """An energy function phi; its families are subclasses."""

    family: ClassVar[str]
    kind: ClassVar[str]  # what phi is made of, in words
    arrays: ClassVar[tuple[str, ...]]  # those of a policy file that say what phi is
    observes: ClassVar[bool] = False  # phi asks for the observation beside the distances

    name: str
    eta: float  # eta_D of the constraint, in units of phi
    length_scale: float  # unit of length in phi [m]
    record: Recorded | None  # of the run that ended with it

    def __init_subclass__(cls, *, family: str, **others: Any) -> None:
        super().__init_subclass__(**others)
        cls.family = family
        other = FAMILIES.get(family, cls)
        if (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(f"{cls.__qualname__}: the family {family!r} is {other.__qualname__}")
        FAMILIES[family] = cls

    @classmethod
    @abstractmethod
    def from_record(cls, record: Recorded) -> Self:
        """The certificate that a recorded run ended with.

        Raises UserError where the record's certificate is not of this family. Who does not know the
        family asks `Record.certificate`.
        """

    @property
    @abstractmethod
    def parameters(self) -> Mapping[str, float]:
        """The numbers that phi has by name, lengths in units of ``length_scale``."""

    @abstractmethod
    def phi(
        self,
        d: NDArray[Any],
        d_dot: NDArray[Any],
        d_min: float,
        observations: NDArray[Any] | None = None,
    ) -> NDArray[Any]:
        """phi [...], the largest over M obstacles, of d [m] and d_dot [m/s], both [..., M].

        ``observations`` [..., D] are the environment's, where the family `observes`.
        """

    def constraint(self, phi: NDArray[Any], phi_next: NDArray[Any]) -> NDArray[Any]:
        """g [...] of phi before and after a decision, kept where g < 0 (Eq. cstr0)."""
        return energy.constraint(phi, phi_next, self.eta)


def refuse_other_family(record: Recorded, expected: type[Certificate]) -> None:
    """Raises UserError where the record has no certificate, or one of a family not ``expected``."""
    family = record.certificate_family()
    if family is not expected:
        raise UserError(
            f"{record.folder}: the energy function of {record.algorithm} is {family.kind}, not "
            f"{expected.kind}"
        )


@dataclass(frozen=True)
class EnergyCertificate(Certificate, family="energy"):
    """phi of named parameters, ``zeta``: [sigma, k, n] (Eq. sis), or those of another family."""

    kind: ClassVar[str] = "that of [sigma, k, n] alone"
    arrays: ClassVar[tuple[str, ...]] = ("zeta", "length_scale")

    name: str
    zeta: Parameters
    eta: float = 0.0
    length_scale: float = 1.0
    record: Recorded | None = None

    @classmethod
    def from_record(cls, record: Recorded) -> Self:
        """With the last logged parameters, or those of the policy file where none are logged.

        Raises UserError where the record has no energy function, or one that is more than its
        parameters: who read them alone would measure another function.
        """
        arrays = record.policy_arrays() if record.has_policy else {}
        family = record.certificate_family()
        if family is not cls or NETWORK in arrays:
            kind = "a network beside a fixed [sigma, k, n]" if family is cls else family.kind
            raise UserError(
                f"{record.folder}: the energy function of {record.algorithm} is {kind}, so these "
                "three say nothing of it; its unsafe set is measured on the aircraft "
                "(docs/aircraft.md), its fixed part with safemr certify --sigma --k --n"
            )
        last = record.rows[-1]
        scale = record.hyperparameters.get("length_scale", arrays.get("length_scale", 1.0))
        parametric = families.named(str(record.hyperparameters.get("family", "paper")))
        names = parametric.names
        if last.keys() >= set(names):
            zeta = [last[name] for name in names]
        elif "zeta" in arrays:
            zeta = arrays["zeta"].astype(float).tolist()
        else:
            listing = " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
            raise UserError(f"{record.folder}: neither its progress nor its policy says {listing}")
        eta = float(record.hyperparameters.get("eta", 0.0))
        return cls(record.name, parametric.at(zeta), eta, float(scale), record)

    @property
    def energy_family(self) -> EnergyFamily:
        """Whose parameters ``zeta`` are."""
        return families.family_of(self.zeta)

    @property
    def entry(self) -> dict[str, Any]:
        """What measurements depend on: ``zeta`` and, of another family than the paper's, that."""
        named = {"family": self.energy_family.name, "version": self.energy_family.version}
        papers = self.energy_family is families.PAPER
        return {"zeta": list(self.zeta), **({} if papers else {"family": named})}

    @property
    def parameters(self) -> Mapping[str, float]:
        return self.zeta._asdict()

    def phi(
        self,
        d: NDArray[Any],
        d_dot: NDArray[Any],
        d_min: float,
        observations: NDArray[Any] | None = None,
    ) -> NDArray[Any]:
        lengths = energy.scaled(d, d_dot, d_min, self.length_scale)
        return energy.largest(families.phi_at(*lengths, self.zeta))

    def in_metres(self) -> EnergyCertificate:
        """The certificate of the same unsafe set and constraint with ``length_scale`` 1."""
        if self.length_scale == 1.0:
            return self
        zeta, factor = self.energy_family.in_metres(self.zeta, self.length_scale)
        eta = self.eta * factor
        return replace(self, zeta=self.energy_family.at(zeta), eta=eta, length_scale=1.0)
