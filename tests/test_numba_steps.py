"""The numba backend against the torch backend: same losses, same optimiser, same numbers."""

from __future__ import annotations

import copy
import dataclasses
from types import ModuleType

import numpy as np
import pytest
import torch

from safemr.algorithms import fac, joint_sis, sac_lagrangian, safemr
from safemr.learning import numba_kernels, numba_steps
from safemr.learning.adam import Adam
from safemr.learning.networks import ACTIVATIONS, StackedMLP
from safemr.learning.replay import Batch, Replay
from safemr.learning.soft_actor_critic import SoftActorCritic
from safemr.learning.torch_steps import TorchSteps

MODULES = (fac, joint_sis, safemr, sac_lagrangian)
OBSERVATIONS, ACTIONS, OBSTACLES, BATCH, PARTS = 5, 2, 3, 24, 4


def transitions(seed: int) -> Batch:
    rng = np.random.default_rng(seed)
    count = PARTS * BATCH

    def tensor(*shape: int, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
        return torch.tensor(rng.uniform(low, high, (count, *shape)), dtype=torch.float32)

    return Batch(
        observations=tensor(OBSERVATIONS),
        actions=tensor(ACTIONS),
        returns=tensor(),
        discounts=0.99 * (tensor() > -0.8).float(),
        bootstraps=tensor(OBSERVATIONS),
        costs=tensor(low=0.0),
        d=tensor(OBSTACLES, low=0.2, high=1.5),
        d_dot=tensor(OBSTACLES, low=-1.5, high=1.5),
        d_next=tensor(OBSTACLES, low=0.2, high=1.5),
        d_dot_next=tensor(OBSTACLES, low=-1.5, high=1.5),
    )


def make(module: ModuleType, backend: str, **overrides: object) -> SoftActorCritic:
    settings = {"hidden": 16, "initial_log_temperature": -1.0, "backend": backend, **overrides}
    if module in (joint_sis, safemr):
        settings |= {"certificate_delay": 4, "certificate_start": 0.0}
    agent = module.Agent(module.Config(**settings), OBSERVATIONS, ACTIONS, 0.25, 0, 100)
    # A policy that starts near zero would leave most of the squashed Gaussian's gradient untested.
    rng = torch.Generator().manual_seed(1)
    for net in (agent.policy, agent.multiplier):
        net.load(net.parameters.detach() + 0.3 * torch.randn(net.shape.numel, generator=rng))
    return agent


def tensors(agent: SoftActorCritic) -> dict[str, torch.Tensor]:
    names = ("critics", "targets", "policy", "multiplier")
    found = {name: getattr(agent, name).parameters.detach() for name in names}
    for name, optimiser in agent.optimisers.items():
        (state,) = optimiser.state.values()
        found |= {f"{name} {key}": value.detach() for key, value in state.items()}
    if isinstance(agent, fac.Agent):
        found["zeta"] = agent.zeta
    return found | {"log_temperature": agent.log_temperature.detach()}


def assert_same_numbers(agents: list[SoftActorCritic], tolerance: float) -> None:
    first, second = map(tensors, agents)
    assert first.keys() == second.keys()
    for name, value in first.items():
        scale = float(value.abs().max())
        difference = float((value - second[name]).abs().max())
        assert difference <= tolerance * scale, (name, difference, scale)


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("module", MODULES)
def test_both_backends_take_the_same_steps(module: ModuleType, activation: str) -> None:
    """Every network, moment, temperature and zeta, and every metric, over 20 updates."""
    agents = [make(module, backend, activation=activation) for backend in ("torch", "fused")]
    for draw in range(5):
        infos = [agent.update(transitions(draw), PARTS, measure=True) for agent in agents]
        assert infos[0].keys() == infos[1].keys()
        for name, value in infos[0].items():
            assert float(infos[1][name]) == pytest.approx(float(value), rel=2e-4, abs=1e-6), name
        assert_same_numbers(agents, 1e-5 if draw == 0 else 1e-4)


@pytest.mark.parametrize(
    "overrides",
    [
        {"multiplier_action": "replay"},
        {"multiplier_cap": 0.05},
        {"multiplier_grad_norm": 1e-3},
        {"multiplier_bias": 30.0},
        {"policy_delay": 1, "multiplier_delay": 3, "hidden": 7},
    ],
    ids=str,
)
def test_both_backends_agree_where_branches_are_taken(overrides: dict[str, object]) -> None:
    agents = [make(fac, backend, **overrides) for backend in ("torch", "fused")]
    for draw in range(2):
        for agent in agents:
            agent.update(transitions(draw), PARTS)
    assert_same_numbers(agents, 2e-5)


@pytest.mark.parametrize("log_std", [-25.0, 3.0])
def test_both_backends_agree_at_the_bounds_of_the_standard_deviation(log_std: float) -> None:
    agents = [make(fac, backend) for backend in ("torch", "fused")]
    for agent in agents:
        _, bias = agent.policy.shape.layers(agent.policy.parameters.detach())[-1]
        bias[..., ACTIONS:] = log_std
        agent.update(transitions(0), PARTS)
    assert_same_numbers(agents, 2e-5)


def test_both_backends_sample_the_same_actions() -> None:
    agents = [make(fac, backend) for backend in ("torch", "fused")]
    observations = torch.randn(7, OBSERVATIONS, generator=torch.Generator().manual_seed(0))
    actions = [agent.act(observations) for agent in agents]
    assert actions[1].shape == (7, ACTIONS)
    torch.testing.assert_close(*actions)


def test_state_moves_between_backends() -> None:
    """A checkpoint of one backend continues in the other: they keep the same state."""
    agents = [make(safemr, backend) for backend in ("torch", "fused")]
    agents[0].update(transitions(0), PARTS)
    agents[1].load_state_dict(copy.deepcopy(agents[0].state_dict()))
    for agent in agents:
        agent.update(transitions(1), PARTS)
    assert_same_numbers(agents, 2e-5)


def test_choice_of_the_backend() -> None:
    """A device other than the CPU has no compiled kernels."""
    agent = make(fac, "fused")
    assert type(agent.backend) is numba_steps.NumbaSteps
    assert type(make(fac, "torch").backend) is TorchSteps
    agent.config = dataclasses.replace(agent.config, device="cuda")
    assert type(agent._make_backend()) is TorchSteps


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_gradients_of_a_stack(activation: str) -> None:
    """Forward pass, parameter and input gradients for several outputs a member."""
    rng = torch.Generator().manual_seed(0)
    stack = StackedMLP(3, (5, 7, 6, 2), activation, generator=rng)
    stack.load(stack.parameters.detach() + 0.1 * torch.randn(stack.shape.numel, generator=rng))
    x = torch.randn(11, 5, generator=rng, requires_grad=True)
    grad = torch.randn(3, 11, 2, generator=rng)
    out = stack(x)
    expected = torch.autograd.grad(out, [stack.parameters, x], grad)

    net, inputs = numba_steps.network(stack), x.detach().numpy()
    slopes = grad.transpose(1, 2).contiguous().numpy()
    memory = np.empty(3 * (7 + 6) * 11, np.float32)
    found = numba_kernels.forward(net, inputs, memory)
    torch.testing.assert_close(torch.from_numpy(found).transpose(1, 2), out.detach())
    flat = numba_kernels.backward(net, inputs, memory, slopes)
    torch.testing.assert_close(torch.from_numpy(flat), expected[0], rtol=1e-5, atol=1e-5)
    columns = numba_kernels.backward_inputs(net, memory, slopes, 2)
    torch.testing.assert_close(
        torch.from_numpy(columns).T, expected[1][:, 2:], rtol=1e-5, atol=1e-5
    )


def test_adam_is_that_of_torch() -> None:
    rng = torch.Generator().manual_seed(0)
    mine, theirs = (torch.linspace(-1, 1, 50).requires_grad_(True) for _ in range(2))
    ours, reference = Adam([mine], 0.01), torch.optim.Adam([theirs], lr=0.01)
    for step in range(100):
        grad = torch.randn(50, generator=rng) * 10.0 ** (step % 5 - 3)
        numba_kernels.adam(mine.detach().numpy(), grad.numpy(), numba_steps.optimiser(ours), 0.01)
        theirs.grad = grad
        reference.step()
    torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)
    assert ours.state[mine]["step"] == 100


@pytest.mark.parametrize("name", ["critics", "policy", "multiplier", "targets"])
def test_not_a_number_is_not_hidden(name: str) -> None:
    """A single NaN reaches the metrics, also through the rectifier."""
    agent = make(fac, "fused")
    getattr(agent, name).parameters.detach()[0] = torch.nan
    info = agent.update(transitions(0), PARTS, measure=True)
    assert any(np.isnan(float(value)) for value in info.values())


def test_replay_follows_episodes_alike_on_every_device() -> None:
    """The compiled walk along n-step returns against the array operations that a GPU uses."""
    rng = torch.Generator().manual_seed(0)
    replay = Replay(20, 3, 2, 1, 1, gamma=0.9, n_step=4)
    for step in range(33):
        flags = (torch.rand(2, 3, generator=rng) < 0.2).float()
        replay.add(
            observations=torch.full((3, 2), float(step)),
            next_observations=torch.full((3, 2), step + 0.5),
            actions=torch.zeros(3, 1),
            rewards=torch.randn(3, generator=rng),
            terminated=flags[0] * flags[1],
            ended=flags[0],
            costs=torch.zeros(3),
            distances=torch.zeros(3, 4),
        )
        every = torch.arange(replay.size * 3)
        for compiled, plain in zip(
            replay._follow_compiled(every), replay._follow(every), strict=True
        ):
            torch.testing.assert_close(compiled, plain)
