"""The aircraft environment against the equations of motion, and its metrics against known sets."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import envs  # noqa: F401  registers the environments
from envs.aircraft import AircraftDynamics, AircraftEnv, AircraftVectorEnv, outside_box
from safemr.aircraft import unsafe_sets
from safemr.aircraft.reachability import CONSTANT, Grid, Solution, solve
from safemr.certificates.energy import in_metres

DYNAMICS = AircraftDynamics()
RATES = st.floats(-1.0, 1.0)
STATES = st.tuples(st.floats(-6, 20), st.floats(-10, 10), st.floats(0, 2 * np.pi)).map(np.array)


def derivative(state: np.ndarray, a: float, b: float) -> np.ndarray:
    """The equations of motion, written down a second time."""
    x, y, psi = state
    return np.array([-5 + 5 * np.cos(psi) + a * y, 5 * np.sin(psi) - a * x, b - a])


def runge_kutta(state: np.ndarray, a: float, b: float, duration: float, steps: int) -> np.ndarray:
    h = duration / steps
    for _ in range(steps):
        k1 = derivative(state, a, b)
        k2 = derivative(state + h / 2 * k1, a, b)
        k3 = derivative(state + h / 2 * k2, a, b)
        k4 = derivative(state + h * k3, a, b)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state


@given(STATES, RATES, RATES)
@settings(max_examples=40, deadline=None)
def test_flow_is_the_solution_of_the_equations_of_motion(state: np.ndarray, a: float, b: float):
    np.testing.assert_allclose(
        DYNAMICS.flow(state, a, b), runge_kutta(state, a, b, 0.1, 20), atol=1e-10
    )
    np.testing.assert_allclose(
        DYNAMICS.flow(state, a, b, 2.0), runge_kutta(state, a, b, 2.0, 400), atol=1e-7
    )


@given(STATES, RATES, RATES, st.floats(0.01, 3.0), st.floats(0.01, 3.0))
@settings(max_examples=60, deadline=None)
def test_flow_is_a_group(state: np.ndarray, a: float, b: float, first: float, second: float):
    both = DYNAMICS.flow(DYNAMICS.flow(state, a, b, first), a, b, second)
    np.testing.assert_allclose(both, DYNAMICS.flow(state, a, b, first + second), atol=1e-9)
    np.testing.assert_allclose(DYNAMICS.flow(both, a, b, -first - second), state, atol=1e-9)


@given(STATES, RATES, RATES)
def test_flow_is_mirror_symmetric(state: np.ndarray, a: float, b: float):
    mirror = np.array([1.0, -1.0, -1.0])
    np.testing.assert_allclose(
        DYNAMICS.flow(mirror * state, -a, -b), mirror * DYNAMICS.flow(state, a, b), atol=1e-12
    )


@given(STATES.filter(lambda state: np.hypot(state[0], state[1]) > 0.5), RATES, RATES)
def test_separation_rate_is_the_derivative_of_the_separation(state: np.ndarray, a: float, b: float):
    h = 1e-5
    ahead, behind = DYNAMICS.flow(state, a, b, h), DYNAMICS.flow(state, a, b, -h)
    slope = (DYNAMICS.separation(ahead) - DYNAMICS.separation(behind)) / (2 * h)
    assert DYNAMICS.separation_rate(state) == pytest.approx(slope, abs=1e-6)


def test_separation_rate_at_zero_separation_is_zero():
    assert DYNAMICS.separation_rate(np.zeros(3)) == 0.0


@pytest.mark.parametrize(
    ("field", "value"), [("dt", 0.0), ("speed", np.nan), ("d_min", -1.0), ("other_turns", ())]
)
def test_dynamics_reject_nonsense(field: str, value: Any):
    with pytest.raises(ValueError, match=field):
        AircraftDynamics(**{field: value})


def vector(num_envs: int, **arguments: Any) -> AircraftVectorEnv:
    made = gymnasium.make_vec(
        "Aircraft-v0", num_envs, vectorization_mode="vector_entry_point", **arguments
    )
    assert isinstance(made, AircraftVectorEnv)
    return made


def test_info_reports_the_state_reached():
    env = AircraftEnv()
    _, info = env.reset(options={"state": [6.0, 1.0, 2.0]})
    assert info["cost"] == 0.0
    observation, _, _, _, info = env.step(np.array([0.3], np.float32))
    reached = DYNAMICS.flow(np.array([6.0, 1.0, 2.0]), np.float32(0.3), 1.0)
    expected = [reached[0], reached[1], np.cos(reached[2]), np.sin(reached[2])]
    np.testing.assert_allclose(observation, expected, atol=1e-12)
    assert info["d"] == pytest.approx([np.hypot(reached[0], reached[1])])
    assert info["d_dot"] == pytest.approx([float(DYNAMICS.separation_rate(reached))])


def test_actions_are_clipped_before_the_flow():
    outcomes = []
    for action in (1.0, 7.0):
        env = AircraftEnv()
        env.reset(options={"state": [10.0, 3.0, 1.0]})
        outcomes.append(env.step(np.array([action], np.float32)))
    np.testing.assert_array_equal(outcomes[0][0], outcomes[1][0])
    assert outcomes[0][1] == outcomes[1][1] == -1.0


@pytest.mark.parametrize(
    ("state", "action", "steps", "terminated", "cost"),
    [
        ([5.5, 0.0, np.pi], 0.0, 1, True, 1.0),  # closing head-on at 10 m/s
        ([-5.9, 0.0, np.pi / 2], 0.0, 1, True, 0.0),  # leaves through the back
        ([5.5, 0.0, 0.0], 1.0, 200, False, 0.0),  # in parallel flight the separation rests
    ],
)
def test_ends_of_an_episode(
    state: list[float], action: float, steps: int, terminated: bool, cost: float
):
    env = AircraftEnv()
    env.reset(options={"state": state})
    for step in range(1, steps + 1):
        _, _, done, over, info = env.step(np.array([action], np.float32))
        assert (done or over) == (step == steps)
    assert (done, over) == (terminated, not terminated)
    assert info["cost"] == info["cost_indicator"] == info["cost_contact"] == cost


def test_starts_fill_the_box_outside_the_disc():
    batch = vector(4000)
    observations, infos = batch.reset(seed=3)
    assert infos["d"].min() > 5.0
    assert not outside_box(observations).any()
    # The disc lies inside the box, centred at x = 0, so it takes nothing from the first moment.
    area = 26.0 * 20.0
    mean_x = area * 7.0 / (area - 25 * np.pi)
    assert observations[:, 0].mean() == pytest.approx(mean_x, abs=0.35)
    assert observations[:, 1:].mean(axis=0) == pytest.approx([0, 0, 0], abs=0.35)


def test_picture_shows_both_aircraft():
    env = AircraftEnv(render_mode="rgb_array")
    env.reset(options={"state": [10.0, 5.0, 1.0]})
    picture = env.render()
    assert picture is not None
    assert picture.shape == (260, 260, 3)
    assert picture.dtype == np.uint8
    rows, columns = np.nonzero((picture == (200, 30, 30)).all(axis=-1))
    assert -6 + 0.1 * columns.mean() == pytest.approx(10.0, abs=0.5)
    assert 13 - 0.1 * rows.mean() == pytest.approx(5.0, abs=0.5)


@pytest.fixture(scope="module")
def solution() -> Solution:
    return solve(CONSTANT, Grid(shape=(131, 131, 96)))


@pytest.fixture(scope="module")
def truth(solution: Solution) -> unsafe_sets.Truth:
    return unsafe_sets.Truth.sample(solution, log2_count=16)


def test_volume_of_the_true_set_and_of_the_disc(truth: unsafe_sets.Truth):
    assert truth.volume == pytest.approx(721.5, rel=0.003)
    assert truth.domain * truth.disc.mean() == pytest.approx(25 * np.pi * 2 * np.pi, rel=0.001)


# Computed independently, by another program on a 131 x 131 x 96 grid with 11 turn rates.
@pytest.mark.parametrize(
    ("zeta", "ratio", "iou", "missed", "infeasible", "infeasible_eta", "leak"),
    [
        ((0.3, 1.0, 2.0), 0.78, 0.741, 0.76, 0.034, 0.035, 0.014),
        ((0.0, 0.0, 1.0), 0.68, 0.685, 1.00, 0.012, 0.012, 0.012),
        ((0.3, 1.0, 1.0), 1.63, 0.603, 0.014, 0.144, 0.155, 0.018),
        ((0.922, 8.22, 1.67), 1.89, 0.525, 0.0, 0.163, 0.165, 0.022),
        ((0.098, 0.350, 0.724), 1.42, 0.682, 0.05, 0.123, 0.146, 0.016),
    ],
)
def test_known_certificates(
    truth: unsafe_sets.Truth,
    zeta: tuple[float, float, float],
    ratio: float,
    iou: float,
    missed: float,
    infeasible: float,
    infeasible_eta: float,
    leak: float,
):
    metrics = unsafe_sets.compare_certificate(truth, unsafe_sets.energy_of(CONSTANT, zeta))
    assert metrics.volume_ratio == pytest.approx(ratio, abs=0.02)
    assert metrics.iou == pytest.approx(iou, abs=0.008)
    assert metrics.missed_share == pytest.approx(missed, abs=0.015)
    assert metrics.infeasible_share == pytest.approx(infeasible, abs=0.004)
    assert metrics.infeasible_share_eta == pytest.approx(infeasible_eta, abs=0.004)
    assert metrics.leak_share == pytest.approx(leak, abs=0.003)
    assert metrics.covers == (missed == 0.0)


def test_the_truth_is_a_perfect_certificate_of_itself(truth: unsafe_sets.Truth, solution: Solution):
    def value_certificate(states: np.ndarray) -> np.ndarray:
        inside = np.clip(states[..., :2], [-6, -13], [20, 13])
        return -solution(np.concatenate([inside, states[..., 2:]], axis=-1))

    metrics = unsafe_sets.compare_certificate(truth, value_certificate)
    assert metrics.volume_ratio == pytest.approx(1.0, abs=1e-3)
    assert metrics.iou == pytest.approx(1.0, abs=1e-3)
    assert metrics.missed_share == 0.0
    assert metrics.covers
    assert metrics.leak_share < 0.001


@pytest.mark.parametrize(
    ("box", "missed", "published", "better"),
    [
        # Full cover is an extreme value: it grows with the number of sampled states.
        (unsafe_sets.WIDE_BOX, 0.0, 1.89, 0.08),
        (unsafe_sets.WIDE_BOX, 0.01, 1.65, 0.02),
        (unsafe_sets.WIDE_BOX, 0.05, 1.42, 0.02),
        (unsafe_sets.JOINT_SIS_BOX, 0.0, 1.97, 0.08),
        (unsafe_sets.JOINT_SIS_BOX, 0.01, 1.66, 0.02),
    ],
)
def test_frontier_is_at_least_as_good_as_a_random_search(
    truth: unsafe_sets.Truth,
    box: unsafe_sets.ParameterBox,
    missed: float,
    published: float,
    better: float,
):
    (point,) = unsafe_sets.frontier(truth, [missed], box)
    assert published - better <= point.volume_ratio <= published + 0.01
    metrics = unsafe_sets.compare_certificate(
        truth, unsafe_sets.energy_of(CONSTANT, point.zeta), turns=1
    )
    assert metrics.volume_ratio == pytest.approx(point.volume_ratio, abs=1e-3)
    assert metrics.missed_share <= missed + 1e-3


def test_frontier_is_not_beaten_by_random_parameters(truth: unsafe_sets.Truth):
    """Against the definition: random zeta, each judged by its own volume and missed share."""
    generator, box = np.random.default_rng(0), unsafe_sets.WIDE_BOX
    shares = np.array([0.02, 0.05, 0.2])
    least = [point.volume_ratio for point in unsafe_sets.frontier(truth, shares, box)]
    found = np.full(len(shares), np.inf)
    for _ in range(300):
        zeta = (
            generator.uniform(0.0, 1.0),
            np.exp(generator.uniform(*np.log(box.k))),
            generator.uniform(*box.n),
        )
        claimed = (unsafe_sets.energy_of(CONSTANT, zeta)(truth.states) > 0) | truth.disc
        missed = np.mean(~claimed[truth.unsafe & ~truth.disc])
        ratio = claimed.sum() / truth.unsafe.sum()
        found = np.where(missed <= shares, np.minimum(found, ratio), found)
    assert (found >= np.array(least) - 1e-3).all()
    assert np.isfinite(found).all()


def test_frontier_says_when_the_box_cannot_cover(truth: unsafe_sets.Truth):
    box = unsafe_sets.ParameterBox(sigma=(0.0, 0.1), k=(0.01, 0.02), n=(1.0, 1.1))
    impossible, possible = unsafe_sets.frontier(truth, [0.0, 1.0], box)
    assert impossible.volume_ratio == np.inf
    assert possible.volume_ratio < 1.0


@given(
    st.floats(5.01, 20),
    st.floats(0.05, 3.1),
    st.floats(0.1, 10),
    st.floats(0.5, 3),
    st.floats(-1, 1),
)
@settings(deadline=None)
def test_no_energy_function_is_feasible_dead_ahead(
    d: float, psi: float, k: float, n: float, a: float
):
    """On y = 0 phi rises at a rate in which the turn rate does not appear."""
    phi = unsafe_sets.energy_of(CONSTANT, (0.3, k, n))
    state, h = np.array([d, 0.0, psi]), 1e-6
    rise = (phi(CONSTANT.flow(state, a, 1.0, h)) - phi(CONSTANT.flow(state, a, 1.0, -h))) / (2 * h)
    expected = 5 * n * d ** (n - 1) * (1 - np.cos(psi))
    expected += 5 * k * np.sin(psi) * (1 - 5 * np.sin(psi) / d)
    assert rise == pytest.approx(expected, rel=1e-5, abs=1e-4)
    assert expected > 0


@given(st.floats(0, 1), st.floats(0.1, 3), st.floats(0.5, 2.5), st.floats(0.5, 6))
@settings(max_examples=30, deadline=None)
def test_zeta_in_other_length_units_means_the_same_set(
    sigma: float, k: float, n: float, length: float
):
    states = np.random.default_rng(0).uniform([-6, -10, 0], [20, 10, 6.28], (500, 3))
    scaled = unsafe_sets.energy_of(CONSTANT, (sigma, k, n), length)(states)
    metres = unsafe_sets.energy_of(CONSTANT, in_metres((sigma, k, n), length))(states)
    np.testing.assert_allclose(scaled * length**n, metres, rtol=1e-9, atol=1e-9)


class Straight:
    def act(self, observations: np.ndarray, deterministic: bool = True) -> np.ndarray:
        return np.zeros((len(observations), 1), np.float32)


def test_optimal_feedback_is_safe_where_straight_flight_is_not(solution: Solution):
    starts = unsafe_sets.safe_starts(solution, 1500, seed=0, margin=0.05)
    assert (solution(starts) > 0.05).all()
    straight = unsafe_sets.fly(Straight(), starts, CONSTANT)
    optimal = unsafe_sets.fly(unsafe_sets.OptimalEvader(solution), starts, CONSTANT)
    assert straight.summary()["collision_share"] > 0.2
    assert straight.summary()["effort"] == 0.0
    assert not optimal.collided.any()
    assert optimal.least_separation.min() >= 5.0
    # Flights that need no turn are flown straight: the same flights.
    assert 0.0 < optimal.summary()["effort_per_step"] < 0.3


def test_flights_report_each_start(solution: Solution):
    starts = np.array([[5.5, 0.0, np.pi], [-5.9, 0.0, np.pi / 2], [8.0, 0.0, np.pi]])
    flights = unsafe_sets.fly(Straight(), starts, CONSTANT)
    assert flights.collided.tolist() == [True, False, True]
    assert flights.steps[1] == 1
    assert flights.least_separation[0] == pytest.approx(4.5, abs=0.01)
