"""Neural energy functions of the aircraft experiment: what recorded ones claim, what one could.

The records are runs of `safemr.algorithms.neural_safemr`. The *control* is the same function fitted
to the solved value by supervised learning: what it misses is the architecture's, what a learner
misses beyond it is the loss's, the data's or the policy's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from envs.aircraft import AircraftDynamics, AircraftVectorEnv, observe
from safemr import paper
from safemr.aircraft import reachability, scoring, unsafe_sets
from safemr.aircraft.reachability import Solution
from safemr.aircraft.reachability.grid import Floats
from safemr.aircraft.scoring import CONTROL, TrueSets, learners
from safemr.aircraft.slices import Slice, near_boundary
from safemr.aircraft.unsafe_sets import Energy, Truth, of_states
from safemr.algorithms.neural_safemr import NeuralCertificate, neural_energy
from safemr.certificates.families import PAPER, named
from safemr.conventions import COVERS
from safemr.experiment.planning import installed
from safemr.experiment.record import Record
from safemr.learning.adam import Adam
from safemr.learning.networks import StackedMLP
from safemr.learning.observation import ObservationTransform
from safemr.measure.store import VERSIONS, Measurements
from safemr.measure.tracks import below

CONTROL_SHARES = (0.001, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4)
SLICE, SPACING = 180.0, 0.1  # [degree], [m] of the plane that is drawn
LOG2_STATES = 17  # Sobol points of the comparison: volumes are right to 0.1 %


def recorded_energies(
    dynamics: AircraftDynamics, root: Path, runs: pd.DataFrame
) -> dict[str, list[Energy]]:
    """Variant -> its energies by seed, of the rows of `records.read_records`'s index."""
    found: dict[str, list[Energy]] = {}
    for run, _, learned in learners(root, runs.sort_values("seed"), dynamics, NeuralCertificate):
        found.setdefault(str(run.variant), []).append(of_states(dynamics, learned))
    return found


def settings_of(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of `fit_to_truth` that make its energy that of a run."""
    family = named(hyperparameters.get("family", PAPER.name))
    if family is PAPER:
        zeta = [hyperparameters[name] for name in family.names]
    else:
        zeta = hyperparameters.get("start") or [each.start for each in family.parameters]
    return {
        "zeta": list(zeta),
        **({"family": family.name} if family is not PAPER else {}),
        "length_scale": hyperparameters["length_scale"],
        "smoothing": hyperparameters["smoothing"],
        "hidden": hyperparameters["certificate_hidden"],
    }


def fit_to_truth(
    truth: Truth,
    *,
    zeta: Sequence[float] = (0.06, 1.0, 1.0),
    length_scale: float = 5.0,
    smoothing: float = 0.1,
    hidden: int = 32,
    steps: int = 4000,
    batch: int = 1024,
    lr: float = 5e-3,
    seed: int = 100,
    family: str = PAPER.name,
) -> Energy:
    """The control: f by logistic regression of {V <= 0} on phi / tau, outside the disc.

    Adam, learning rate falling linearly to 0. The defaults are those of the learners' energy.
    """
    dynamics = truth.dynamics
    outside = ~truth.disc
    states, unsafe = truth.states[outside], torch.from_numpy(truth.unsafe[outside]).float()
    transform = ObservationTransform.for_layout(AircraftVectorEnv.observation_layout)
    fixed: dict[str, Any] = {
        **{"zeta": torch.tensor(zeta), "length_scale": length_scale, "smoothing": smoothing},
        "energy_family": named(family),
    }
    generator = torch.Generator().manual_seed(seed)
    network = StackedMLP(
        1, (transform.dim, hidden, hidden, 1), "tanh", generator=generator, output_gain=0.0
    )
    inputs = torch.from_numpy(transform(observe(states)))
    d, d_dot = (
        torch.from_numpy(values[:, None]).float()
        for values in (dynamics.separation(states), dynamics.separation_rate(states))
    )
    adam = Adam([network.parameters], lr)
    for step in range(steps):
        adam.param_groups[0]["lr"] = lr * (1.0 - step / steps)
        rows = torch.randint(len(states), (batch,), generator=generator)
        phi = neural_energy(network, inputs[rows], d[rows], d_dot[rows], dynamics.d_min, **fixed)
        loss = torch.nn.functional.binary_cross_entropy_with_logits(phi / smoothing, unsafe[rows])
        (network.parameters.grad,) = torch.autograd.grad(loss, [network.parameters])
        adam.step()
    return of_states(dynamics, NeuralCertificate(CONTROL, network, transform, **fixed))


def shifted_to_miss(truth: Truth, phi: Energy, missed_share: float) -> Energy:
    """phi plus the least constant with which it misses at most ``missed_share`` of the shell."""
    shell = np.sort(phi(truth.states[truth.unsafe & ~truth.disc]))
    threshold = shell[int(missed_share * len(shell))]
    shift = np.nextafter(-threshold, np.inf)
    return lambda states: phi(states) + shift


def compare(
    truth: Truth,
    solution: Solution,
    frontier: pd.DataFrame,
    root: Path,
    runs: pd.DataFrame,
    control: Energy,
    flights: int = scoring.FLIGHTS,
) -> pd.DataFrame:
    """Rows as those of `scoring.compare`: runs, then the control; of kind "control" are the
    control's volumes when it is shifted to miss each of `CONTROL_SHARES`.

    ``obeyed_collision_share`` is that of the policy which obeys the certificate (`Obedient`), from
    a fifth of the starts.
    """
    dynamics = truth.dynamics
    starts = unsafe_sets.safe_starts(solution, flights, scoring.STARTS_SEED)

    def measured(phi: Energy, eta: float) -> dict[str, float]:
        obedient = scoring.Obedient(dynamics, phi)
        obeyed = scoring.flights_of(obedient, starts[: flights // 5], truth)
        return {
            **asdict(unsafe_sets.compare_certificate(truth, phi, eta)),
            "eta": eta,
            "obeyed_collision_share": obeyed["collision_share"],
        }

    rows: list[dict[str, Any]] = [
        {"kind": "learner", "variant": run.variant, "seed": int(run.seed)}
        | measured(of_states(dynamics, learned), learned.eta)
        | scoring.flights_of(record.policy(), starts, truth)
        for run, record, learned in learners(root, runs, dynamics, NeuralCertificate)
    ]
    covering = shifted_to_miss(truth, control, COVERS)
    rows += [
        {"kind": "certificate", "variant": name, "seed": -1} | measured(phi, 0.0)
        for name, phi in ((CONTROL, control), (f"{CONTROL}, shifted", covering))
    ]
    now, shell = control(truth.states), truth.unsafe & ~truth.disc
    for share in CONTROL_SHARES:
        threshold = np.sort(now[shell])[int(share * np.count_nonzero(shell))]
        claimed = (now >= threshold) | truth.disc
        rows.append(
            {"kind": "control", "variant": CONTROL, "seed": -1}
            | {"missed_share": float(np.mean(~claimed[shell]))}
            | {"volume_ratio": float(claimed.sum() / truth.unsafe.sum())}
        )
    table = pd.DataFrame(rows)
    table["covers"] = table["missed_share"] <= COVERS
    table["least_volume_ratio"] = np.interp(
        table["missed_share"], frontier["missed_share"], frontier["volume_ratio"]
    )
    return table.reindex(columns=table.columns.union(["collision_share", "effort"], sort=False))


def measured(
    measurements: Measurements,
    sets: TrueSets,
    frontier: pd.DataFrame,
    root: Path,
    runs: pd.DataFrame,
    energy: Mapping[str, Any],
) -> tuple[pd.DataFrame, Floats, Floats, Slice]:
    """`compare`, with a control of the hyperparameters ``energy``, and `slice_at` for one seed of
    each variant; both kept among ``measurements``."""
    inputs: dict[str, Any] = {
        "task": installed(sets.task),
        "policies": [Record.open(root / folder).inputs for folder in sorted(runs["folder"])],
        "energy": settings_of(energy), "log2_states": sets.log2_states,
        "flights": scoring.FLIGHTS, "solver": reachability.VERSION,
        "frontier": VERSIONS["aircraft_frontier"],
    }  # fmt: skip

    def rows() -> Any:
        control = fit_to_truth(sets.truth, **inputs["energy"])
        table = compare(sets.truth, sets.constant, frontier, root, runs, control)
        return table.to_dict("records")

    def arrays() -> dict[str, NDArray[Any]]:
        energies = recorded_energies(sets.truth.dynamics, root, runs)
        shown = {variant: found[:1] for variant, found in energies.items()}
        _, _, cut = slice_at(sets.constant, shown)
        learned = {f"learned/{name}": found[0] for name, found in cut.learned.items()}
        found = {"truth": cut.truth, "handcrafted": cut.handcrafted, **learned}
        return {name: near_boundary(values) for name, values in found.items()}

    comparison = pd.DataFrame(measurements.rows("aircraft_neural", "neural", inputs, rows))
    kept = measurements.arrays("aircraft_neural_slice", "neural", inputs, arrays)
    learned = {name: [values] for name, values in below(kept, "learned/").items()}
    cut = Slice(float(np.radians(SLICE)), kept["truth"], kept["handcrafted"], learned)
    return comparison, *scoring.plane(SPACING), cut


def slice_at(
    solution: Solution,
    learned: Mapping[str, Sequence[Energy]],
    degrees: float = SLICE,
    spacing: float = SPACING,
) -> tuple[Floats, Floats, Slice]:
    """x [X], y [Y] and the unsafe sets of certificates (the disc included) at one psi."""
    x, y = scoring.plane(spacing)
    psi = float(np.radians(degrees))
    states = np.stack([*np.meshgrid(x, y, indexing="ij"), np.full((len(x), len(y)), psi)], -1)
    inside = solution.dynamics.d_min - solution.dynamics.separation(states)
    handcrafted = unsafe_sets.energy_of(solution.dynamics, paper.PHI_H)(states)
    sets = {
        variant: [np.maximum(phi(states), inside) for phi in found]
        for variant, found in learned.items()
    }
    return x, y, Slice(psi, solution(states), np.maximum(handcrafted, inside), sets)
