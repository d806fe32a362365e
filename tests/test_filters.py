"""The safety filter: what it may choose, what it leaves alone, and how it says what is missing."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

import envs  # noqa: F401  (registers the tasks)
import safemr
from safemr import paper
from safemr.certificates.falsification import make_simulator, next_energies
from safemr.errors import UserError
from safemr.filters.choice import Choice, Span, nearest_safe
from safemr.filters.models import CriticModel, FunctionModel, PointRobotModel, SimulatorModel
from safemr.filters.wrapper import FILTER_INFOS, FilteredEnvs
from safemr.learning.evaluation import play
from safemr.measure import filters
from safemr.measure.filters import RandomActions
from safemr.measure.store import Measurements

TASK = "Pillars-0.15-Goal"
PHI_H = safemr.EnergyCertificate("phi_h", paper.PHI_H)
LAYOUTS = {"episodes": 4, "seed": 40_000}


def driven(filtered: FilteredEnvs, steps: int) -> None:
    """Full speed into whatever is ahead, so that some worlds are at phi's edge."""
    for _ in range(steps):
        filtered.envs.step(np.tile(np.array([[0.05, 0.02]], np.float32), (filtered.num_envs, 1)))
    _, _, _, _, infos = filtered.envs.step(np.zeros((filtered.num_envs, 2), np.float32))
    filtered._seen = filtered._simulation.observe(), infos["d"], infos["d_dot"]


@pytest.mark.parametrize("repeat", [1, 5])
def test_no_violating_action_is_picked_where_the_simulator_has_a_safe_one(repeat: int) -> None:
    count, generator = 24, np.random.default_rng(0)
    filtered = FilteredEnvs(safemr.make_envs(TASK, count), PHI_H, action_repeat=repeat)
    simulator = make_simulator(TASK, count)
    filtered.reset(seed=0)
    driven(filtered, 45)
    met = 0
    for _ in range(6):
        worlds = filtered.envs.get_state()["worlds"]
        observations, d, d_dot = filtered._seen
        phi = PHI_H.phi(d, d_dot, filtered.d_min)
        wanted = generator.uniform(-1, 1, (count, 2)).astype(np.float32)
        choice = filtered.filter.choose(wanted, observations, d, d_dot)

        def g(actions: Any, worlds: Any = worlds, phi: Any = phi) -> Any:
            after = next_energies(simulator, worlds, actions, PHI_H.zeta, repeat)
            return PHI_H.constraint(phi, after)

        grid = filtered.filter._grid(observations)
        free = d.min(1) > 0.15 + 0.16 + 0.1  # the model knows no contact
        exists = free & (np.min([g(grid[:, k]) for k in range(0, grid.shape[1], 7)], 0) < -1e-6)
        taken = g(choice.actions)
        error = 1e-7 if repeat == 1 else 1e-2  # of the model of held actions
        assert exists.any()
        assert (taken[exists] < error).all()
        assert taken[free] == pytest.approx(choice.margin[free], abs=error)
        safe = free & (g(wanted) < -error)
        assert np.array_equal(choice.actions[safe], wanted[safe])
        assert not choice.intervened[safe].any()
        assert (choice.distance[~choice.intervened] == 0).all()
        met += int(choice.intervened.sum())
        filtered.step(wanted)
    assert met > 5


def test_the_closed_model_and_the_simulator_filter_alike() -> None:
    made = [safemr.make_envs(TASK, 3) for _ in range(2)]
    both = [
        FilteredEnvs(e, PHI_H, model)
        for e, model in zip(made, ("point_robot", "simulator"), strict=True)
    ]
    for filtered in both:
        filtered.reset(seed=5)
        driven(filtered, 40)
    closed, simulated = (f.filter for f in both)
    assert isinstance(closed.model, PointRobotModel)
    assert isinstance(simulated.model, SimulatorModel)
    before = made[1].get_state()
    seen, wanted = both[0]._seen, np.full((3, 2), 0.9, np.float32)
    first = closed.choose(wanted, *seen)
    second = simulated.choose(wanted, *seen)
    assert first.actions == pytest.approx(second.actions, abs=1e-6)
    assert first.margin == pytest.approx(second.margin, abs=1e-8)
    after = made[1].get_state()  # the environment itself was left alone
    assert all(np.array_equal(before["worlds"][k], after["worlds"][k]) for k in before["worlds"])


@settings(max_examples=60, deadline=None)
@given(
    edge=st.floats(-1.5, 1.5),
    wanted=st.lists(st.floats(-1, 1), min_size=2, max_size=2),
    angle=st.floats(0, 6.28),
)
def test_a_half_plane_is_projected_on(edge: float, wanted: list[float], angle: float) -> None:
    """g(a) = n a - edge: the nearest safe action is known, up to the candidates' spacing."""
    normal, action = np.array([np.cos(angle), np.sin(angle)]), np.array([wanted])
    span = Span(-np.ones(2), np.ones(2))
    choice = nearest_safe(
        action, lambda rows, actions: actions @ normal - edge, span, span.grid()[None]
    )
    excess = float(action[0] @ normal - edge)
    if excess < 0:
        assert np.array_equal(choice.actions, action)
    elif choice.feasible[0]:
        assert choice.margin[0] < 0
        projection = action[0] - excess * normal
        if (np.abs(projection) <= 1).all():
            assert excess <= choice.distance[0] <= excess + 0.12
    else:  # the corner against the normal is the least
        assert choice.actions[0] @ normal == pytest.approx(-np.abs(normal).sum(), abs=0.05)


def test_distances_are_in_useful_half_ranges() -> None:
    span = Span(np.array([-0.05, -1.0]), np.array([0.05, 1.0]))
    assert span.distance(np.array([-0.05, 0.5]), np.array([0.05, 0.5])) == pytest.approx(2.0)
    assert span.distance(np.array([0.05, 0.0]), np.array([1.0, 0.0])) == 0.0
    for size in range(1, 7):
        grid = Span(-np.ones(size), np.ones(size)).grid()
        assert len(grid) <= 300
        assert (grid == 0).all(1).any()


class Line(gymnasium.Env[Any, Any]):
    """A cart on a line that is to keep away from a wall at 0; [d, d_dot] is the observation."""

    observation_space = gymnasium.spaces.Box(-20.0, 20.0, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-2.0, 1.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.state = np.array([2.0 + self.np_random.uniform(), 0.0])
        return self.state.copy(), self._info()

    def step(self, action: Any) -> Any:
        self.state = np.stack(dynamics(self.state[None], np.asarray(action)[None]), -1)[0, 0]
        return self.state.copy(), -float(action[0]), False, False, self._info()

    def _info(self) -> dict[str, Any]:
        return {"d": self.state[:1].copy(), "d_dot": self.state[1:].copy(), "cost": 0.0}


def dynamics(states: Any, actions: Any) -> tuple[Any, Any]:
    speed = np.clip(states[:, 1:] + 0.1 * actions, -3, 3)
    return np.clip(states[:, :1] + 0.1 * speed, -20, 20), speed


def test_a_users_model_keeps_the_users_environment_from_its_wall() -> None:
    certificate = safemr.EnergyCertificate("brake", safemr.Zeta(0.2, 3.0, 1.0))
    env = safemr.SafetyFilter(Line(), certificate, dynamics, d_min=0.5)
    _, info = env.reset(seed=0)
    said = []
    for _ in range(200):
        _, _, _, _, info = env.step(np.array([-2.0]))
        assert info["d"][0] > 0.5
        said.append(info["filter_intervened"])
        assert {name: type(info[name]) for name in FILTER_INFOS} == {
            "filter_intervened": bool, "filter_distance": float, "filter_margin": float,
            "filter_feasible": bool,
        }  # fmt: skip
    assert not said[0]
    assert said[-1]
    state = env.unwrapped.state
    choice = safemr.filter_actions(
        certificate, dynamics, np.array([-2.0]), d_min=0.5, low=-2.0, high=1.0,
        observations=state, d=state[:1], d_dot=state[1:],
    )  # fmt: skip
    assert isinstance(choice, Choice)
    assert choice.actions.shape == (1,)
    assert choice.intervened


@pytest.mark.parametrize("name", [f"{TASK}-v0", "Aircraft-v0"])
def test_gymnasium_checks_the_wrapper_and_copies_continue(name: str) -> None:
    env = safemr.SafetyFilter(gymnasium.make(name), PHI_H)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that there is a wrapper, and infinite bounds
        check_env(env, skip_render_check=True)
    env.reset(seed=1)
    action = np.full(env.action_space.shape, 0.3, np.float32)
    twin = copy.deepcopy(env)
    for _ in range(5):
        ours, theirs = env.step(action), twin.step(action)
        assert np.array_equal(ours[0], theirs[0])
        assert ours[4]["filter_margin"] == theirs[4]["filter_margin"]


def test_a_decision_of_the_wrapper_is_that_of_the_batch() -> None:
    scalar = safemr.SafetyFilter(gymnasium.make(f"{TASK}-v0"), PHI_H, action_repeat=4)
    batch = FilteredEnvs(safemr.make_envs(TASK, 1), PHI_H, action_repeat=4)
    observation, _ = scalar.reset(seed=3)
    observations, _ = batch.reset(seed=3)
    action = np.array([0.05, 0.02], np.float32)
    for _ in range(25):
        observation, reward, _, _, info = scalar.step(action)
        observations, rewards, _, _, infos = batch.step(action[None])
        assert np.array_equal(observation, observations[0])
        assert reward == pytest.approx(rewards[0])
        assert info["control_steps"] == 4
        assert info["filter_margin"] == infos["filter_margin"][0]


def test_a_batch_behind_a_filter_is_what_evaluation_asks_for() -> None:
    class Zero:
        def act(self, observations: Any, deterministic: bool = True) -> Any:
            return np.zeros((len(observations), 2), np.float32)

    envs_ = FilteredEnvs(safemr.make_envs({"name": TASK, "settings": {"max_episode_steps": 5}}, 2),
                         PHI_H)  # fmt: skip
    assert play(Zero(), envs_, 0).pop()["length"] == 5


class Unbounded(Line):
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)


class Discrete(Line):
    action_space = gymnasium.spaces.Discrete(3)


class Blind(Line):
    def _info(self) -> dict[str, Any]:
        return {"d": np.ones(1)}


@pytest.mark.parametrize(
    ("env", "options", "message"),
    [
        (Line, {}, "does not say d_min"),
        (Line, {"d_min": 0.5}, "nothing says where an action leads in Line"),
        (Line, {"d_min": -1.0, "model": dynamics}, "d_min = -1.0: it must be a positive number"),
        (Line, {"d_min": 0.5, "model": "simulator"}, "Line has no get_state"),
        (Line, {"d_min": 0.5, "model": "point_robot"}, "Line is none"),
        (Line, {"d_min": 0.5, "model": "critic"}, "needs a certificate of a record"),
        (Line, {"d_min": 0.5, "model": "simulater"}, "did you mean 'simulator'"),
        (Line, {"d_min": 0.5, "model": 3}, "model = 3: use one of"),
        (Line, {"d_min": 0.5, "model": dynamics, "margin": -1}, "margin = -1"),
        (Line, {"d_min": 0.5, "model": dynamics, "action_repeat": 0}, "action_repeat = 0"),
        (Line, {"d_min": 0.5, "model": dynamics, "certificate": 5}, "5 is no certificate"),
        (Unbounded, {"d_min": 0.5, "model": dynamics}, "give the action space finite bounds"),
        (Discrete, {"d_min": 0.5, "model": dynamics}, "must be a Box of one dimension"),
    ],
)
def test_what_does_not_fit_is_told_in_one_line(env: Any, options: Any, message: str) -> None:
    with pytest.raises(UserError, match=message) as told:
        safemr.SafetyFilter(env(), options.pop("certificate", PHI_H), **options)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("model", "action", "message"),
    [
        (lambda s, a: s, [0.0], "it returns 'ndarray'"),
        (lambda s, a: (s[0], s[0]), [0.0], "it returns an array of shape"),
        (lambda s, a: (s * np.nan, s), [0.0], "not finite"),
        (lambda s, a: (s, s[:, :1]), [0.0], r"d has shape \(1, 2\) and d_dot \(1, 1\)"),
        (dynamics, [np.nan], "an action is not finite"),
        (dynamics, [0.0, 0.0], r"shape \(1, 2\), not \(1, 1\)"),
        (dynamics, ["left"], "actions have type"),
    ],
)
def test_bad_models_and_actions_are_told(model: Any, action: Any, message: str) -> None:
    env = safemr.SafetyFilter(Line(), PHI_H, model, d_min=0.5)
    env.reset(seed=0)
    with pytest.raises(UserError, match=message):
        env.step(np.array(action))


def test_an_environment_that_does_not_say_what_phi_needs_is_told() -> None:
    env = safemr.SafetyFilter(Blind(), PHI_H, dynamics, d_min=0.5)
    with pytest.raises(UserError, match="the info of reset lacks 'd_dot'"):
        env.reset(seed=0)
    with pytest.raises(UserError, match="no scalar environment"):
        safemr.SafetyFilter(safemr.make_envs(TASK, 2), PHI_H)  # type: ignore[arg-type]
    assert isinstance(FunctionModel(dynamics), FunctionModel)
    with pytest.raises(UserError, match="record_critic: true"):
        CriticModel(type("P", (), {"extras": {}}))


# --- policies that nobody trained ----------------------------------------------------------------


def test_random_actions_are_held_and_stay_within_the_space() -> None:
    space = gymnasium.spaces.Box(np.array([-1, 0], np.float32), np.array([1, 0.5], np.float32))
    policy = RandomActions(space, seed=3)
    drawn = np.array([policy.act(np.zeros((50, 4))) for _ in range(3 * RandomActions.HELD)])
    held = drawn.reshape(3, RandomActions.HELD, 50, 2)
    assert (held == held[:, :1]).all()
    assert len(np.unique(held[:, 0, :, 0])) == 150  # every world and every draw differ
    assert ((drawn >= space.low) & (drawn <= space.high)).all()
    again = RandomActions(space, seed=3)
    assert np.array_equal(again.act(np.zeros((50, 4))), drawn[0])


def test_a_scripted_controller_flies_behind_a_certificate_and_is_kept(tmp_path: Path) -> None:
    kept = Measurements(tmp_path)
    flights = [
        filters.measured_unlearned(kept, "scripted", TASK, certificate, **LAYOUTS)
        for certificate in (None, PHI_H)
    ]
    (alone,), (behind,) = flights[0].values(), flights[1].values()
    assert list(flights[0]) == ["scripted: ignores obstacles"]
    assert alone["cost_indicator"] > 0 == behind["cost_indicator"]
    assert 0 < behind["intervened"] < 1
    assert alone["intervened"] == 0
    files = sorted((tmp_path / "measurements/filters").iterdir())
    changed = [path.stat().st_mtime_ns for path in files]
    assert len(files) == 2
    filters.measured_unlearned(kept, "scripted", TASK, PHI_H, **LAYOUTS)
    assert [path.stat().st_mtime_ns for path in files] == changed


def test_a_flight_without_a_learned_part_is_counted_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Layouts are the same for all seeds: what does not depend on a run is one flight."""
    metrics = dict.fromkeys(("return", "cost_indicator", "intervened", "distance"), 1.0)
    monkeypatch.setattr(filters, "measured_unlearned", lambda *_, **__: {"scripted": dict(metrics)})
    flown = filters.measured_scores(
        Measurements(tmp_path), [], {"phi_h": []}, episodes=100, seed=20_000,
        unlearned=["scripted"], task=TASK, seeds=[3, 4, 5],
    )  # fmt: skip
    rows = flown[flown["metric"] == "return"]
    assert rows[["filter", "seed"]].to_numpy().tolist() == [["", 3], ["phi_h", 3]]
