"""Conjugate gradient, Fisher products and the trust-region step against direct computation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from safemr.learning.gaussian import GaussianActor, entropy, kl_divergence, log_density
from safemr.learning.networks import StackedMLP
from safemr.learning.trust_region import (
    TrustRegionConfig,
    conjugate_gradient,
    fisher_vector_product,
    line_search,
    natural_step,
)


def small_actor(seed: int = 0, hidden: int = 4) -> tuple[GaussianActor, torch.Tensor]:
    """A double-precision actor with 2 actions, and 9 observations of 3 numbers."""
    generator = torch.Generator().manual_seed(seed)
    network = StackedMLP(
        1, (3, hidden, hidden, 2), "tanh", generator=generator, dtype=torch.float64
    )
    noise = torch.randn(network.shape.numel, generator=generator, dtype=torch.float64)
    network.load(network.parameters.detach() + 0.3 * noise)
    log_std = torch.tensor([-0.5, 0.2], dtype=torch.float64)
    observations = torch.randn(9, 3, generator=generator, dtype=torch.float64)
    return GaussianActor(network, log_std), observations


def mean_kl(actor: GaussianActor, observations: torch.Tensor, flat: torch.Tensor) -> torch.Tensor:
    """E_s[KL(actor || the actor with parameters ``flat``)] in plain, twice differentiable ops."""
    weights, log_std = flat.split([actor.network.parameters.numel(), len(actor.log_std)])
    hidden = observations
    layers = actor.network.shape.layers(weights)
    for level, (weight, bias) in enumerate(layers):
        hidden = torch.nn.functional.linear(hidden, weight[0], bias[0])
        if level < len(layers) - 1:
            hidden = torch.tanh(hidden)
    old = actor.mean(observations).detach(), actor.log_std.detach()
    return kl_divergence(*old, hidden, log_std).mean()


def test_density_divergence_and_entropy_are_those_of_torch():
    generator = torch.Generator().manual_seed(1)
    mean_0, mean_1, actions = torch.randn(3, 6, 2, generator=generator, dtype=torch.float64)
    log_std_0, log_std_1 = torch.randn(2, 2, generator=generator, dtype=torch.float64)
    normal_0, normal_1 = (
        torch.distributions.Normal(mean, log_std.exp().expand(6, 2))
        for mean, log_std in ((mean_0, log_std_0), (mean_1, log_std_1))
    )
    torch.testing.assert_close(
        log_density(actions, mean_0, log_std_0), normal_0.log_prob(actions).sum(-1)
    )
    torch.testing.assert_close(
        kl_divergence(mean_0, log_std_0, mean_1, log_std_1),
        torch.distributions.kl_divergence(normal_0, normal_1).sum(-1),
    )
    assert entropy(log_std_0) == pytest.approx(float(normal_0.entropy()[0].sum()))


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 12), st.integers(0, 2**31 - 1))
def test_conjugate_gradient_equals_a_direct_solve(size, seed):
    random = np.random.default_rng(seed)
    factor = random.normal(size=(size, size))
    matrix = torch.from_numpy(factor @ factor.T + np.eye(size))
    b = torch.from_numpy(random.normal(size=size))
    x = conjugate_gradient(lambda v: matrix @ v, b, 4 * size, tolerance=1e-24)
    torch.testing.assert_close(x, torch.linalg.solve(matrix, b), rtol=1e-8, atol=1e-9)


def test_conjugate_gradient_is_exact_after_as_many_steps_as_there_are_eigenvalues():
    products = []

    def product(v: torch.Tensor) -> torch.Tensor:
        products.append(v)
        return torch.cat([2.0 * v[:50], 7.0 * v[50:]])

    b = torch.linspace(-1.0, 1.0, 100, dtype=torch.float64)
    x = conjugate_gradient(product, b, 10)
    torch.testing.assert_close(x, torch.cat([b[:50] / 2.0, b[50:] / 7.0]))
    assert len(products) == 2
    assert conjugate_gradient(product, torch.zeros(100), 10).abs().max() == 0.0
    assert len(products) == 2


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_fisher_product_is_the_hessian_of_the_divergence(damping):
    actor, observations = small_actor()
    hessian = torch.autograd.functional.hessian(
        lambda flat: mean_kl(actor, observations, flat), actor.flat()
    )
    product = fisher_vector_product(actor, observations, damping)
    identity = torch.eye(len(hessian), dtype=torch.float64)
    columns = torch.stack([product(column) for column in identity], 1)
    torch.testing.assert_close(columns, hessian + damping * identity, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("seed", range(5))
def test_step_fills_the_trust_region_and_the_divergence_obeys_it(seed):
    """Damping keeps the step inside; the divergence is quadratic up to third-order terms."""
    actor, observations = small_actor(seed)
    generator = torch.Generator().manual_seed(seed)
    gradient = torch.randn(len(actor.flat()), generator=generator, dtype=torch.float64)
    product = fisher_vector_product(actor, observations, damping=0.0)
    damped = fisher_vector_product(actor, observations, damping=0.1)
    for radius in (1e-6, 1e-2):
        step = natural_step(damped, gradient, radius, 200)
        assert float(step @ damped(step)) / 2 == pytest.approx(radius)
        assert float(step @ gradient) < 0.0
        divergence = float(mean_kl(actor, observations, actor.flat() + step))
        assert divergence <= 1.05 * radius
        quadratic = float(step @ product(step)) / 2
        assert abs(divergence - quadratic) <= 5.0 * radius**1.5
    assert natural_step(product, torch.zeros_like(gradient), 0.01, 10).abs().max() == 0.0


def test_natural_step_is_optimal_within_the_region():
    actor, observations = small_actor()
    generator = torch.Generator().manual_seed(7)
    gradient = torch.randn(len(actor.flat()), generator=generator, dtype=torch.float64)
    product = fisher_vector_product(actor, observations, damping=0.1)
    best = float(natural_step(product, gradient, 0.01, 200) @ gradient)
    for _ in range(100):
        other = torch.randn(len(gradient), generator=generator, dtype=torch.float64)
        other *= (0.02 / (other @ product(other))).sqrt()
        assert float(other @ gradient) >= best - 1e-12


def test_line_search_takes_the_first_accepted_fraction_or_returns():
    actor, _ = small_actor()
    start = actor.flat()
    step = torch.ones_like(start)
    config = TrustRegionConfig(backtrack_factor=0.5, backtrack_iterations=4)

    def within(bound: float):
        return lambda: float((actor.flat() - start).abs().max()) <= bound

    assert line_search(actor, step, within(0.3), config) == {
        "line_search_steps": 3.0,
        "step_fraction": 0.25,
    }
    torch.testing.assert_close(actor.flat(), start + 0.25)
    actor.load_flat(start)
    assert line_search(actor, step, within(0.1), config)["step_fraction"] == 0.0
    assert torch.equal(actor.flat(), start)
