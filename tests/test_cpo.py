"""CPO's dual against numerical optimisation, its optimality conditions, and its edge cases."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from safemr.algorithms.cpo import Dual, solve_dual

SIZE, INSTANCES = 5, 12


def problem(seed: int, case: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, float]:
    """Random H, g, b, c, delta whose linear constraint is in the position that ``case`` names."""
    random = np.random.default_rng([seed, case])
    factor = random.normal(size=(SIZE, SIZE))
    H = factor @ factor.T + 0.3 * np.eye(SIZE)
    g, b = random.normal(size=(2, SIZE))
    delta = float(10.0 ** random.uniform(-2.5, 0.0))
    reach = math.sqrt(2.0 * delta * (b @ np.linalg.solve(H, b)))
    low, high = {0: (1.05, 3.0), 1: (0.05, 0.95), 2: (-0.95, -0.05), 3: (-3.0, -1.05)}.get(
        case, (-1.0, -0.1)
    )
    if case == 4:
        b = np.zeros(SIZE)
    return H, g, b, float(random.uniform(low, high)) * (reach if reach else 1.0), delta


def solve(
    H: np.ndarray, g: np.ndarray, b: np.ndarray, c: float, delta: float, tolerance: float = 0.0
) -> tuple[Dual, np.ndarray]:
    v, w = np.linalg.solve(H, g), np.linalg.solve(H, b)
    dual = solve_dual(g @ v, g @ w, b @ w, c, delta, tolerance)
    return dual, -(dual.along_reward * v + dual.along_cost * w)


def numerical(H: np.ndarray, g: np.ndarray, b: np.ndarray, c: float, delta: float) -> np.ndarray:
    """The same problem by SLSQP, in coordinates in which the trust region is the unit ball."""
    factor = np.linalg.cholesky(H) / math.sqrt(2.0 * delta)
    reward, cost = np.linalg.solve(factor, np.array([g, b]).T).T
    scale = np.abs(reward).max()
    constraints = [{"type": "ineq", "fun": lambda y: 1.0 - y @ y, "jac": lambda y: -2.0 * y}]
    if np.any(cost):
        size = np.abs(cost).max()
        constraints.append(
            {"type": "ineq", "fun": lambda y: -(c + cost @ y) / size, "jac": lambda y: -cost / size}
        )
    result = minimize(
        lambda y: reward @ y / scale,
        np.zeros(SIZE),
        jac=lambda y: reward / scale,
        constraints=constraints,
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 500},
    )
    return np.linalg.solve(factor.T, result.x)


@pytest.mark.parametrize("case", [1, 2, 3, 4])
def test_step_equals_numerical_optimum(case):
    for seed in range(INSTANCES):
        instance = problem(seed, case)
        dual, x = solve(*instance)
        assert dual.case == case
        expected = numerical(*instance)
        assert np.abs(x - expected).max() <= 1e-6 * max(1.0, np.abs(expected).max())


@pytest.mark.parametrize("case", [1, 2, 3, 4])
def test_multipliers_and_step_satisfy_the_optimality_conditions(case):
    """Convex problem: these conditions are sufficient, so this is a proof for each instance."""
    active = 0
    for seed in range(100):
        H, g, b, c, delta = problem(seed, case)
        dual, x = solve(H, g, b, c, delta)
        kl, cost = dual.kl_multiplier, dual.cost_multiplier
        assert kl is not None
        assert cost is not None
        assert kl >= 0.0
        assert cost >= 0.0
        np.testing.assert_allclose(g + cost * b + kl * H @ x, 0.0, atol=1e-9 * (1.0 + cost))
        assert x @ H @ x / 2 == pytest.approx(delta, rel=1e-9)
        assert c + b @ x <= 1e-9
        assert cost * (c + b @ x) == pytest.approx(0.0, abs=1e-9)
        active += cost > 0.0
    # the constraint binds in some instances and not in others, where it can
    assert (0 < active < 100) if case in (1, 2) else active == 0


def test_infeasible_step_decreases_the_cost_most():
    for seed in range(INSTANCES):
        H, g, b, c, delta = problem(seed, 0)
        dual, x = solve(H, g, b, c, delta)
        assert (dual.case, dual.kl_multiplier, dual.cost_multiplier) == (0, None, None)
        assert x @ H @ x / 2 == pytest.approx(delta)
        expected = numerical(H, b, np.zeros(SIZE), 0.0, delta)
        assert np.abs(x - expected).max() <= 1e-6 * max(1.0, np.abs(expected).max())
        assert c + b @ x > 0.0


@pytest.mark.parametrize("conflict", [True, False])
def test_c_zero_is_a_feasible_start(conflict):
    """The plane passes through the current policy; r / c is never formed."""
    for seed in range(INSTANCES):
        H, g, b, _, delta = problem(seed, 2)
        # r > 0: descending the loss also lowers the cost
        if (g @ np.linalg.solve(H, b) < 0.0) != conflict:
            b = -b
        dual, x = solve(H, g, b, 0.0, delta)
        assert dual.case == 2
        np.testing.assert_allclose(x, numerical(H, g, b, 0.0, delta), atol=1e-6)
        assert (b @ x == pytest.approx(0.0, abs=1e-12)) if conflict else b @ x < 0.0
        assert g @ x < 0.0
        limits = [solve(H, g, b, c, delta)[1] for c in (-1e-10, 1e-10)]
        np.testing.assert_allclose(limits, [x, x], atol=1e-6)


@pytest.mark.parametrize(("c", "case"), [(0.0, 4), (-1.0, 4), (1.0, 0)])
@pytest.mark.parametrize("tolerance", [0.0, 0.01])
def test_vanishing_cost_gradient(c, case, tolerance):
    """Without violation the plain TRPO step; with one nothing can be done, so nothing is."""
    H, g, b, _, delta = problem(0, 2)
    b *= 0.99 * tolerance / math.sqrt(2.0 * delta * (b @ np.linalg.solve(H, b)))
    dual, x = solve(H, g, b, c, delta, tolerance)
    assert dual.case == case
    assert dual.reach == pytest.approx(0.99 * tolerance)
    v = np.linalg.solve(H, g)
    np.testing.assert_allclose(x, -math.sqrt(2.0 * delta / (g @ v)) * v * (case == 4))


@pytest.mark.parametrize("c", [-0.1, 0.0, 0.1])
def test_reward_and_cost_gradients_in_exact_conflict(c):
    """g = -b: the best points fill the plane c + b.x = 0; the nearest one is taken."""
    H, g, _, _, delta = problem(1, 2)
    b = -g / np.sqrt(2.0 * delta * (g @ np.linalg.solve(H, g)))
    dual, x = solve(H, g, b, c, delta)
    assert dual.case == (1 if c > 0.0 else 2)
    assert c + b @ x == pytest.approx(0.0, abs=1e-9)
    assert x @ H @ x / 2 == pytest.approx(c * c * delta, abs=1e-12)


def test_plane_that_touches_the_region_gives_a_finite_step():
    H, g, b, _, delta = problem(3, 1)
    reach = math.sqrt(2.0 * delta * (b @ np.linalg.solve(H, b)))
    _, x = solve(H, g, b, reach, delta)
    assert np.isfinite(x).all()
    assert reach + b @ x == pytest.approx(0.0, abs=1e-6)


def test_no_gradient_at_all_is_no_step():
    dual = solve_dual(0.0, 0.0, 0.0, 0.0, 0.01)
    assert (dual.case, dual.along_reward, dual.along_cost) == (4, 0.0, 0.0)
