"""The scalar multiplier: direction, momentum, limits."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from safemr.learning.lagrange import Multiplier, MultiplierConfig, penalised


@pytest.mark.parametrize("initial", [1e-3, 1.0, 40.0])
def test_starts_where_asked(initial):
    assert Multiplier(MultiplierConfig(initial)).value == pytest.approx(initial)


def test_zero_start_is_almost_zero_and_can_rise():
    multiplier = Multiplier(MultiplierConfig(0.0))
    assert 0.0 <= multiplier.value <= 1e-6
    before = multiplier.value
    for _ in range(5):
        multiplier.update(10.0, 0.0)
    assert multiplier.value > before


@pytest.mark.parametrize("optimizer", ["adam", "sgd"])
def test_never_falls_at_limit_zero(optimizer):
    """EpCost - 0 >= 0, so neither a gradient nor its momentum ever points down."""
    random = np.random.default_rng(0)
    multiplier = Multiplier(MultiplierConfig(1.0, 0.05, optimizer))
    values = [multiplier.value]
    for epoch in range(300):
        multiplier.update(random.exponential(5.0) if epoch % 3 else 0.0, 0.0)
        values.append(multiplier.value)
    assert all(later >= earlier for earlier, later in itertools.pairwise(values))
    assert values[-1] > values[0]


@pytest.mark.parametrize(("violation", "slack"), [(10.0, 10.0), (40.0, 5.0), (5.0, 20.0)])
def test_at_limit_25_turns_within_the_documented_number_of_updates(violation, slack):
    """The bound in the class's docstring is exact: not an update earlier, not one later."""
    rising = 30
    multiplier = Multiplier(MultiplierConfig())
    for _ in range(rising):
        multiplier.update(25.0 + violation, 25.0)
    peak = [multiplier.value]
    for _ in range(60):
        multiplier.update(25.0 - slack, 25.0)
        peak.append(multiplier.value)
    falls = next(k for k in range(1, len(peak)) if peak[k] < peak[k - 1])
    decayed = slack / (slack + (1.0 - 0.9**rising) * violation)
    assert falls == math.floor(math.log(decayed) / math.log(0.9)) + 1
    assert all(later < earlier for earlier, later in itertools.pairwise(peak[falls:]))


def test_first_steps_of_both_optimisers():
    """Adam moves p by the learning rate whatever the violation; sgd in proportion to it."""
    for cost in (1.0, 100.0):
        multiplier = Multiplier(MultiplierConfig(1.0, 0.05, "adam"))
        start = float(multiplier.raw.detach())
        multiplier.update(cost, 0.0)
        assert float(multiplier.raw.detach()) - start == pytest.approx(0.05, rel=1e-6)
        multiplier = Multiplier(MultiplierConfig(1.0, 0.05, "sgd"))
        multiplier.update(cost, 0.0)
        assert float(multiplier.raw.detach()) - start == pytest.approx(0.05 * cost)


def test_state_restores_value_and_momentum():
    first, second = Multiplier(MultiplierConfig()), Multiplier(MultiplierConfig(3.0))
    for cost in (30.0, 12.0, 50.0):
        first.update(cost, 25.0)
    second.load_state_dict(first.state_dict())
    for _ in range(5):
        first.update(20.0, 25.0)
        second.update(20.0, 25.0)
        assert first.value == second.value


def test_penalised_objective():
    reward, cost = torch.tensor(6.0), torch.tensor(2.0)
    assert float(penalised(reward, cost, 0.0)) == 6.0
    assert float(penalised(reward, cost, 1.0)) == 2.0
    assert float(penalised(reward, cost, 1e9)) == pytest.approx(-2.0)
