"""The aircraft experiment's numbers: every learner, and what to hold it against, as tables.

A *comparison* is a DataFrame with one row per certificate (and policy, where there is one): the
recorded runs, then fixed references. Columns: ``kind`` ("learner", "certificate", "policy"),
``variant``, ``seed`` (-1 for references), ``sigma, k, n`` in units of ``length_scale`` metres, or
the parameters of another family and its name as ``family``,
``eta`` in units of phi, `COLUMNS` of `unsafe_sets.CertificateMetrics`, ``least_volume_ratio`` (the
frontier's at the same missed share), and those of `unsafe_sets.Flights.summary`. What does not
apply to a row is nan.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from envs.aircraft import BOX_HIGH, BOX_LOW, AircraftDynamics
from safemr import paper
from safemr.aircraft import reachability, unsafe_sets
from safemr.aircraft.reachability import Solution
from safemr.aircraft.reachability.grid import Floats
from safemr.aircraft.slices import Slice, near_boundary
from safemr.aircraft.unsafe_sets import Truth
from safemr.certificates.certificate import Certificate, EnergyCertificate
from safemr.certificates.energy import constraint
from safemr.certificates.families import PAPER, Parameters, named
from safemr.conventions import COVERS
from safemr.errors import UserError
from safemr.experiment.planning import installed
from safemr.experiment.record import Record
from safemr.files import POLICY
from safemr.learning.evaluation import Acts
from safemr.measure.store import Measurements
from safemr.paper import Zeta
from safemr.tasks import Task, name_of

Family = TypeVar("Family", bound=Certificate)

FLIGHTS, STARTS_SEED = 10_000, 20_000  # safe initial states of every policy, the same for all
# Between them the frontier is interpolated by chords, above a convex one, which flatters the runs
# there: by 0.013 of the true volume at 0.3, where 0.2 and 0.4 alone are known.
MISSED_SHARES = (
    *(0.0, 0.001, 0.003, 0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.125, 0.15, 0.175),
    *(0.2, 0.225, 0.25, 0.275, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
)

# Fixed certificates, in metres. The last is where the released JointSIS code starts.
CERTIFICATES: Mapping[str, tuple[float, float, float]] = {
    "phi_h": paper.PHI_H,
    "phi_0": paper.PHI_0,
    "code init": (0.3, 1.0, 1.0),
}
TRUE_SET, ADVERSARIAL_SET, STRAIGHT = "true set", "true set, adversarial", "straight flight"
CONTROL = "fit to the truth"  # what `safemr.aircraft.neural` holds against the learners
COLUMNS = ("volume_ratio", "missed_share", "iou", "infeasible_share", "infeasible_share_eta",
           "leak_share")  # fmt: skip


class _Straight:
    """No turn at all: how often the encounter resolves itself."""

    def act(self, observations: NDArray[Any], deterministic: bool = True) -> NDArray[np.float32]:
        return np.zeros((len(observations), 1), np.float32)


class Obedient:
    """The least turn that keeps g <= 0 (Eq. cstr0, eta 0), else the one with the least g.

    What a perfect learner of this certificate would do: collisions it has are the certificate's.
    """

    def __init__(self, dynamics: AircraftDynamics, phi: unsafe_sets.Energy) -> None:
        self.dynamics, self.phi = dynamics, phi
        rates = np.linspace(-dynamics.turn_limit, dynamics.turn_limit, 21)
        self.rates = rates[np.argsort(np.abs(rates), kind="stable")]

    def act(self, observations: Floats, deterministic: bool = True) -> NDArray[np.float32]:
        x, y, cos, sin = observations.T
        states = np.stack([x, y, np.arctan2(sin, cos)], axis=-1)
        (b,) = self.dynamics.other_turns
        now = self.phi(states)
        g = np.stack(
            [constraint(now, self.phi(self.dynamics.flow(states, a, b)), 0.0) for a in self.rates]
        )
        chosen = np.argmax(g <= np.maximum(g.min(axis=0), 0.0), axis=0)
        return self.rates[chosen, None].astype(np.float32)


class TrueSets:
    """The solved values of both cases and samples of the first, each made when first asked for.

    ``solve`` returns the solution of a case; nobody waits for it where all numbers are kept. The
    constant case is the traffic of ``task`` (`safemr.aircraft.unsafe_sets.dynamics_of`).
    """

    def __init__(
        self,
        solve: Callable[[AircraftDynamics], Solution],
        log2_states: int = 19,
        task: Task = paper.AIRCRAFT_TASK,
    ) -> None:
        self._solve, self.log2_states, self.task = solve, log2_states, task
        self.dynamics = unsafe_sets.dynamics_of(task)

    @classmethod
    def cached(
        cls, folder: Path | str, log2_states: int = 19, task: Task = paper.AIRCRAFT_TASK
    ) -> TrueSets:
        """From the solutions kept in ``folder`` (`safemr.aircraft.reachability.load_or_solve`)."""
        return cls(functools.partial(reachability.load_or_solve, Path(folder)), log2_states, task)

    def kept_as(self, label: str) -> tuple[str, dict[str, Any]]:
        """Label and inputs of what is measured of the solution alone; those of the registered task
        name none, as ever."""
        if self.dynamics == reachability.CONSTANT:
            return label, {}
        return f"{label} {name_of(self.task)}", {"task": installed(self.task)}

    @functools.cached_property
    def constant(self) -> Solution:
        return self._solve(self.dynamics)

    @functools.cached_property
    def adversarial(self) -> Solution:
        return self._solve(reachability.ADVERSARIAL)

    @functools.cached_property
    def truth(self) -> Truth:
        return Truth.sample(self.constant, self.log2_states)

    def starts(self, flights: int) -> Floats:
        """[N, 3] safe initial states, the same for every policy."""
        return unsafe_sets.safe_starts(self.constant, flights, STARTS_SEED)


def measured_frontier(
    measurements: Measurements, sets: TrueSets, missed_shares: Sequence[float] = MISSED_SHARES
) -> pd.DataFrame:
    """`frontier_table`, kept among ``measurements``."""
    label, own = sets.kept_as("frontier")
    inputs = {
        "missed_shares": list(missed_shares), "solver": reachability.VERSION,
        "log2_states": sets.log2_states, **own,
    }  # fmt: skip
    rows = measurements.rows(
        "aircraft_frontier", label, inputs,
        lambda: frontier_table(sets.truth, missed_shares).to_dict("records"),
    )  # fmt: skip
    return pd.DataFrame(rows)


def frontier_table(truth: Truth, missed_shares: Sequence[float] = MISSED_SHARES) -> pd.DataFrame:
    """missed_share, volume_ratio, sigma, k, n (metres): the best members of the energy family."""
    points = unsafe_sets.frontier(truth, missed_shares)
    rows = [(point.missed_share, point.volume_ratio, *point.zeta) for point in points]
    return pd.DataFrame(rows, columns=["missed_share", "volume_ratio", "sigma", "k", "n"])


def compare(
    sets: TrueSets,
    frontier: pd.DataFrame,
    root: Path,
    runs: pd.DataFrame,
    flights: int = FLIGHTS,
) -> pd.DataFrame:
    """The comparison of recorded runs (rows of `records.read_records`'s index) and references.

    What is measured is kept among the measurements under ``root``. Raises UserError naming every
    record whose policy file does not say what its certificate is, and one of other traffic.
    """
    measurements = Measurements(root)
    shared = {
        "task": installed(sets.task), "flights": flights, "starts_seed": STARTS_SEED,
        "log2_states": sets.log2_states, "solver": reachability.VERSION,
    }  # fmt: skip
    rows = []
    for run, record, learned in learners(root, runs, sets.dynamics, EnergyCertificate):

        def measure(
            record: Record = record, learned: EnergyCertificate = learned
        ) -> dict[str, Any]:
            own = _certificate(sets.truth, learned)
            return own | flights_of(record.policy(), sets.starts(flights), sets.truth)

        inputs = {**shared, "policy": record.inputs}
        rows.append(
            {"kind": "learner", "variant": run.variant, "seed": int(run.seed)}
            | measurements.rows("aircraft_learners", record.label, inputs, measure)
        )
    inputs = {**shared, "certificates": {name: list(zeta) for name, zeta in CERTIFICATES.items()}}
    rows += measurements.rows(
        "aircraft_references", sets.kept_as("references")[0], inputs,
        lambda: _references(sets, flights),
    )  # fmt: skip
    table = pd.DataFrame(rows)
    table["covers"] = table["missed_share"] <= COVERS
    table["least_volume_ratio"] = np.interp(
        table["missed_share"], frontier["missed_share"], frontier["volume_ratio"]
    )
    return table


def _references(sets: TrueSets, flights: int) -> list[dict[str, Any]]:
    """The rows of what is held against the learners."""
    truth, starts = sets.truth, sets.starts(flights)
    rows: list[dict[str, Any]] = [
        {"kind": "certificate", "variant": name, "seed": -1}
        | _certificate(truth, EnergyCertificate(name, Zeta(*zeta)))
        | flights_of(_obeying(truth, zeta), starts, truth)
        for name, zeta in CERTIFICATES.items()
    ]
    wider = sets.adversarial(truth.states) <= 0
    rows += [
        {"kind": "certificate", "variant": ADVERSARIAL_SET, "seed": -1}
        | {"volume_ratio": float(wider.sum() / truth.unsafe.sum()), "missed_share": 0.0}
        | {"iou": float((wider & truth.unsafe).sum() / (wider | truth.unsafe).sum())},
        {"kind": "policy", "variant": TRUE_SET, "seed": -1}
        | {"volume_ratio": 1.0, "missed_share": 0.0, "iou": 1.0}
        | flights_of(unsafe_sets.OptimalEvader(sets.constant), starts, truth),
        {"kind": "policy", "variant": STRAIGHT, "seed": -1}
        | flights_of(_Straight(), starts, truth),
    ]
    return rows


def as_scores(comparison: pd.DataFrame, task: str = paper.AIRCRAFT_TASK) -> pd.DataFrame:
    """The learners' rows as a score table: task, variant, seed, metric, value."""
    learners = comparison[comparison["kind"] == "learner"]
    learners = learners.drop(columns=["kind", "covers", "family"], errors="ignore")
    tidy = learners.melt(id_vars=["variant", "seed"], var_name="metric").dropna(subset="value")
    return tidy.assign(task=task, value=tidy["value"].astype(float))


def learned_zetas(comparison: pd.DataFrame, variant: str) -> list[tuple[Parameters, float]]:
    """(zeta, length_scale) of each seed of a variant."""
    chosen = comparison[(comparison["kind"] == "learner") & (comparison["variant"] == variant)]
    found = []
    for _, row in chosen.sort_values("seed").iterrows():
        said = row.get("family")
        family = named(said) if isinstance(said, str) else PAPER
        zeta = family.at(row[list(family.names)].to_numpy(float))
        found.append((zeta, float(row["length_scale"])))
    return found


def plane(spacing: float) -> tuple[Floats, Floats]:
    """x [X] and y [Y] of a regular grid over the box where encounters start."""
    x, y = (
        np.arange(low, high + spacing / 2, spacing)
        for low, high in zip(BOX_LOW, BOX_HIGH, strict=True)
    )
    return x, y


def slices(
    sets: TrueSets,
    comparison: pd.DataFrame,
    measurements: Measurements,
    degrees: Sequence[float] = (0, 60, 120, 180, 240, 300),
    spacing: float = 0.1,
    method: str = paper.METHOD,
    handcrafted: Collection[str] = (),
) -> tuple[Floats, Floats, list[Slice]]:
    """x [X], y [Y] over the box where encounters start, and all unsafe sets at each psi.

    The learned ones are those of all variants but the ``handcrafted``; every set contains the disc.
    The solved values are kept among ``measurements`` (`near_boundary`).
    """
    dynamics = sets.dynamics
    label, own = sets.kept_as("slices")
    x, y = plane(spacing)
    planes = [
        np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), psi)], -1)
        for psi in np.radians(degrees)
    ]
    solved = measurements.arrays(
        "aircraft_slices",
        label,
        {"degrees": list(degrees), "spacing": spacing, "solver": reachability.VERSION, **own},
        lambda: {
            name: near_boundary(np.stack([solution(states) for states in planes]))
            for name, solution in (("truth", sets.constant), ("adversarial", sets.adversarial))
        },
    )
    zetas = {
        str(variant): learned_zetas(comparison, str(variant))
        for variant in comparison["variant"].unique()
        if variant not in handcrafted
    }

    def claimed(states: Floats, zeta: Parameters, length_scale: float) -> Floats:
        phi = unsafe_sets.energy_of(dynamics, zeta, length_scale)(states)
        return np.maximum(phi, dynamics.d_min - dynamics.separation(states))

    cuts = []
    for index, states in enumerate(planes):
        cuts.append(
            Slice(
                psi=float(states[0, 0, 2]),
                truth=solved["truth"][index],
                handcrafted=claimed(states, paper.PHI_H, 1.0),
                learned={
                    variant: [claimed(states, *learned) for learned in found]
                    for variant, found in zetas.items()
                    if found
                },
                adversarial=solved["adversarial"][index],
                method=method,
            )
        )
    return x, y, cuts


def _certificate(truth: Truth, certificate: EnergyCertificate) -> dict[str, Any]:
    phi = unsafe_sets.of_states(truth.dynamics, certificate)
    metrics = asdict(unsafe_sets.compare_certificate(truth, phi, certificate.eta))
    family = certificate.energy_family
    return {
        **certificate.parameters,
        **({"family": family.name} if family is not PAPER else {}),
        "length_scale": certificate.length_scale,
        "eta": certificate.eta,
        **{name: metrics[name] for name in COLUMNS},
    }


def _obeying(truth: Truth, zeta: Sequence[float]) -> Obedient:
    return Obedient(truth.dynamics, unsafe_sets.energy_of(truth.dynamics, zeta))


def flights_of(policy: Acts, starts: Floats, truth: Truth) -> dict[str, float]:
    """`safemr.aircraft.unsafe_sets.Flights.summary` of a policy from ``starts`` [N, 3]."""
    return unsafe_sets.fly(policy, starts, truth.dynamics).summary()


def learners(
    root: Path,
    runs: pd.DataFrame,
    dynamics: AircraftDynamics,
    family: type[Family],
) -> list[tuple[Any, Record, Family]]:
    """(run, its record, its certificate, which is of ``family``) of every run.

    Raises UserError naming every record whose policy file lacks an array of the family's, or one
    that flew in other traffic than ``dynamics``, or whose certificate is of another family.
    """
    found: list[tuple[Any, Record, Family]] = []
    lacking = []
    for run in runs.itertuples():
        record = Record.open(root / str(run.folder))
        arrays = record.policy_arrays() if record.has_policy else {}
        if not set(family.arrays) <= arrays.keys():
            lacking.append(str(run.folder))
            continue
        if (flown := unsafe_sets.dynamics_of(record.task)) != dynamics:
            raise UserError(
                f"{record.folder} flew with other_turn = {flown.other_turns[0]:g}, the true unsafe "
                f"set is that of {dynamics.other_turns[0]:g}: compare it with that of its own task"
            )
        found.append((run, record, family.from_record(record)))
    if lacking:
        raise UserError(
            f"no {POLICY} with {' and '.join(family.arrays)} in {', '.join(lacking)} under "
            f"{root}: take them out of aircraft.algorithms, or train them again"
        )
    return found
