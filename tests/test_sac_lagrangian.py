"""SAC-Lagrangian: the baseline that is one file on top of soft actor-critic."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from toy import ToyEnvs, optimal_return

from safemr.algorithms.sac_lagrangian import Agent, Config, Trainer, cost_target
from safemr.errors import UserError
from safemr.learning.evaluation import evaluate
from safemr.learning.replay import Batch


def test_cost_target_by_hand():
    costs, discounts = torch.tensor([1.0, 0.0, 2.0]), torch.tensor([0.9, 0.9, 0.0])
    target = cost_target(costs, discounts, torch.tensor([10.0, 5.0, 7.0]), 0.5)
    torch.testing.assert_close(target, torch.tensor([1.0 + 9.0 - 0.5, 4.5 - 0.5, 2.0 - 0.5]))


def test_constant_cost_has_the_geometric_fixed_point():
    """Q_c = (c - limit) / (1 - gamma): exactly 0 where the cost is at its limit."""
    value = torch.zeros(1)
    for _ in range(300):
        value = cost_target(torch.tensor([0.3]), torch.tensor([0.9]), value, 0.1)
    assert float(value) == pytest.approx(2.0, rel=1e-4)


def test_one_multiplier_for_all_states_follows_the_mean_cost():
    agent = Agent(Config(multiplier_bias=0.5, multiplier_lr=0.01), 3, 2, 0.1, 0, 100)
    multipliers = agent.multipliers(torch.randn(5, 3))
    assert multipliers.shape == (5,)
    expected = torch.nn.functional.softplus(torch.tensor(0.5)).expand(5)
    torch.testing.assert_close(multipliers.detach(), expected)
    assert agent.multiplier.parameters.numel() == 1


def test_constraint_critic_bootstraps_its_own_target():
    """Its row of the targets is scale * (c - limit) + gamma * target critic, at the noise drawn."""
    config = Config(cost_rate_limit=0.25, constraint_scale=4.0, backend="torch")
    agent = Agent(config, 3, 2, 0.1, 0, 100)
    size = 6
    rows = torch.arange(float(size))
    state = torch.randn(size, 3)
    nothing = torch.zeros(size, 1)
    batch = Batch(
        state, torch.zeros(size, 2), rows, torch.full((size,), 0.99), state + 1.0, rows,
        nothing, nothing, nothing, nothing,
    )  # fmt: skip
    seen = []
    targets = agent.targets
    agent.targets = lambda x: seen.append(targets(x)) or seen[-1]
    result = agent.critic_targets(batch)
    cost_row = seen[0][2, :, 0]
    torch.testing.assert_close(result[2], 4.0 * (rows - 0.25) + 0.99 * cost_row)
    torch.testing.assert_close(result[0], result[1])
    before = targets.parameters.clone()
    agent.targets = targets
    agent.update(batch, 1)
    moved = (targets.parameters - before).abs()
    assert all(
        float(weight[2].max()) > 0.0 for weight, _ in targets.shape.layers(moved)
    )  # the cost critic's target follows too


def test_there_is_no_energy_to_set():
    energy = {"sigma", "k", "n", "eta", "length_scale", "constraint_floor"}
    assert not energy & {field.name for field in fields(Config)}


def test_other_bad_settings_are_named():
    with pytest.raises(UserError, match="n_step"):
        Config(n_step=5)
    with pytest.raises(UserError, match="cost_rate_limit"):
        Config(cost_rate_limit=-0.1)


def test_solves_the_toy():
    config = Config(
        num_envs=10,
        hidden=16,
        gamma=0.9,
        polyak=0.02,
        critic_lr=2e-3,
        multiplier_lr=1e-3,
        temperature_lr=3e-3,
        initial_log_temperature=-2.0,
        target_entropy=-3.0,
        start_steps=500,
        batch_size=64,
        update_every=4,
        replay_capacity=20_000,
    )
    run = Trainer(config, ToyEnvs, 0, 20_000)
    metrics = run.advance(20_000)
    result = evaluate(run.policy, ToyEnvs(20), seed=0)
    assert result["return"] >= 0.9 * optimal_return()
    assert result["cost"] == 0.0
    assert metrics["multiplier_mean"] == pytest.approx(metrics["multiplier_max"], rel=1e-5)
    assert not {"sigma", "k", "n"} & metrics.keys()
    assert "zeta" not in run.policy.arrays()
    assert np.isfinite(metrics["critic_loss"])
