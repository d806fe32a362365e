"""A record that was opened: verified once, and then the one answer to what a run was and became."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safemr.certificates.certificate import Certificate, EnergyCertificate
from safemr.errors import UserError
from safemr.experiment import records
from safemr.files import POLICY, Arrays, policy_arrays
from safemr.learning.interface import Interface
from safemr.paper import Zeta

if TYPE_CHECKING:
    from safemr.learning.policies import Policy


@dataclass(frozen=True)
class Record:
    """A verified record; made by `Record.open`."""

    folder: Path
    config: Mapping[str, Any]  # the resolved configuration of the run
    provenance: Mapping[str, Any]
    rows: Sequence[records.Row]  # of progress.csv, the last one being the end of training

    @classmethod
    def open(cls, folder: Path | str) -> Record:
        """The record in ``folder``.

        Raises:
            RecordError: as `safemr.experiment.records.verify_record`.
        """
        return cls(Path(folder), *records.verified(Path(folder)))

    @property
    def variant(self) -> str:
        """The label under which figures and tables show the run."""
        return self.provenance["variant"]

    @property
    def task(self) -> dict[str, Any]:
        """The task's entry in the configuration, from which `safemr.tasks` makes it."""
        return dict(self.config["task"])

    @property
    def seed(self) -> int:
        return self.config["seed"]

    @property
    def algorithm(self) -> str:
        return self.config["algorithm"]["name"]

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        return self.config["algorithm"].get("hyperparameters", {})

    @property
    def interface(self) -> Interface:
        """How the learner met its task. Raises UserError where the configuration's is none."""
        return Interface.read(self.config.get("interface"), f"{self.folder}: interface")

    @property
    def name(self) -> str:
        """The run among others of its task: ``SafeMR (seed 0)``."""
        return f"{self.variant} (seed {self.seed})"

    @property
    def label(self) -> str:
        """Its name among measurements: task, variant, seed and digest."""
        return " ".join(self.folder.parts[-3:])

    @property
    def inputs(self) -> dict[str, Any]:
        """What identifies its content: its last three folders and its checksums."""
        return {"record": "/".join(self.folder.parts[-3:]), "files": self.provenance["files"]}

    @property
    def has_policy(self) -> bool:
        """Whether it holds the trained policy, which is optional."""
        return (self.folder / POLICY).is_file()

    def policy_arrays(self) -> Arrays:
        """The arrays of its policy file, read when first asked for.

        Raises UserError where it has none.
        """
        return self._policy_arrays

    @functools.cached_property
    def _policy_arrays(self) -> Arrays:
        return policy_arrays(self.folder / POLICY)

    def certificate_family(self) -> type[Certificate]:
        """The class of its certificate, which its algorithm's file declares.

        An outside implementation's record, whose algorithm has no file here, is of the paper's
        family where it logs sigma, k and n. Raises UserError where there is no certificate, or
        where the package that has the algorithm is not there.
        """
        from safemr.experiment import catalogue

        trained_here = "package" in self.config["algorithm"]  # by a module of another package
        if trained_here or self.algorithm in catalogue.algorithm_names():
            family = catalogue.declared_certificate(self.algorithm)
        else:
            family = EnergyCertificate.family if self.rows[-1].keys() >= set(Zeta._fields) else None
        if family is None:
            raise UserError(
                f"{self.folder}: its algorithm, {self.algorithm}, has no energy function and so no "
                "certificate"
            )
        return catalogue.certificate_family(family, self.algorithm)

    def certificate(self) -> Certificate:
        """The certificate that the run ended with. Raises UserError where it has none."""
        return self.certificate_family().from_record(self)

    def policy(self) -> Policy:
        """Its trained policy. Raises UserError where it has none that can act."""
        from safemr.learning.policies import load_policy  # torch, seconds

        return load_policy(self.folder)
