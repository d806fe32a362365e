"""The on-policy family's numba backend against the torch backend: the same steps, to round-off."""

from __future__ import annotations

import copy
import importlib
import io
from typing import Any

import numpy as np
import pytest
import torch
from toy import ToyEnvs

from safemr.algorithms import cpo, ppo_lagrangian, trpo_lagrangian
from safemr.learning import on_policy_kernels
from safemr.learning.gaussian import log_density
from safemr.learning.hyperparameters import resolved
from safemr.learning.networks import ACTIVATIONS, StackedMLP
from safemr.learning.numba_steps import network
from safemr.learning.on_policy import OnPolicyTrainer
from safemr.learning.rollouts import Batch
from safemr.learning.trust_region import Loss

ALGORITHMS = ("ppo_lagrangian", "trpo_lagrangian", "cpo")
BACKENDS = ("torch", "fused")
SAMPLES, INPUTS, ACTIONS = 1_300, 5, 2  # more than two blocks of samples
SMALL: dict[str, Any] = {
    "num_envs": 10,
    "epoch_steps": SAMPLES,
    "hidden": 12,
    "value_passes": 1,
    "value_batch": 325,
    "cost_limit": 2.0,
}


class WideEnvs(ToyEnvs):
    """The toy as an environment of 5 observations and 2 actions; only its start is used."""

    def __init__(self, num_envs: int) -> None:
        super().__init__(num_envs)
        self.observation_layout = {"x": slice(0, INPUTS)}
        self.single_action_space.__init__(-1.0, 1.0, (ACTIONS,), np.float32)

    def reset(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        observations, infos = super().reset(**options)
        return observations.repeat(INPUTS, 1), infos


def make(name: str, backend: str, envs: Any = WideEnvs, **overrides: Any) -> Any:
    module = importlib.import_module(f"safemr.algorithms.{name}")
    settings = {**SMALL, "backend": backend, **overrides}
    if name == "ppo_lagrangian":
        settings = {"policy_passes": 1, "policy_batch": 325, "policy_lr": 2e-3} | settings
    run = module.Trainer(module.Config(**settings), envs, 0, 1_000_000)
    # the last layer starts near zero, which would leave most of the gradient untested
    noise = torch.Generator().manual_seed(1)
    weights = run.actor.flat()
    run.actor.load_flat(weights + 0.2 * torch.randn(weights.shape, generator=noise))
    return run


def pair(name: str, **overrides: Any) -> list[OnPolicyTrainer]:
    return [make(name, backend, **overrides) for backend in BACKENDS]


def epoch(run: OnPolicyTrainer, seed: int, cost: float = 3.0) -> Batch:
    """Samples of a trainer's policy with advantages that depend on the action, cost on reward."""
    rng = torch.Generator().manual_seed(seed)
    observations = torch.randn(SAMPLES, INPUTS, generator=rng)
    log_std = run.actor.log_std.detach().clone()
    with torch.no_grad():
        mean = run.actor.mean(observations)
        actions = mean + log_std.exp() * torch.randn(mean.shape, generator=rng)
    noise = torch.randn(2, SAMPLES, generator=rng)
    reward = actions[:, 0] - 0.3 * actions[:, 1] + 0.5 * noise[0]
    costs = actions[:, 1] * observations[:, 0] + 0.2 * actions[:, 0] + 0.5 * noise[1]
    returns = torch.stack([reward.cumsum(0) / 50.0, observations.square().sum(1)])
    return Batch(
        observations,
        actions,
        mean,
        log_std,
        log_density(actions, mean, log_std),
        (reward - reward.mean()) / reward.std(),
        costs - costs.mean(),
        returns,
        cost,
        40.0,
    )


def tensors(run: Any) -> dict[str, torch.Tensor]:
    found = {"log_std": run.actor.log_std.detach()}
    found["actor"] = run.actor.network.parameters.detach()
    found["critics"] = run.critics.parameters.detach()
    optimizers = {"critics": run.critic_optimizer}
    if isinstance(run, ppo_lagrangian.Trainer):
        optimizers["policy"] = run.policy_optimizer
    for name, adam in optimizers.items():
        for index, state in enumerate(adam.state.values()):
            found |= {f"{name} {index} {key}": value for key, value in state.items()}
    return found


def assert_same_numbers(runs: list[OnPolicyTrainer], tolerance: float) -> None:
    first, second = map(tensors, runs)
    assert first.keys() == second.keys()
    for name, value in first.items():
        scale = float(value.abs().max())
        difference = float((value - second[name]).abs().max())
        assert difference <= tolerance * scale, (name, difference, scale)


def update(run: Any, batch: Batch) -> dict[str, float]:
    return run.update_policy(batch) | run._fit_critics(batch) | {"kl": run._divergence(batch)}


# --- single steps ---------------------------------------------------------------------------------


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_one_step_of_ppo(activation: str) -> None:
    """From the gradient in Adam's first moments on; ratios on both sides of the clip."""
    runs = pair("ppo_lagrangian", activation=activation, target_kl=1.0)
    batch = epoch(runs[0], 0)
    for run in runs:  # away from the old policy, so that ratios differ from 1
        run.actor.load_flat(run.actor.flat() * 1.05 + 0.02)
    indices = torch.randperm(SAMPLES, generator=torch.Generator().manual_seed(3))[:700]
    for part in (indices, slice(None)):
        steps = [run._step(batch, part, 1.7) for run in runs]  # type: ignore[attr-defined]
        assert 0.05 < float(steps[0][1]) < 0.9
        torch.testing.assert_close(steps[1], steps[0], rtol=1e-4, atol=1e-6)
        assert_same_numbers(runs, 1e-5)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_one_step_of_the_critics(activation: str) -> None:
    runs = pair("cpo", activation=activation)
    batch = epoch(runs[0], 0)
    for part in (torch.arange(700).flip(0), slice(None)):
        losses = [run._value_step(batch, part) for run in runs]
        torch.testing.assert_close(losses[1], losses[0], rtol=1e-5, atol=1e-6)
        assert_same_numbers(runs, 1e-5)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_region(activation: str) -> None:
    """Surrogates, both gradients and a product with the Fisher matrix; then at a moved actor."""
    runs = pair("cpo", activation=activation)
    batch = epoch(runs[0], 0)
    regions = [run.region(batch) for run in runs]
    torch.testing.assert_close(
        torch.tensor(regions[1].old), torch.stack(regions[0].old), rtol=1e-5, atol=1e-6
    )
    losses: list[Loss] = [lambda r, _: -r, lambda _, c: 40.0 * c, lambda r, c: (2.0 * c - r) / 3.0]
    v = torch.randn(runs[0].actor.flat().shape, generator=torch.Generator().manual_seed(2))
    for loss in losses:
        expected, found = (region.gradient(loss) for region in regions)
        assert float((found - expected).abs().max()) <= 1e-5 * float(expected.abs().max())
    expected, found = (region.product(0.1)(v) for region in regions)
    assert float((found - expected).abs().max()) <= 1e-5 * float(expected.abs().max())
    for run in runs:
        run.actor.load_flat(run.actor.flat() + 0.05 * v)
    found, expected = (
        torch.tensor([float(value) for value in region.surrogates()]) for region in regions
    )
    assert float(expected[2]) > 0.01
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


def test_actions_and_values() -> None:
    runs = pair("cpo")
    observations = torch.randn(SAMPLES, INPUTS, generator=torch.Generator().manual_seed(0))
    raw = observations.numpy()
    for x in (raw, raw[:8], np.asfortranarray(raw[:8])):
        with torch.no_grad():
            actions = [run._act(x, np.ascontiguousarray(0.5 * x[:, :2])) for run in runs]
        np.testing.assert_allclose(*actions, rtol=1e-5, atol=1e-6)
    fused = runs[1].fused
    assert fused is not None
    with torch.no_grad():
        torch.testing.assert_close(fused.values(observations), runs[0].critics(observations))
        torch.testing.assert_close(fused.mean(observations), runs[0].actor.mean(observations))


def test_tanh_to_single_precision() -> None:
    """Through a network that is the identity before its activation; it is odd and reaches +-1."""
    stack = StackedMLP(1, (1, 1, 1), "tanh")
    stack.load(torch.tensor([1.0, 0.0, 1.0, 0.0]))
    x = np.concatenate([np.linspace(-12, 12, 100_001), [np.inf, -np.inf]]).astype(np.float32)
    found = on_policy_kernels.evaluate(network(stack), x[:, None])[0, 0]
    np.testing.assert_allclose(found, np.tanh(x.astype(float)), rtol=5e-7)
    assert np.abs(found).max() == 1.0


def test_not_a_number_is_not_hidden() -> None:
    for name in ("actor", "critics"):
        for algorithm in ALGORITHMS:
            run = make(algorithm, "fused", activation="relu")
            batch = epoch(run, 0)
            {"actor": run.actor.network, "critics": run.critics}[name].parameters.detach()[0] = (
                torch.nan
            )
            assert any(np.isnan(value) for value in update(run, batch).values())


# --- whole updates --------------------------------------------------------------------------------


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("name", ALGORITHMS)
def test_both_backends_take_the_same_steps(name: str, activation: str) -> None:
    """Networks, moments, multiplier and metrics over 20 updates, the cost around its limit.

    Few iterations of conjugate gradient: with the rectifier, ten lose their directions to rounding
    in either backend (5% from those in double precision).
    """
    overrides = {} if name == "ppo_lagrangian" else {"conjugate_gradient_iterations": 3}
    runs = pair(name, activation=activation, target_kl=0.002, **overrides)
    cases = set()
    for draw in range(20):
        batch = epoch(runs[0], draw, cost=(3.0, 1.0, 2.0, 60.0)[draw % 4])
        infos = [update(run, batch) for run in runs]
        assert infos[0].keys() == infos[1].keys()
        for key, value in infos[0].items():
            assert infos[1][key] == pytest.approx(value, rel=2e-3, abs=2e-5), (draw, key)
        assert_same_numbers(runs, 1e-5 if draw == 0 else 1e-4)
        cases |= {key for key, value in infos[0].items() if key.startswith("cpo_case") and value}
    if name == "cpo":
        assert len(cases) > 1


def test_early_stop_comes_at_the_same_minibatch() -> None:
    """Stops in the first pass, within a later one and never, and draws the same permutations."""
    found = set()
    for target in (1e-5, 1e-4, 5e-4, 2e-3, 8e-3, 1.0):
        runs = pair("ppo_lagrangian", target_kl=target, policy_passes=4, policy_batch=130)
        batch = epoch(runs[0], 1)
        passes = [run.update_policy(batch)["policy_passes"] for run in runs]
        assert passes[0] == passes[1]
        assert torch.equal(*(run.order.get_state() for run in runs))
        found.add(passes[0])
    assert max(found) == 4.0
    assert sum(0.0 < number < 4.0 for number in found) >= 3
    assert any(number % 1.0 for number in found)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_checkpoint_moves_between_backends(name: str) -> None:
    for order in (BACKENDS, BACKENDS[::-1]):
        runs = [make(name, backend) for backend in order]
        update(runs[0], epoch(runs[0], 0))
        runs[1].load_state_dict(copy.deepcopy(runs[0].state_dict()))
        batch = epoch(runs[0], 1)
        for run in runs:
            update(run, batch)
        assert_same_numbers(runs, 1e-4)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_resumed_run_equals_the_uninterrupted_one_bit_for_bit(name: str) -> None:
    sizes = {"num_envs": 25, "epoch_steps": 750, "value_batch": 400}
    whole, first = (make(name, "fused", ToyEnvs, **sizes) for _ in range(2))
    whole.advance(1_500)
    first.advance(1_500)
    buffer = io.BytesIO()
    torch.save(first.state_dict(), buffer)
    buffer.seek(0)
    second = make(name, "fused", ToyEnvs, **sizes)
    second.advance(750)  # bound to states that loading replaces
    second.load_state_dict(torch.load(buffer, weights_only=False))
    assert second.advance(4_500) == whole.advance(4_500)
    for key, value in tensors(whole).items():
        assert torch.equal(tensors(second)[key], value), key


def test_default_backend_is_not_recorded() -> None:
    """Records from before the backend could be chosen keep their digests."""
    for module in (ppo_lagrangian, trpo_lagrangian, cpo):
        assert "backend" not in resolved(module.Config())
        assert resolved(module.Config(backend="fused"))["backend"] == "fused"
        assert make(module.__name__.rpartition(".")[2], "torch").fused is None
