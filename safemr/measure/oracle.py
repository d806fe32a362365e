"""How small a certificate may be on a task, and how small the learned ones are; kept.

`safemr.certificates.oracle` says what is meant. The oracle of a task is looked for in the box in
which JointSIS and SafeMR keep zeta, so that a learner could get there.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from safemr.certificates.certificate import EnergyCertificate
from safemr.certificates.falsification import make_simulator
from safemr.certificates.families import PAPER
from safemr.certificates.oracle import BEARINGS, POINTS, SPACING, ZOOMS, Encounters, smallest
from safemr.certificates.reachable import CELL
from safemr.experiment.catalogue import declared_certificate
from safemr.experiment.planning import installed
from safemr.experiment.record import Record
from safemr.learning.interface import Interface
from safemr.measure.certify import (
    DEFAULT_TASK,
    certificate_of_record,
    decisions_of,
    paper_certificates,
)
from safemr.measure.store import Measurements
from safemr.paper import PHI_0, PHI_H
from safemr.tasks import Task, name_of

ORACLE = "oracle"  # the certificate's name in tables
GRID = {"cell": list(CELL), "bearings": BEARINGS, "spacing": SPACING}
SEARCH = {"points": POINTS, "zooms": ZOOMS}
COLUMNS = ("task", "certificate", "variant", "seed", *PAPER.names, "area", "encounters",
           "infeasible", "worst", "regularized")  # fmt: skip


class Yardstick:
    """Encounters of a task for decisions of one interface, made when something is measured."""

    def __init__(self, task: Task, interface: Interface) -> None:
        self.task, self.interface = task, interface
        self._encounters: Encounters | None = None

    @property
    def inputs(self) -> dict[str, Any]:
        """What its verdicts depend on, for their key."""
        return {
            "task": installed(self.task),
            "action_repeat": self.interface.action_repeat,
            "action_scale": list(self.interface.action_scale),
            **GRID,
        }

    @property
    def encounters(self) -> Encounters:
        if self._encounters is None:
            envs = make_simulator(self.task, 1)
            interface = self.interface
            self._encounters = Encounters(envs, interface.action_repeat, interface.action_scale)
            envs.close()
        return self._encounters

    def oracle(self, measurements: Measurements) -> EnergyCertificate:
        """The least feasible member of the paper's family in JointSIS's box."""
        from safemr.algorithms import joint_sis  # PyTorch, a second

        box = joint_sis.Config().box
        inputs = {**self.inputs, "box": [list(ends) for ends in box], **SEARCH}

        def measure() -> list[float]:
            return list(smallest(self.encounters, PAPER, box, **SEARCH).zeta)

        label = f"{name_of(self.task)} hold {self.interface.action_repeat}"
        zeta = measurements.rows("oracle", label, inputs, measure)
        return EnergyCertificate(ORACLE, PAPER.at(zeta))

    def row(self, measurements: Measurements, certificate: EnergyCertificate) -> dict[str, Any]:
        """Area and feasibility of a certificate, of `COLUMNS` what is not said by a record."""
        certificate = certificate.in_metres()
        zeta, eta = certificate.zeta, certificate.eta
        inputs = {**self.inputs, **certificate.entry, "eta": eta}

        def measure() -> dict[str, float]:
            verdict = self.encounters.verdict(zeta, eta)
            return {
                "area": self.encounters.unsafe_area(zeta),
                "encounters": verdict.examined,
                "infeasible": verdict.infeasible,
                "worst": verdict.worst if verdict.infeasible else float("nan"),
            }

        label = f"{name_of(self.task)} hold {self.interface.action_repeat} {certificate.name}"
        kept = measurements.rows("encounters", label, inputs, measure)
        return {
            "task": name_of(self.task), "certificate": certificate.name, **zeta._asdict(), **kept
        }  # fmt: skip

    def references(self, measurements: Measurements) -> list[dict[str, Any]]:
        """Rows of the oracle, phi_h and phi_0, on the task of Table II of its learned sets, too."""
        of_table = name_of(self.task) == DEFAULT_TASK
        papers = [c for c in paper_certificates() if of_table or c.zeta in (PHI_H, PHI_0)]
        return [self.row(measurements, c) for c in (self.oracle(measurements), *papers)]


def measured_sizes(measurements: Measurements, folders: Sequence[Path]) -> pd.DataFrame:
    """One row a certificate, of `COLUMNS`: of each task of the records the references, then the
    records' own.

    All are judged over decisions as the records of the task make them. Records without a
    certificate of the paper's family give no row; ``variant``, ``seed`` and ``regularized``,
    whether the loss that made it had weights [a, b], are those of a record.
    """
    yardsticks: dict[tuple[str, Interface], Yardstick] = {}
    rows: list[dict[str, Any]] = []
    learned: list[dict[str, Any]] = []
    for folder in folders:
        record = Record.open(folder)
        if declared_certificate(record.algorithm) != EnergyCertificate.family:
            continue
        certificate = certificate_of_record(folder)[0]
        if certificate.energy_family is not PAPER:
            continue
        interface = decisions_of(certificate)
        key = (name_of(record.task), interface)
        if key not in yardsticks:
            yardsticks[key] = yardstick = Yardstick(record.task, interface)
            rows += yardstick.references(measurements)
        row = yardsticks[key].row(measurements, certificate)
        values = record.config["algorithm"]["hyperparameters"]
        regularized = any(values.get(weight) for weight in ("a", "b"))
        learned.append(
            {
                **row, "variant": record.variant, "seed": record.seed, "regularized": regularized
            }
        )  # fmt: skip
    return pd.DataFrame([*rows, *learned], columns=COLUMNS)
