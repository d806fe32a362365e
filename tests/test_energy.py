"""phi, the constraint and the magnitude term against hand-computed values and derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from safemr.certificates import energy

lengths = st.floats(0.05, 20.0)
rates = st.floats(-5.0, 5.0)
parameters = st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 3.0), st.floats(0.3, 3.0))


def test_hand_computed_values():
    # (0.3 + 0.25)^2 - 0.5^2 - 1 * (-1.2) = 0.3025 - 0.25 + 1.2
    assert energy.energy(0.5, -1.2, 0.25, 0.3, 1.0, 2.0) == pytest.approx(1.2525)
    assert energy.magnitude(0.25, 0.3, 1.5, 2.0, 0.35, 0.15) == pytest.approx(
        0.35 * 0.3025 + 0.15 * 1.5
    )
    assert energy.scaled(10.0, -2.5, 5.0, 5.0) == (2.0, -0.5, 1.0)


@given(lengths, rates, st.floats(0.05, 5.0))
def test_phi_0_is_the_distance_to_contact(d, d_dot, d_min):
    assert energy.energy(d, d_dot, d_min, 0.0, 0.0, 1.0) == pytest.approx(d_min - d)


@given(lengths, rates, st.floats(0.05, 5.0), parameters)
def test_numpy_and_torch_agree(d, d_dot, d_min, zeta):
    arrays = energy.energy(np.array([d]), np.array([d_dot]), d_min, *zeta)
    tensors = energy.energy(
        torch.tensor([d], dtype=torch.float64),
        torch.tensor([d_dot], dtype=torch.float64),
        d_min,
        *zeta,
    )
    np.testing.assert_allclose(arrays, tensors.numpy(), rtol=1e-12, atol=1e-12)


@given(lengths, rates, st.floats(0.05, 5.0), parameters)
@settings(max_examples=50)
def test_derivatives_by_hand(d, d_dot, d_min, zeta):
    """d phi/d sigma = n c^(n-1), d phi/d k = -d_dot, d phi/d n = c^n ln c - d^n ln d."""
    tensor = torch.tensor(zeta, dtype=torch.float64, requires_grad=True)
    sigma, k, n = tensor.unbind()
    d_tensor = torch.tensor(d, dtype=torch.float64)
    energy.energy(d_tensor, torch.tensor(d_dot, dtype=torch.float64), d_min, sigma, k, n).backward()
    c = zeta[0] + d_min
    expected = [
        zeta[2] * c ** (zeta[2] - 1),
        -d_dot,
        c ** zeta[2] * math.log(c) - d ** zeta[2] * math.log(d),
    ]
    np.testing.assert_allclose(tensor.grad.numpy(), expected, rtol=1e-6, atol=1e-6)


def test_gradcheck_through_the_maximum_and_the_constraint():
    generator = torch.Generator().manual_seed(3)
    d, d_dot, d_next, d_dot_next = torch.rand(4, 6, 3, generator=generator, dtype=torch.float64)

    def g(zeta: torch.Tensor) -> torch.Tensor:
        phi, phi_next = (
            energy.largest(energy.energy(0.2 + x, v - 0.5, 0.25, *zeta.unbind()))
            for x, v in ((d, d_dot), (d_next, d_dot_next))
        )
        return energy.constraint(phi, phi_next, 0.01)

    zeta = torch.tensor([0.3, 1.0, 2.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(g, (zeta,))


def test_the_largest_obstacle_decides_for_values_and_gradient():
    phi = torch.tensor([[1.0, 3.0, 2.0], [0.0, -1.0, -2.0]], requires_grad=True)
    largest = energy.largest(phi)
    assert largest.tolist() == [3.0, 0.0]
    assert energy.largest(phi.detach().numpy()).tolist() == [3.0, 0.0]
    largest.sum().backward()
    assert phi.grad.tolist() == [[0, 1, 0], [1, 0, 0]]


@pytest.mark.parametrize(
    ("phi", "expected", "slope"),
    [(-1.0, 0.5, 0.0), (0.1, 0.5, 0.0), (0.1 + 1e-9, 0.5, -1.0), (2.0, 0.5 - 1.9, -1.0)],
)
def test_constraint_and_its_kink(phi, expected, slope):
    """phi(s') - max(phi(s) - eta, 0): below the kink at phi = eta the old state does not count."""
    old = torch.tensor(phi, dtype=torch.float64, requires_grad=True)
    new = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    g = energy.constraint(old, new, 0.1)
    assert g.item() == pytest.approx(expected)
    g.backward()
    assert (old.grad.item(), new.grad.item()) == (slope, 1.0)


@given(lengths, rates, lengths, rates, st.floats(0.05, 5.0), parameters)
def test_no_loss_of_g_alone_raises_sigma(d, d_dot, d_next, d_dot_next, d_min, zeta):
    """dg/d sigma is n c^(n-1) > 0 where phi <= eta and 0 where phi > eta: never negative."""
    tensor = torch.tensor(zeta, dtype=torch.float64, requires_grad=True)
    phi, phi_next = (
        energy.energy(
            torch.tensor(x, dtype=torch.float64),
            torch.tensor(v, dtype=torch.float64),
            d_min,
            *tensor.unbind(),
        )
        for x, v in ((d, d_dot), (d_next, d_dot_next))
    )
    energy.constraint(phi, phi_next, 0.0).backward()
    c = zeta[0] + d_min
    expected = 0.0 if phi.item() > 0 else zeta[2] * c ** (zeta[2] - 1)
    assert tensor.grad[0].item() == pytest.approx(expected, abs=1e-9)


def test_magnitude_rises_with_n_only_where_its_base_exceeds_one():
    """The paper says it always rises; at its own scale, sigma + d_min = 0.35, it falls."""
    assert energy.magnitude(0.25, 0.1, 1, 2.1, 1, 0) < energy.magnitude(0.25, 0.1, 1, 2.0, 1, 0)
    assert energy.magnitude(5.0, 0.1, 1, 2.1, 1, 0) > energy.magnitude(5.0, 0.1, 1, 2.0, 1, 0)
