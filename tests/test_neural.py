"""The neural energy function: definition, magnitude, learning step, recorded certificate, rule."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from sample_record import make_record

from envs.aircraft import AircraftVectorEnv, observe
from safemr.aircraft import neural, unsafe_sets
from safemr.aircraft.reachability import CONSTANT, Grid, Solution, solve
from safemr.algorithms import neural_safemr
from safemr.certificates import energy
from safemr.conventions import COVERS
from safemr.errors import UserError
from safemr.experiment import planning, records
from safemr.learning.policies import Policy
from safemr.learning.replay import Batch
from safemr.report.aircraft import neural_table
from safemr.report.figures import aircraft as pictures

ZETA = {"sigma": 0.06, "k": 1.0, "n": 1.0, "length_scale": 5.0}
SMALL = {"num_envs": 4, "hidden": 16, "batch_size": 32, "start_steps": 200, **ZETA}
FRONTIER = pd.DataFrame({"missed_share": [0.0, 0.1, 1.0], "volume_ratio": [1.9, 1.3, 0.7]})

values = arrays.arrays(np.float64, 20, elements=st.floats(-3.0, 3.0))


def trainer(steps: int = 800, seed: int = 0, **changes: Any) -> neural_safemr.Trainer:
    config = neural_safemr.Config(**{**SMALL, **changes})
    return neural_safemr.Trainer(config, lambda n: AircraftVectorEnv(n), seed, steps)


def states(count: int = 500) -> np.ndarray:
    drawn = np.random.default_rng(0).uniform([-6, -10, 0], [20, 10, 2 * np.pi], (count, 3))
    drawn[: count // 5, :2] *= 0.2  # some of them in the disc
    return drawn


def certificate(made: neural_safemr.Trainer) -> unsafe_sets.Energy:
    """As it is read from a policy file."""
    policy = Policy.from_arrays(made.policy.arrays())
    return unsafe_sets.of_states(
        CONSTANT, neural_safemr.NeuralCertificate.from_policy(policy, "one")
    )


def filled(made: neural_safemr.Trainer, scale: float = 3.0) -> neural_safemr.Trainer:
    """Random parameters for the correction, of any size."""
    generator = torch.Generator().manual_seed(1)
    parameters = made.agent.certificate.parameters
    made.agent.certificate.load(scale * torch.randn(parameters.shape, generator=generator))
    return made


def batch_of(count: int = 64) -> Batch:
    """Transitions of straight flight, in float64."""
    now = states(count)
    following = CONSTANT.flow(now, 0.0, 1.0)
    transform = trainer().transform
    observations, bootstraps = (torch.from_numpy(transform(observe(s))) for s in (now, following))
    lengths = [
        torch.from_numpy(of(s)[:, None]).float()
        for s in (now, following)
        for of in (CONSTANT.separation, CONSTANT.separation_rate)
    ]
    zeros = torch.zeros(count)
    return Batch(observations, zeros[:, None], zeros, zeros, bootstraps, zeros, *lengths)


@given(values, values, values, st.floats(0.01, 1.0))
@settings(max_examples=50, deadline=None)
def test_corrected_energy_is_a_soft_maximum_above_phi_0(phi, contact, correction, tau):
    result = energy.corrected(phi, contact, correction, tau)
    gate = np.where(contact < 0, 1 - np.exp(np.minimum(contact, 0) / tau), 0.0)
    larger = np.maximum(contact, phi + gate * correction)
    assert (result >= larger - 1e-12).all()
    assert (result <= larger + tau * np.log(2) + 1e-12).all()
    # In the disc nothing that the network says counts, and phi > 0.
    inside = contact >= 0
    np.testing.assert_array_equal(
        result[inside], energy.corrected(phi, contact, 100.0 - correction, tau)[inside]
    )
    assert (result[contact > 0] > 0).all()
    tensors = energy.corrected(*(torch.from_numpy(x) for x in (phi, contact, correction)), tau)
    np.testing.assert_allclose(result, tensors.numpy(), atol=1e-12)


def test_learning_starts_from_the_handcrafted_energy():
    made = trainer(smoothing=1e-3)
    expected = unsafe_sets.energy_of(CONSTANT, (0.06, 1.0, 1.0), 5.0)(states())
    contact = 1.0 - CONSTANT.separation(states()) / 5.0
    found = certificate(made)(states())
    np.testing.assert_allclose(found, np.maximum(expected, contact), atol=1e-3)


def test_the_disc_is_covered_whatever_the_network_says():
    for scale in (1.0, 30.0):
        phi = certificate(filled(trainer(), scale))(states())
        inside = CONSTANT.separation(states()) < CONSTANT.d_min
        assert inside.sum() > 50
        assert (phi[inside] > 0).all()
        assert (phi[~inside] < 0).any()


def test_recorded_certificate_is_the_agents_energy():
    made, batch = filled(trainer()), batch_of()
    now, following = made.agent.energies(batch)
    phi = certificate(made)
    np.testing.assert_allclose(now.detach().numpy(), phi(states(64)), atol=1e-5)
    moved = CONSTANT.flow(states(64), 0.0, 1.0)
    np.testing.assert_allclose(following.detach().numpy(), phi(moved), atol=1e-5)
    # Any leading shape, and more states than are evaluated at once.
    many = np.tile(states(), (140, 1)).reshape(2, -1, 3)
    np.testing.assert_allclose(phi(many).reshape(-1)[:500], phi(states()), atol=1e-5)


@pytest.mark.parametrize("tau", [0.05, 0.5])
def test_gradient_of_the_magnitude_term(tau):
    """Against central differences, and against what it means: the share of unsafe states."""
    phi = np.random.default_rng(0).normal(size=200)
    tensor = torch.tensor(phi, requires_grad=True)
    (gradient,) = torch.autograd.grad(energy.mean_positive_part(tensor, tau), [tensor])
    for index in range(0, 200, 20):
        step = np.zeros(200)
        step[index] = 1e-5
        above, below = (energy.mean_positive_part(phi + s * step, tau) for s in (1, -1))
        assert float(gradient[index]) == pytest.approx((above - below) / 2e-5, abs=1e-8)
    raised = [energy.mean_positive_part(phi + shift, 1e-4) for shift in (1e-3, -1e-3)]
    assert (raised[0] - raised[1]) / 2e-3 == pytest.approx((phi > 0).mean(), abs=0.01)


@pytest.mark.parametrize("derivative", ["through", "literal"])
def test_certificate_loss_by_hand(derivative):
    """One violating transition from outside the set, one that keeps the constraint."""
    config = neural_safemr.Config(a=0.0, certificate_derivative=derivative)
    phi = torch.tensor([-0.5, 0.4], requires_grad=True)
    phi_next = torch.tensor([0.3, 0.2], requires_grad=True)
    multipliers = torch.tensor([6.0, 2.0])
    loss = neural_safemr.certificate_loss(phi, phi_next, multipliers, config)
    assert float(loss.detach()) == pytest.approx(6.0 * 0.3 / 2)
    now, following = torch.autograd.grad(loss, [phi, phi_next])
    assert now.tolist() == ([-3.0, 0.0] if derivative == "through" else [0.0, 0.0])
    assert following.tolist() == [3.0, 0.0]


def test_a_step_moves_the_energy_downhill_and_nothing_before_its_time():
    made = trainer(certificate_start=0.5, certificate_delay=2)
    agent, batch = filled(made, 0.5).agent, batch_of()
    before = agent.certificate.parameters.detach().clone()
    agent.updates = agent.total_updates // 2
    assert agent.update_certificate(batch) == {}
    assert torch.equal(agent.certificate.parameters, before)
    agent.updates = agent.total_updates // 2 + 2
    agent.updates += agent.updates % 2
    losses = [float(agent.update_certificate(batch)["certificate_loss"]) for _ in range(20)]
    assert losses[-1] < losses[0]
    assert 0.0 < agent.update_certificate(batch)["certificate_unsafe_share"] < 1.0


def test_training_resumes_bit_for_bit():
    whole, first, second = trainer(), trainer(), trainer(seed=3)
    whole.advance(800)
    first.advance(400)
    second.load_state_dict(first.state_dict())
    second.advance(800)
    kept, resumed = whole.policy.arrays(), second.policy.arrays()
    assert kept.keys() == resumed.keys()
    for name, value in kept.items():
        assert value.tobytes() == resumed[name].tobytes(), name
    start = trainer().agent.certificate.parameters
    assert not torch.equal(whole.agent.certificate.parameters, start)


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ({"n_step": 5}, "n_step"),
        ({"a": -1.0}, "a = "),
        ({"smoothing": 0.0}, "smoothing"),
        ({"certificate_start": 1.0}, "certificate_start"),
        ({"certificate_derivative": "half"}, "certificate_derivative"),
    ],
)
def test_bad_hyperparameters_are_named(changes, culprit):
    with pytest.raises(UserError, match=culprit):
        neural_safemr.Config(**changes)


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve(CONSTANT, Grid(shape=(66, 66, 48)))


@pytest.fixture(scope="module")
def truth(solution: Solution) -> unsafe_sets.Truth:
    return unsafe_sets.Truth.sample(solution, log2_count=13)


@pytest.fixture(scope="module")
def control(truth: unsafe_sets.Truth) -> unsafe_sets.Energy:
    return neural.fit_to_truth(truth, steps=600)


def test_the_network_can_express_the_truth(truth, control):
    """What the frontier's certificates cannot: nearly the true volume at 5% missed."""
    shifted = neural.shifted_to_miss(truth, control, 0.05)
    metrics = unsafe_sets.compare_certificate(truth, shifted, turns=3)
    assert metrics.missed_share <= 0.05
    assert metrics.volume_ratio < 1.2
    start = neural.fit_to_truth(truth, steps=0)
    assert unsafe_sets.compare_certificate(truth, start, turns=3).volume_ratio > 1.5


def test_rows_table_and_figure_from_records(truth, solution, control, tmp_path: Path):
    made = {("Neural-a1", 100): trainer(), ("Neural-a1", 101): filled(trainer(), 0.3)}
    for (variant, seed), one in made.items():
        described = {"name": "neural_safemr", "version": 1, "hyperparameters": {"eta": 0.0}}
        run: dict[str, Any] = {
            **{"schema": 1, "task": planning.describe_task("Aircraft", {}), "algorithm": described},
            **{"seed": seed, "steps": 10, "log_every": 10},
            "evaluation": {"every": 10, "episodes": 1, "seed": 0},
        }
        row = {"step": 10, "eval_return": 0.0, "eval_cost": 0.0, "eval_zero_violation_share": 1.0}
        folder = tmp_path / records.record_path(run, variant)
        records.write_record(folder, run, variant, [row], {}, one.policy.arrays())
    index = records.read_records(tmp_path)[0]
    rows = neural.compare(truth, solution, FRONTIER, tmp_path, index, control, flights=50)
    learners = rows[rows["kind"] == "learner"].set_index("seed")
    for (_, seed), one in made.items():
        expected = unsafe_sets.compare_certificate(truth, certificate(one), 0.0)
        assert learners.loc[seed, "volume_ratio"] == expected.volume_ratio
        assert learners.loc[seed, "leak_share"] == expected.leak_share
    fitted = rows[rows["variant"] == f"{neural.CONTROL}, shifted"].iloc[0]
    assert fitted["missed_share"] <= COVERS
    curve = rows[rows["kind"] == "control"]
    assert curve["volume_ratio"].is_monotonic_decreasing
    assert (curve["missed_share"] <= np.array(neural.CONTROL_SHARES)).all()

    missing = pd.DataFrame([("Aircraft", "Neural-a9", 100)], columns=["task", "variant", "seed"])
    table = neural_table(rows, missing)
    assert table.display["certificate"].tolist() == [
        "Neural-a1",
        neural.CONTROL,
        f"{neural.CONTROL}, shifted",
    ]
    assert table.display["seeds"].tolist()[0] == "2"
    assert "Neural-a9" in table.notes[0]

    found = neural.recorded_energies(CONSTANT, tmp_path, index)
    assert [len(certificates) for certificates in found.values()] == [2]
    x, y, cut = neural.slice_at(solution, found, spacing=0.5)
    inside = np.hypot(*np.meshgrid(x, y, indexing="ij")) < CONSTANT.d_min
    assert all((claimed[inside] > 0).all() for claimed in cut.learned["Neural-a1"])
    figure = pictures.neural(x, y, cut, CONSTANT.d_min, FRONTIER, rows, COVERS)
    left, right = figure.axes
    dashed = [line.get_ydata() for line in left.lines if line.get_linestyle() == "--"]
    assert any(np.array_equal(values, curve["volume_ratio"]) for values in dashed)
    assert right.get_xlabel().startswith("$x$ ahead")
    figure.savefig(tmp_path / "neural.png")
    assert (tmp_path / "neural.png").stat().st_size > 10_000


def test_a_record_without_a_network_is_named(truth, solution, control, tmp_path: Path):
    folder = make_record(tmp_path).relative_to(tmp_path)
    index = pd.DataFrame([{"variant": "Silent", "seed": 1, "folder": str(folder)}])
    with pytest.raises(UserError, match=rf"certificate_parameters.*{folder}"):
        neural.compare(truth, solution, FRONTIER, tmp_path, index, control, flights=10)
