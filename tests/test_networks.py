"""Stacked perceptrons against plain PyTorch, and the squashed Gaussian against its definition."""

from __future__ import annotations

import pytest
import torch

from safemr.errors import UserError
from safemr.learning.networks import ACTIVATIONS, StackedMLP, squashed_gaussian

PLAIN = {"elu": torch.nn.ELU, "relu": torch.nn.ReLU, "tanh": torch.nn.Tanh}


def make(activation: str = "elu", count: int = 3, outputs: int = 2, seed: int = 0) -> StackedMLP:
    generator = torch.Generator().manual_seed(seed)
    net = StackedMLP(
        count, (5, 7, 6, outputs), activation, generator=generator, dtype=torch.float64
    )
    noise = torch.randn(net.shape.numel, generator=generator, dtype=torch.float64)
    net.load(net.parameters.detach() + 0.1 * noise)
    return net


def plain_copy(net: StackedMLP, member: int) -> torch.nn.Sequential:
    modules: list[torch.nn.Module] = []
    for weight, bias in net.shape.layers(net.parameters.detach()):
        linear = torch.nn.Linear(weight.shape[2], weight.shape[1], dtype=weight.dtype)
        linear.load_state_dict({"weight": weight[member], "bias": bias[member, 0]})
        modules += [linear, PLAIN[net.shape.activation]()]
    return torch.nn.Sequential(*modules[:-1])


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("shared", [True, False])
def test_equals_plain_perceptrons_with_gradients(activation, outputs, shared):
    net = make(activation, outputs=outputs)
    x = torch.randn((11, 5) if shared else (3, 11, 5), dtype=torch.float64, requires_grad=True)
    out = net(x)
    target = torch.randn_like(out)
    grad_x, grad_flat = torch.autograd.grad((out - target).square().sum(), [x, net.parameters])
    expected = torch.zeros_like(x)
    for member in range(3):
        plain = plain_copy(net, member)
        inputs = (x if shared else x[member]).detach().requires_grad_(True)
        y = plain(inputs)
        torch.testing.assert_close(out[member], y)
        (y - target[member]).square().sum().backward()
        if shared:
            expected += inputs.grad
        else:
            expected[member] = inputs.grad
        linears = [module for module in plain if isinstance(module, torch.nn.Linear)]
        for linear, (weight, bias) in zip(linears, net.shape.layers(grad_flat), strict=True):
            torch.testing.assert_close(weight[member], linear.weight.grad)
            torch.testing.assert_close(bias[member, 0], linear.bias.grad)
    torch.testing.assert_close(grad_x, expected)


def test_gradcheck_and_frozen():
    net = make()
    x = torch.randn(4, 5, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(net, (x,))
    net.frozen(x).sum().backward()
    assert net.parameters.grad is None
    assert x.grad is not None


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_jvp_is_the_directional_derivative(activation):
    net = make(activation)
    x, v = torch.randn(4, 5, dtype=torch.float64), torch.randn_like(net.parameters)
    weights = torch.randn_like(net(x))
    (gradient,) = torch.autograd.grad((weights * net(x)).sum(), [net.parameters])
    torch.testing.assert_close((weights * net.jvp(x, v)).sum(), gradient @ v.detach())


def test_orthogonal_start_and_polyak():
    net = StackedMLP(2, (6, 6, 6, 3), output_gain=0.1, output_bias=-3.0)
    for member in range(2):
        weight = net.shape.layers(net.parameters.detach())[1][0][member]
        torch.testing.assert_close(weight @ weight.T, 2.0 * torch.eye(6), atol=1e-5, rtol=0)
    assert (net.shape.layers(net.parameters.detach())[-1][1] == -3.0).all()
    target = net.copy()
    with torch.no_grad():
        net.parameters.add_(1.0)
    target.follow(net, 0.25)
    torch.testing.assert_close(
        net.parameters - target.parameters, torch.full((net.shape.numel,), 0.75)
    )


def test_wrong_sizes_are_refused():
    with pytest.raises(UserError, match="activation 'swish'"):
        StackedMLP(1, (2, 2), "swish")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="expected 6 parameters"):
        StackedMLP(1, (2, 2)).load(torch.zeros(5))


def test_squashed_gaussian_density_matches_change_of_variables():
    output = torch.randn(64, 4, dtype=torch.float64).clamp(-1.5, 1.5)
    noise = torch.randn(64, 2, dtype=torch.float64)
    action, log_density = squashed_gaussian(output, noise)
    mean, log_std = output.chunk(2, -1)
    distribution = torch.distributions.TransformedDistribution(
        torch.distributions.Normal(mean, log_std.exp()), torch.distributions.TanhTransform()
    )
    inside = (action.abs() < 0.999).all(-1)
    assert inside.sum() > 30
    torch.testing.assert_close(
        log_density[inside], distribution.log_prob(action).sum(-1)[inside], rtol=1e-6, atol=1e-6
    )


def test_squashed_gaussian_integrates_to_one():
    output = torch.tensor([0.3, -0.7], dtype=torch.float64).expand(20001, 2)
    noise = torch.linspace(-9, 9, 20001, dtype=torch.float64)[:, None]
    action, log_density = squashed_gaussian(output, noise)
    mass = torch.trapezoid(log_density.exp(), action[:, 0])
    torch.testing.assert_close(mass, torch.ones_like(mass), atol=1e-4, rtol=0)


def test_a_member_of_a_stack_is_that_network() -> None:
    stack = StackedMLP(3, (4, 8, 8, 2), "relu", generator=torch.Generator().manual_seed(0))
    x = torch.randn(5, 4, generator=torch.Generator().manual_seed(1))
    for index in range(3):
        assert torch.allclose(stack.member(index)(x)[0], stack(x)[index], atol=1e-6)
    single, before = stack.member(1), stack(x)[1].clone()
    with torch.no_grad():
        single.parameters.add_(1.0)
    assert torch.equal(stack(x)[1], before)  # it shares nothing
