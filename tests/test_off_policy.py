"""The FAC family: losses by hand, delays, projection, ablation identity, determinism, resuming."""

from __future__ import annotations

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch
from toy import ToyEnvs

from safemr.algorithms import fac, joint_sis, safemr
from safemr.errors import UserError
from safemr.learning import losses
from safemr.learning.contract import TrainingDivergedError
from safemr.learning.evaluation import evaluate
from safemr.learning.replay import Batch

MODULES = (fac, joint_sis, safemr)
DEVICES = ("cpu", *(("cuda",) if torch.cuda.is_available() else ()))
SMALL = {
    "num_envs": 4,
    "hidden": 16,
    "batch_size": 32,
    "start_steps": 200,
    "replay_capacity": 4000,
    "target_entropy": -1.0,
}


def transitions(count: int = 6, seed: int = 0, d_min: float = 0.25) -> Batch:
    rng = np.random.default_rng(seed)

    def tensor(*shape: int, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
        return torch.tensor(rng.uniform(low, high, shape))

    return Batch(
        observations=tensor(count, 3),
        actions=tensor(count, 2),
        returns=tensor(count),
        discounts=torch.full((count,), 0.95).double(),
        bootstraps=tensor(count, 3),
        costs=tensor(count),
        d=tensor(count, 2, low=0.2, high=1.5),
        d_dot=tensor(count, 2, low=-1.5, high=1.5),
        d_next=tensor(count, 2, low=0.2, high=1.5),
        d_dot_next=tensor(count, 2, low=-1.5, high=1.5),
    )


def test_reward_target_by_hand():
    target = losses.reward_target(
        returns=torch.tensor([1.0, 2.0]),
        discounts=torch.tensor([0.9, 0.0]),
        next_values=torch.tensor([[3.0, 7.0], [4.0, 5.0]]),
        next_log_densities=torch.tensor([-2.0, 1.0]),
        temperature=torch.tensor(0.5),
    )
    # 1 + 0.9 (3 + 0.5 * 2) and, after a termination, the return alone
    assert target.tolist() == pytest.approx([4.6, 2.0])


def test_losses_by_hand():
    predictions, targets = torch.tensor([[1.0, 2.0], [0.0, 0.0]]), torch.tensor([[0.0, 0.0]] * 2)
    assert losses.critic_loss(predictions, targets).item() == pytest.approx(2.5)
    loss = losses.policy_loss(
        log_densities=torch.tensor([-1.0, 1.0]),
        values=torch.tensor([[2.0, 5.0], [3.0, 4.0]]),
        constraint=torch.tensor([0.5, -0.5]),
        multipliers=torch.tensor([10.0, 1.0]),
        temperature=torch.tensor(0.1),
    )
    # mean of (-0.1 - 2 + 5) and (0.1 - 4 - 0.5)
    assert loss.item() == pytest.approx((2.9 - 4.4) / 2)
    multipliers = torch.tensor([2.0, 4.0], requires_grad=True)
    losses.multiplier_loss(multipliers, torch.tensor([0.5, -0.25])).backward()
    # descent on this loss raises lambda where the constraint is violated and lowers it elsewhere
    assert multipliers.grad.tolist() == [-0.25, 0.125]
    log_temperature = torch.tensor(0.0, requires_grad=True)
    losses.temperature_loss(log_temperature, torch.tensor([3.0, 1.0]), -1.0).backward()
    # entropy -2 is below the target -1: the gradient is negative, so the temperature rises
    assert log_temperature.grad.item() == -1.0


def test_constraint_values_by_hand():
    zeta = torch.tensor([0.3, 1.0, 2.0]).double()
    batch = transitions()
    values = fac.constraint_values(batch, zeta, 0.25, fac.Config(eta=0.02))
    for row in range(len(values)):
        phi, phi_next = (
            max(0.55**2 - d**2 - v for d, v in zip(ds, vs, strict=True))
            for ds, vs in (
                (batch.d[row].tolist(), batch.d_dot[row].tolist()),
                (batch.d_next[row].tolist(), batch.d_dot_next[row].tolist()),
            )
        )
        assert values[row].item() == pytest.approx(max(phi_next - max(phi - 0.02, 0), -0.001))


@pytest.mark.parametrize("length_scale", [0.5, 5.0])
def test_length_scale_is_a_change_of_unit(length_scale):
    """phi of lengths in another unit: sigma, k and the distances shrink together, n = 1."""
    batch, zeta = transitions(), torch.tensor([0.3, 0.7, 1.0]).double()
    config = fac.Config(constraint_floor=-100.0)
    plain = fac.constraint_values(batch, zeta, 0.25, config)
    zeta_scaled = zeta * torch.tensor([1.0 / length_scale, 1.0, 1.0])
    config = dataclasses.replace(config, length_scale=length_scale)
    scaled = fac.constraint_values(batch, zeta_scaled, 0.25, config)
    torch.testing.assert_close(scaled * length_scale, plain)


@pytest.mark.parametrize("constraint", ["floored", "literal", "released"])
def test_certificate_losses_by_hand_and_by_gradcheck(constraint):
    batch = transitions(seed=4)
    multipliers = torch.linspace(0.0, 5.0, 6).double()
    config = safemr.Config(certificate_constraint=constraint, a=0.35, b=0.15)
    zeta = torch.tensor([0.3, 1.0, 2.0], dtype=torch.float64, requires_grad=True)
    g = fac.constraint_values(
        batch, zeta, 0.25, dataclasses.replace(config, constraint_floor=-99.0)
    )
    expected = {
        "floored": (multipliers * g.clamp_min(-0.001)).mean(),
        "literal": (multipliers * g).mean(),
        "released": g.clamp_min(0.0).mean(),
    }[constraint]
    joint = joint_sis.certificate_loss(batch, multipliers, zeta, 0.25, config)
    torch.testing.assert_close(joint, expected)
    full = safemr.certificate_loss(batch, multipliers, zeta, 0.25, config)
    assert (full - joint).item() == pytest.approx(0.35 * 0.55**2 + 0.15)
    assert torch.autograd.gradcheck(
        lambda z: safemr.certificate_loss(batch, multipliers, z, 0.25, config), (zeta,)
    )


def make(module, seed: int = 0, steps: int = 2000, **overrides):
    return module.Trainer(module.Config(**{**SMALL, **overrides}), ToyEnvs, seed, steps)


@pytest.mark.parametrize("module", MODULES)
def test_same_seed_same_numbers_and_other_seed_other_numbers(module):
    first, second, other = make(module), make(module), make(module, seed=1)
    rows = [trainer.advance(800) for trainer in (first, second, other)]
    np.testing.assert_equal(rows[0], rows[1])
    assert rows[0]["critic_loss"] != rows[2]["critic_loss"]
    assert torch.equal(first.agent.critics.parameters, second.agent.critics.parameters)


@pytest.mark.parametrize("device", DEVICES)
def test_every_device_of_this_machine_trains_and_resumes(device):
    trainer = make(safemr, device=device, backend="torch")
    trainer.advance(600)
    assert trainer.agent.critics.parameters.device.type == device
    state = copy.deepcopy(trainer.state_dict())
    trainer.advance(1200)
    resumed = make(safemr, device=device, backend="torch")
    resumed.load_state_dict(state)
    resumed.advance(1200)
    for name in ("critics", "policy", "multiplier"):
        one, other = (getattr(t.agent, name).parameters.detach() for t in (trainer, resumed))
        assert torch.equal(one, other)
        assert torch.isfinite(one).all()
    assert trainer.policy.arrays()["policy_parameters"].dtype == np.float32


@pytest.mark.parametrize("module", MODULES)
def test_a_restored_trainer_continues_bit_for_bit(module, tmp_path):
    from safemr.experiment import checkpoints

    whole, part, rest = make(module), make(module), make(module)
    whole.advance(600)
    part.advance(600)
    checkpoints.save(tmp_path / "state.pt", part.state_dict())
    rest.load_state_dict(checkpoints.load(tmp_path / "state.pt"))
    np.testing.assert_equal(whole.advance(1200), rest.advance(1200))
    assert torch.equal(whole.agent.policy.parameters, rest.agent.policy.parameters)


def test_safemr_without_weights_is_joint_sis_number_for_number():
    plain, regularized = make(joint_sis), make(safemr, a=0.0, b=0.0)
    np.testing.assert_equal(plain.advance(2000), regularized.advance(2000))
    assert plain.agent.zeta.tolist() != [0.3, 1.0, 2.0]


def test_fac_keeps_zeta_and_joint_synthesis_stays_in_its_box():
    fixed = make(fac, sigma=0.0, k=0.0, n=1.0)
    fixed.advance(1200)
    assert fixed.agent.zeta.tolist() == [0.0, 0.0, 1.0]
    moving = make(safemr, a=50.0, b=50.0, certificate_travel=10.0, sigma_min=0.05, k_min=0.4)
    moving.advance(2000)
    sigma, k, n = moving.agent.zeta.tolist()
    assert (sigma, k) == pytest.approx((0.05, 0.4))
    assert 0.1 <= n <= 4.0


def test_delays_of_algorithm_1():
    """m_pi < m_lambda < m_phi: which parameters a given gradient step moves."""
    trainer = make(safemr, policy_delay=2, multiplier_delay=4, certificate_delay=8, start_steps=800)
    trainer.advance(800)
    agent = trainer.agent
    agent._first_update = 0

    def snapshot() -> dict[str, torch.Tensor]:
        tensors = {
            name: getattr(agent, name).parameters for name in ("critics", "policy", "multiplier")
        }
        return {name: t.detach().clone() for name, t in (tensors | {"zeta": agent.zeta}).items()}

    moved: dict[str, list[int]] = {"critics": [], "policy": [], "multiplier": [], "zeta": []}
    for step in range(1, 9):
        before = snapshot()
        agent.update(trainer.replay.sample(32, trainer._sampling), 1)
        for name, old in before.items():
            if not torch.equal(old, snapshot()[name]):
                moved[name].append(step)
    assert moved == {
        "critics": list(range(1, 9)),
        "policy": [2, 4, 6, 8],
        "multiplier": [4, 8],
        "zeta": [8],
    }


def test_certificate_travel_bounds_the_distance_whatever_the_budget():
    """The learning rates of zeta sum to the travel, so a unit gradient moves it that far."""
    for updates in (400, 4000):
        agent = joint_sis.Agent(joint_sis.Config(certificate_travel=0.2), 3, 2, 0.25, 0, updates)
        agent.certificate_loss = lambda batch, zeta, multipliers: zeta[1]
        batch = Batch(*(field.float() for field in transitions()))
        for agent.updates in range(1, updates + 1):
            agent.update_certificate(batch)
            moved = joint_sis.travelled(agent.config, agent.updates, updates)
            assert 1.0 - agent.zeta[1].item() == pytest.approx(moved, abs=0.015)
        assert agent.zeta[1].item() == pytest.approx(1.0 - 0.2, abs=0.015)


def test_divergence_stops_at_once_and_names_the_quantity():
    """Losses are looked at now and then, actions at every step: whichever is first."""
    trainer = make(safemr)
    trainer.advance(400)
    with torch.no_grad():
        trainer.agent.critics.parameters.fill_(math.nan)
    with pytest.raises(
        TrainingDivergedError, match=r"(critic_loss|action) became nan at step 4\d\d$"
    ):
        trainer.advance(2000)


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [
        (fac, "gamma", 1.5),
        (fac, "batch_size", 0),
        (fac, "constraint_floor", 0.1),
        (fac, "multiplier_delay", 3),
        (joint_sis, "sigma", 2.0),
        (joint_sis, "certificate_start", 1.0),
        (safemr, "a", -0.1),
        (fac, "activation", "swish"),
    ],
)
def test_bad_hyperparameters_are_named(module, name, value):
    with pytest.raises(UserError, match=name):
        module.Config(**{name: value})


class Counting:
    """Deterministic actions by a closed form: always at full speed away from the wall."""

    def act(self, observations: np.ndarray, deterministic: bool = True) -> np.ndarray:
        return -np.ones((len(observations), 1), np.float32)


def test_evaluation_counts_one_episode_a_sub_environment():
    result = evaluate(Counting(), ToyEnvs(5), seed=3)
    assert (result["episodes"], result["length"], result["cost"]) == (5, 40, 0)
    start = result["return"] / 40 + 0.1 * 20.5  # x_t = x_0 - 0.1 t
    assert -0.1 <= start <= 0.1
    assert result == evaluate(Counting(), ToyEnvs(5), seed=3)
