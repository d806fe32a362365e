"""Check an energy function; what is found is printed by `safemr certify`.

Three questions, kept apart: does the analytic condition (*) hold (four verdicts,
`safemr.certificates.feasibility`); does a dense search find states without a safe action
(`safemr.certificates.falsification`); and does a trained policy pick violating actions although
safe ones exist. The certificate is given by its parameters, by a run record, or, with neither, is
each one that the paper prints. A record's is checked over its own decisions, as long and as large
as the interface of the run makes them; one without a record over single control steps. The analytic
condition is derived for the paper's phi, and left out for other families (`safemr.certificates.
families`); all else is theirs, too.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from safemr import paper
from safemr.certificates import falsification
from safemr.certificates.certificate import EnergyCertificate, Recorded
from safemr.certificates.feasibility import analytic_condition
from safemr.experiment.planning import installed
from safemr.experiment.record import Record
from safemr.learning.interface import Interface
from safemr.measure.policy_check import check_policy
from safemr.measure.store import Measurements
from safemr.paper import Zeta
from safemr.tasks import Task, name_of

DEFAULT_TASK = paper.SENSITIVITY_TASK  # Table II's
DEFAULT_STATES = 2**16


def paper_certificates() -> list[EnergyCertificate]:
    """The three learned sets of Table II, phi_h and phi_0."""
    learned = [
        EnergyCertificate(f"paper [{a:g}, {b:g}]", zeta) for (a, b), zeta in paper.TABLE_II.items()
    ]
    return [
        *learned,
        EnergyCertificate("phi_h", paper.PHI_H),
        EnergyCertificate("phi_0", paper.PHI_0),
    ]


def certificate_of_record(folder: Path) -> tuple[EnergyCertificate, dict[str, Any]]:
    """The certificate a run ended with, in metres, and its task: the entry in the run's config.

    Raises UserError where there is no record, or one whose certificate is more than a phi of named
    parameters: the search is for those.
    """
    record = Record.open(folder)
    return EnergyCertificate.from_record(record).in_metres(), record.task


def decisions_of(certificate: EnergyCertificate) -> Interface:
    """How long and how large the actions are over which a certificate is to hold.

    The environment's own where it has no record.
    """
    interface: Interface = certificate.record.interface if certificate.record else Interface()
    return dataclasses.replace(interface, decode=())


def certify(
    certificate: EnergyCertificate,
    task: Task = DEFAULT_TASK,
    *,
    states: int = DEFAULT_STATES,
    seed: int = 0,
    episodes: int = 32,
) -> tuple[dict[str, Any], falsification.Falsification]:
    """One row of the certificate table, and the search behind it.

    The row: certificate, task, the parameters by name and, of another family than the paper's,
    ``family``, eta, the margins of the four analytic verdicts of the paper's family [m/s^2],
    states searched, infeasible and leak share, worst margin, verdicts shared by the simulator, and,
    with a policy, its decisions (``policy_steps``) and their violating and avoidable shares in
    `episodes` episodes, of whose violating decisions at most 8 an episode are searched for a safe
    action. Where a decision is not one control step, ``action_repeat`` says how many.
    """
    certificate = certificate.in_metres()
    interface = decisions_of(certificate)
    zeta, eta = certificate.zeta, certificate.eta
    envs = falsification.make_simulator(task)
    margins: dict[str, float] = {}
    if isinstance(zeta, Zeta):
        analytic = analytic_condition(zeta, float(envs.d_min), eta=eta)
        margins = {margin_column(str(r[1]), str(r[2])): float(r[3]) for r in analytic.itertuples()}
    search = falsification.falsify(
        envs, task, zeta, eta=eta, count=states, seed=seed,
        action_repeat=interface.action_repeat, action_scale=interface.action_scale,
    )  # fmt: skip
    envs.close()
    row: dict[str, Any] = {
        "certificate": certificate.name, "task": name_of(task), **zeta._asdict(), "eta": eta,
        **margins,
        "states": len(search.states), "infeasible_share": search.infeasible_share,
        "leak_share": search.leak_share, "worst_margin": search.worst_margin,
        "simulator_agrees": f"{search.confirmed}/{search.examined}",
    }  # fmt: skip
    if not margins:
        row["family"] = certificate.energy_family.name
    if interface.action_repeat != 1:
        row["action_repeat"] = interface.action_repeat
    if (record := trained_policy(certificate)) is not None:
        check = check_policy(
            record.policy(), task, zeta, eta=eta, num_envs=episodes, seed=seed,
            limit=8 * episodes, action_scale=interface.action_scale,
        )  # fmt: skip
        row |= {
            "policy_steps": check.decisions,
            "policy_violating_share": check.violating_share,
            "policy_avoidable_share": check.avoidable_share,
        }
    return row, search


def measured_certificate(
    measurements: Measurements,
    certificate: EnergyCertificate,
    task: Task,
    *,
    states: int,
    episodes: int,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The row of `certify` and the example of its search, kept among ``measurements``."""
    certificate = certificate.in_metres()
    record = trained_policy(certificate)
    inputs = {
        "name": certificate.name, **certificate.entry, "eta": certificate.eta,
        "task": installed(task),
        "states": states, "episodes": episodes,
        "policy": record and record.inputs,
        **_inputs(certificate),
    }  # fmt: skip

    def measure() -> dict[str, Any]:
        row, search = certify(certificate, task, states=states, episodes=episodes)
        return {"row": row, "example": search.example()}

    kept = measurements.rows("certificates", _label(certificate, task), inputs, measure)
    return kept["row"], kept["example"]


def measured_margins(
    measurements: Measurements, certificate: EnergyCertificate, task: Task
) -> tuple[pd.DataFrame, float]:
    """`margin_map` of a certificate, and the task's d_min, kept among ``measurements``."""
    certificate = certificate.in_metres()
    inputs = {
        **certificate.entry, "eta": certificate.eta,
        "task": installed(task),
        **_inputs(certificate),
    }  # fmt: skip

    def measure() -> dict[str, Any]:
        margins = margin_map(certificate, task)
        columns = {name: margins[name].to_numpy() for name in margins}
        return columns | {"d_min": np.array(contact_distance(task))}

    kept = dict(measurements.arrays("margins", _label(certificate, task), inputs, measure))
    d_min = float(kept.pop("d_min"))
    return pd.DataFrame(kept), d_min


def margin_map(
    certificate: EnergyCertificate, task: Task, *, distances: int = 37, bearings: int = 37
) -> pd.DataFrame:
    """Best margin of the least favourable motion at each distance and bearing.

    The maximum over courses within 0.4 rad of the obstacle, three speeds and three turn rates of
    the least g over the action grid, held for a decision. Returns distance, bearing, margin; nan
    where the robot would overlap the obstacle. Positive: from some such motion no action is safe.
    """
    certificate, interface = certificate.in_metres(), decisions_of(certificate)
    zeta, held = certificate.zeta, (interface.action_repeat, interface.action_scale)
    envs = falsification.make_simulator(task, 1)
    robot, d_min = falsification.ROBOT, float(envs.d_min)
    reach = falsification.largest_distance(zeta, d_min, interface.action_repeat)
    turn_rates = robot.max_turn_rate * np.linspace(-1, 1, 3)
    axes = (np.linspace(d_min, reach, distances), np.linspace(0, np.pi, bearings),
            np.linspace(-0.4, 0.4, 3), robot.max_speed * np.array([0.0, 0.5, 1.0]),
            turn_rates)  # fmt: skip
    states = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 5)
    parts = np.array_split(states, max(1, len(states) // falsification.CHUNK))
    least = np.concatenate(
        [
            falsification.grid_margins(part, d_min, zeta, certificate.eta, *held).min(1)
            for part in parts
        ]
    )
    overlap = falsification.overlaps_obstacle(envs, states)
    envs.close()
    least[overlap] = np.nan
    margin = least.reshape(distances * bearings, -1).max(1)
    places = states.reshape(distances * bearings, -1, 5)[:, 0]
    return pd.DataFrame({"distance": places[:, 0], "bearing": places[:, 1], "margin": margin})


def example_titles(jobs: Sequence[tuple[EnergyCertificate, Task]]) -> list[str]:
    """A name for the example of each certificate on its task; equal ones are numbered."""
    titles: list[str] = []
    for certificate, task in jobs:
        title = f"{certificate.name} on {name_of(task)}"
        numbered = (f"{title}, {number}" for number in itertools.count(2))
        titles.append(
            title if title not in titles else next(t for t in numbered if t not in titles)
        )
    return titles


def trained_policy(certificate: EnergyCertificate) -> Recorded | None:
    """The record of the policy that was trained with it, where there is one (it is optional)."""
    record = certificate.record
    return record if record is not None and record.has_policy else None


def _inputs(certificate: EnergyCertificate) -> dict[str, Any]:
    """What the measurements of a certificate depend on where its decisions are not the default."""
    entry = decisions_of(certificate).entry()
    return {"interface": entry} if entry else {}


def _label(certificate: EnergyCertificate, task: Task) -> str:
    if (record := trained_policy(certificate)) is not None:
        return record.label
    return f"{certificate.name} {name_of(task)}"


def contact_distance(task: Task) -> float:
    envs = falsification.make_simulator(task, 1)
    d_min = float(envs.d_min)
    envs.close()
    return d_min


def margin_column(convention: str, braking: str) -> str:
    return f"margin_{convention}_{braking.split()[0]}"
