"""Advantages, the clipped objective, and whole runs of the on-policy algorithms on the toy."""

from __future__ import annotations

import importlib
import io
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toy import ToyEnvs, optimal_return

from safemr.algorithms import cpo, ppo_lagrangian
from safemr.algorithms.ppo_lagrangian import clipped_surrogate, policy_loss
from safemr.errors import UserError
from safemr.experiment.config import load
from safemr.experiment.planning import resolve
from safemr.learning.evaluation import evaluate
from safemr.learning.hyperparameters import resolved
from safemr.learning.on_policy import Batch, explained_variance
from safemr.learning.policies import Policy
from safemr.learning.rollouts import Rollout, gae, minibatches

ALGORITHMS = ("ppo_lagrangian", "trpo_lagrangian", "cpo")
TOY: dict[str, Any] = {
    "num_envs": 25,
    "epoch_steps": 2_000,
    "hidden": 16,
    "gamma": 0.9,
    "cost_gamma": 0.9,
    "target_kl": 0.03,
    "value_batch": 400,
}


def trainer(name: str, seed: int = 0, **overrides: Any) -> Any:
    module = importlib.import_module(f"safemr.algorithms.{name}")
    return module.Trainer(module.Config(**TOY | overrides), ToyEnvs, seed, 1_000_000)


# --- advantages and returns -----------------------------------------------------------------------


def test_gae_closed_form():
    """Constant r and V in one endless episode: a geometric series."""
    steps, gamma, lam, reward, value = 40, 0.9, 0.8, 2.0, 5.0
    shape = (steps, 1)
    advantages = gae(
        np.full(shape, reward), np.full(shape, value), np.full(shape, value),
        np.zeros(shape, bool), gamma, lam,
    )  # fmt: skip
    delta, ratio = reward + gamma * value - value, gamma * lam
    left = np.arange(steps, 0, -1)[:, None]
    np.testing.assert_allclose(advantages, delta * (1 - ratio**left) / (1 - ratio))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 12), st.integers(1, 3), st.floats(0, 1), st.floats(0, 1), st.integers(0, 10**6)
)
def test_gae_is_the_weighted_sum_of_residuals_within_the_episode(steps, envs, gamma, lam, seed):
    random = np.random.default_rng(seed)
    rewards, values, following = random.normal(size=(3, steps, envs))
    ended = random.random((steps, envs)) < 0.3
    advantages = gae(rewards, values, following, ended, gamma, lam)
    for i in range(envs):
        for t in range(steps):
            expected, weight = 0.0, 1.0
            for later in range(t, steps):
                delta = rewards[later, i] + gamma * following[later, i] - values[later, i]
                expected += weight * delta
                weight *= gamma * lam
                if ended[later, i]:
                    break
            assert advantages[t, i] == pytest.approx(expected, abs=1e-9)


def test_returns_with_three_kinds_of_end_inside_the_batch():
    """Truncation bootstraps from the final observation, termination from nothing, the cut from
    the observation that follows; rewards and costs alike. V(s) = [x, 10 x], gamma = 1/2."""
    rollout = Rollout(3, 3, 1, 1)
    for t in range(3):
        terminated, truncated = np.zeros((2, 3), bool)
        finals = None
        if t == 1:
            truncated[1], terminated[2] = True, True  # in environments 1 and 2, at step 1
            finals = np.array([[0.0], [40.0], [80.0]], np.float32)
        observations = np.array([[1.0], [2.0], [3.0]], np.float32) + t
        rewards = np.array([1.0, 2.0, 3.0])
        rollout.add(
            observations, np.zeros((3, 1)), rewards, -rewards, terminated, truncated, finals
        )
    rollout.close(np.array([[16.0], [32.0], [64.0]], np.float32))
    values, following = rollout.values(lambda x: torch.stack([x, 10.0 * x]))
    np.testing.assert_array_equal(values[0], [[1, 2, 3], [2, 3, 4], [3, 4, 5]])
    np.testing.assert_array_equal(following[0], [[2, 3, 4], [3, 40, 0], [16, 32, 64]])
    np.testing.assert_array_equal(following[1], 10.0 * following[0])
    arrays = (rollout.signals[0], values[0], following[0], rollout.ended)
    returns = values[0] + gae(*arrays, 0.5, 1.0)
    third = np.array([1 + 16 / 2, 2 + 32 / 2, 3 + 64 / 2])
    second = np.array([1 + third[0] / 2, 2 + 40 / 2, 3])
    first = np.array([1, 2, 3]) + second / 2
    np.testing.assert_allclose(returns, [first, second, third])


def test_collected_rollout_bootstraps_across_the_autoreset():
    """In the toy every episode is truncated: the value there is that of the last position."""
    run = trainer("ppo_lagrangian", epoch_steps=25 * 60)
    batch, _ = run._collect()
    rollout = run.rollout
    assert rollout.truncated.sum() == 25
    assert rollout.truncated[39].all()
    _, following = rollout.values(lambda x: torch.stack([x, x]))
    last = rollout.signals[0, 39]  # the toy's reward is the position reached
    np.testing.assert_allclose(following[0, 39], last, rtol=1e-6)
    restarted = rollout.observations[40, :, 0].numpy()
    assert np.abs(restarted).max() <= 0.1
    assert np.abs(last - restarted).max() > 0.1
    assert batch.episode_decisions == 40.0


def test_episode_cost_without_a_finished_episode_extrapolates_the_rate():
    run = trainer("ppo_lagrangian", epoch_steps=25 * 20)
    run._collect()
    run.rollout.signals[1] = 0.25
    assert run.episode_cost(0, 25 * 20) == (10.0, 40.0)


def test_advantages_are_standardised_for_reward_and_centred_for_cost():
    run = trainer("cpo")
    batch, metrics = run._collect()
    assert float(batch.advantages.mean()) == pytest.approx(0.0, abs=1e-6)
    assert float(batch.advantages.std(correction=0)) == pytest.approx(1.0, abs=1e-5)
    assert float(batch.cost_advantages.mean()) == pytest.approx(0.0, abs=1e-6)
    assert float(batch.cost_advantages.std()) != pytest.approx(1.0, abs=1e-2)
    assert metrics["epoch_cost"] == batch.episode_cost


@pytest.mark.parametrize(("size", "batch", "used"), [(10, 5, 10), (12, 5, 10), (13, 5, 13)])
def test_minibatches_are_a_random_partition(size, batch, used):
    generator = torch.Generator().manual_seed(0)
    parts = list(minibatches(size, batch, generator))
    joined = torch.cat(parts)
    assert len(joined) == used == len(set(joined.tolist()))
    assert joined.tolist() != sorted(joined.tolist())
    assert list(minibatches(size, size, generator)) == [slice(None)]


def test_explained_variance():
    targets = np.array([1.0, 2.0, 3.0])
    assert explained_variance(targets + 5.0, targets) == 1.0
    assert explained_variance(np.zeros(3), targets) == 0.0
    assert explained_variance(2.0 * targets, targets) == pytest.approx(0.0)
    assert np.isnan(explained_variance(targets, np.ones(3)))


# --- PPO's objective and early stop ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("ratio", "advantage", "value", "slope"),
    [
        (1.1, 2.0, 2.2, 2.0),  # inside: the plain surrogate
        (1.5, 2.0, 2.4, 0.0),  # gains beyond 1 + clip do not count
        (0.5, 2.0, 1.0, 2.0),  # a loss counts in full
        (0.5, -2.0, -1.6, 0.0),
        (1.5, -2.0, -3.0, -2.0),
    ],
)
def test_clipped_surrogate(ratio, advantage, value, slope):
    r = torch.tensor([ratio], dtype=torch.float64, requires_grad=True)
    surrogate = clipped_surrogate(r, torch.tensor([advantage], dtype=torch.float64), 0.2)
    assert float(surrogate.detach()) == pytest.approx(value)
    (gradient,) = torch.autograd.grad(surrogate, r)
    assert float(gradient) == slope


def test_policy_loss_weighs_an_unclipped_cost():
    empty = torch.zeros(2, 1)
    batch = Batch(
        empty, empty, empty, torch.zeros(1), torch.zeros(2), torch.tensor([1.0, -1.0]),
        torch.tensor([2.0, 4.0]), torch.zeros(2, 2), 0.0, 0.0,
    )  # fmt: skip
    ratio = torch.tensor([1.5, 1.0])
    # (1.2 - 1) / 2 = 0.1 clipped reward, (3 + 4) / 2 = 3.5 cost, multiplier 3
    assert float(policy_loss(ratio, batch, 0.2, 3.0)) == pytest.approx(-(0.1 - 3 * 3.5) / 4)


def test_early_stop_ends_the_passes_at_the_kl_bound():
    """The full batch is one step a pass; the step that crosses the bound is the last one."""
    bound, kls = 0.001, []
    for passes in range(1, 40):
        run = trainer(
            "ppo_lagrangian", target_kl=bound / 1.2, policy_batch=10_000, policy_passes=passes,
            policy_lr=3e-3,
        )  # fmt: skip
        metrics = run.advance(1)
        kls.append(metrics["kl"])
        if metrics["policy_passes"] < passes:
            break
    assert metrics["policy_passes"] == passes - 1
    assert passes > 3
    assert all(kl <= bound for kl in kls[:-2])
    assert kls[-2] > bound
    assert kls[-1] == kls[-2]


# --- whole runs -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "steps", "overrides"),
    [
        ("ppo_lagrangian", 40_000, {"policy_lr": 3e-3, "policy_batch": 400}),
        ("trpo_lagrangian", 32_000, {}),
        ("cpo", 60_000, {}),
        ("cpo", 40_000, {"cost_limit": 1.0}),
    ],
)
def test_solves_the_toy_to_within_10_percent_of_the_optimum(name, steps, overrides):
    run = trainer(name, **overrides)
    metrics = run.advance(steps)
    result = evaluate(run.policy, ToyEnvs(20), seed=0)
    assert result["return"] >= 0.9 * optimal_return()
    assert result["cost"] == 0.0
    assert optimal_return() < 0.75 * optimal_return(1.5)  # without the constraint: far more
    assert all(np.isfinite(value) for value in metrics.values())
    if name != "cpo":
        assert metrics["multiplier"] > 1.0


def test_without_the_constraint_the_toy_is_violated():
    """The limit is what keeps the point away: at a limit that never binds it goes to the wall."""
    run = trainer("trpo_lagrangian", cost_limit=40.0, multiplier_initial=0.0)
    run.advance(30_000)
    result = evaluate(run.policy, ToyEnvs(20), seed=0)
    assert result["return"] > 1.15 * optimal_return()
    assert result["cost"] > 10.0


@pytest.mark.parametrize("name", ALGORITHMS)
def test_resumed_run_equals_the_uninterrupted_one_bit_for_bit(name):
    overrides = {"epoch_steps": 25 * 30, "policy_batch": 100} if name == "ppo_lagrangian" else {}
    overrides = {"epoch_steps": 25 * 30} | overrides  # epochs that cut episodes
    whole, first = trainer(name, **overrides), trainer(name, **overrides)
    whole.advance(1_500)
    first.advance(1_500)
    buffer = io.BytesIO()
    torch.save(first.state_dict(), buffer)
    buffer.seek(0)
    second = trainer(name, seed=5, **overrides)
    second.load_state_dict(torch.load(buffer, weights_only=False))
    expected, found = whole.advance(4_500), second.advance(4_500)
    assert found == expected
    assert torch.equal(second.actor.flat(), whole.actor.flat())
    assert torch.equal(second.critics.parameters, whole.critics.parameters)
    assert second.step == whole.step == 4_500


def test_seeds_differ_and_are_reproducible():
    flats = []
    for seed in (0, 0, 1):
        run = trainer("ppo_lagrangian", seed, epoch_steps=500)
        run.advance(1)
        flats.append(run.actor.flat())
    assert torch.equal(flats[0], flats[1])
    assert not torch.equal(flats[0], flats[2])


def test_saved_policy_acts_like_the_trained_one():
    run = trainer("trpo_lagrangian", epoch_steps=500)
    run.advance(1)
    buffer = io.BytesIO()
    np.savez(buffer, **run.policy.arrays())
    buffer.seek(0)
    with np.load(buffer, allow_pickle=False) as archive:
        loaded = Policy.from_arrays(dict(archive))
    observations = np.linspace(-1.0, 1.0, 7)[:, None]
    np.testing.assert_array_equal(loaded.act(observations), run.policy.act(observations))
    means = run.actor.mean(torch.from_numpy(observations).float()).detach().numpy()
    np.testing.assert_array_equal(loaded.act(observations), means.clip(-1.0, 1.0))
    sampled = [
        loaded.act(np.zeros((4_000, 1)), False, torch.Generator().manual_seed(0)) for _ in "ab"
    ]
    np.testing.assert_array_equal(*sampled)
    # clipping to the box takes a little of the spread
    assert sampled[0].std() == pytest.approx(np.exp(run.actor.log_std.item()), rel=0.15)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_published_settings_are_valid(name):
    module = importlib.import_module(f"safemr.algorithms.{name}")
    config = module.Config(**module.PUBLISHED)
    assert (config.hidden, config.epoch_steps, config.value_passes) == (256, 8_000, 80)
    assert config.value_batch >= config.epoch_steps
    assert module.Config() != config
    runs = resolve(load(["config/config.yaml", "config/published.yaml"])).runs
    (run,) = (run for run in runs if run.config["algorithm"]["name"] == name)
    assert run.config["algorithm"]["hyperparameters"] == resolved(config)


@pytest.mark.parametrize(
    ("overrides", "culprit"),
    [
        ({"gamma": 1.5}, "gamma"),
        ({"target_kl": 0.0}, "target_kl"),
        ({"cost_limit": -1.0}, "cost_limit"),
        ({"epoch_steps": 1_001}, "num_envs"),
        ({"activation": "gelu"}, "activation"),
        ({"multiplier_lr": 0.0}, "multiplier_lr"),
        ({"multiplier_optimizer": "adagrad"}, "multiplier_optimizer"),
        ({"clip": -0.1}, "clip"),
    ],
)
def test_bad_hyperparameters_are_named(overrides, culprit):
    with pytest.raises(UserError, match=culprit):
        ppo_lagrangian.Config(**overrides)


def test_bad_trust_region_settings_are_named():
    with pytest.raises(UserError, match="backtrack_factor"):
        cpo.Config(backtrack_factor=1.2)
    with pytest.raises(UserError, match="damping"):
        cpo.Config(damping=-1.0)
