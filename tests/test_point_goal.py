"""Safety Gym's PointGoal1, on which the baselines are compared with published results."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

import envs  # noqa: F401  (registers the tasks)
from envs.layout import sample_layout
from envs.navigation_physics import compile_model
from envs.tasks import NAVIGATION_TASKS, POINT_GOAL
from safemr.experiment.config import load
from safemr.experiment.planning import resolve
from safemr.learning.observation import ObservationTransform

FAR = 50.0  # m, out of the way


def make_vec(num_envs: int, **settings: Any) -> Any:
    return gymnasium.make_vec("PointGoal1-v0", num_envs, "vector_entry_point", **settings)


def started(
    robot: tuple[float, float, float],
    *,
    goal: tuple[float, float] = (FAR, 0.0),
    hazards: tuple[tuple[float, float], ...] = (),
    vase: tuple[float, float] = (-FAR, 0.0),
    **settings: Any,
) -> Any:
    """An environment in a layout of choice; the hazards that are not named are far away."""
    env = gymnasium.make("PointGoal1-v0", disable_env_checker=True, **settings).unwrapped
    env.reset(seed=0)
    state = env.get_state()
    worlds = state["worlds"]
    worlds["start"][0], worlds["goal"][0] = robot, goal
    worlds["obstacles"][0] = [*hazards, *[(FAR, FAR)] * (8 - len(hazards))]
    worlds["qpos"][0, 3:5] = vase
    env.set_state(state)
    return env


def test_it_stands_beside_the_papers_tasks_not_among_them() -> None:
    assert POINT_GOAL.name not in NAVIGATION_TASKS
    for file in ("config", "quick", "second_pilot", "smoke"):
        assert "PointGoal" not in str(load(["config/config.yaml", f"config/{file}.yaml"]))


def test_layouts_are_safety_gyms() -> None:
    """Eight hazards and a vase in a square of half-width 1.5, keepouts as in its suite.py."""
    keepouts = np.array([0.4, 0.305, *[0.18] * 8, 0.15])
    spacing = keepouts[:, None] + keepouts
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(300):
        layout = sample_layout(POINT_GOAL, rng)
        assert layout.box is not None
        assert layout.obstacles.shape == (8, 2)
        points = np.vstack([layout.robot[:2], layout.goal, layout.obstacles, layout.box[:2]])
        assert (np.abs(points) <= 1.5 - keepouts[:, None]).all()
        gaps = np.linalg.norm(points[:, None] - points, axis=2)
        assert (gaps >= spacing - 1e-12)[~np.eye(len(points), dtype=bool)].all()
        seen.append(points)
    # The square is used up to its rim, and hazards may overlap (their radius is 0.2).
    extreme = np.abs(seen).max(axis=(0, 2))
    assert (extreme > 1.5 - keepouts - 0.05).all()
    hazards = np.array(seen)[:, 2:10]
    gaps = np.linalg.norm(hazards[:, :, None] - hazards[:, None], axis=3)
    assert 0.36 <= gaps[gaps > 0].min() < 0.4


def test_the_vase_is_a_free_box_of_8_mg_that_rests_on_the_floor() -> None:
    model = compile_model(POINT_GOAL)
    assert model.body_mass[model.body("vase").id] == pytest.approx(8e-6)
    assert model.geom("vase").size == pytest.approx([0.1, 0.1, 0.1])
    assert model.nq == 10
    assert model.geom("obstacle7").size[0] == 0.2
    assert model.geom("obstacle7").contype == model.geom("obstacle7").conaffinity == 0
    env = started((0.0, 0.0, 0.0), vase=(1.0, 1.0))
    for _ in range(50):
        env.step(np.zeros(2))
    resting = env.get_state()["worlds"]["qpos"][0, 3:10]
    assert resting[:2] == pytest.approx([1.0, 1.0], abs=1e-6)
    # It sinks in by what carries it: Safety Gym measured 4e-5.
    assert resting[2] == pytest.approx(0.1 - 4e-5, abs=1e-5)


def test_observation_has_safety_gyms_60_columns() -> None:
    layout = POINT_GOAL.observation_layout
    sizes = {name: block.stop - block.start for name, block in layout.items()}
    assert sizes == {
        "accelerometer": 3,
        "goal_lidar": 16,
        "gyro": 3,
        "hazards_lidar": 16,
        "magnetometer": 3,
        "vase_lidar": 16,
        "velocimeter": 3,
    }
    assert list(sizes) == sorted(sizes)
    observation, _ = make_vec(2).reset(seed=0)
    assert observation.shape == (2, 60)
    # What the learners see of it: all but the five columns that are constant in the plane.
    assert ObservationTransform.for_layout(layout).dim == 60 - 5


def test_lidar_is_linear_up_to_three_metres() -> None:
    """1 - distance / 3 of the nearest thing in the bin, at bin centres half of it on each side."""
    angle = 2.5 * np.pi / 8  # in the middle of bin 2
    ahead = np.array([np.cos(angle), np.sin(angle)])
    left = np.array([-ahead[1], ahead[0]])
    env = started(
        (0.0, 0.0, 0.0),
        goal=tuple(3.1 * ahead),
        hazards=(tuple(1.2 * ahead), tuple(0.6 * ahead), tuple(3.5 * left)),
        vase=tuple(-0.9 * ahead),
    )
    observation, layout = env._batch.observe()[0], env.observation_layout

    def bins(name: str) -> dict[int, float]:
        values = observation[layout[name]]
        return {int(i): values[i] for i in np.flatnonzero(values)}

    assert bins("goal_lidar") == {}
    assert bins("hazards_lidar") == pytest.approx({1: 0.4, 2: 0.8, 3: 0.4}, abs=1e-6)
    assert bins("vase_lidar") == pytest.approx({9: 0.35, 10: 0.7, 11: 0.35}, abs=1e-6)


@pytest.mark.parametrize(("distance", "cost"), [(0.0, 1.0), (0.19, 1.0), (0.21, 0.0)])
def test_cost_says_whether_the_robot_is_inside_a_hazard(distance: float, cost: float) -> None:
    env = started((0.0, 0.0, 0.3), hazards=((distance, 0.0), (0.0, distance)))
    *_, info = env.step(np.zeros(2))
    # A second hazard at the same place makes it no worse: an indicator, not the depth.
    assert info["cost"] == info["cost_indicator"] == info["cost_contact"] == cost
    assert info["d"][:2] == pytest.approx(distance, abs=2e-3)


def test_reward_is_the_approach_and_one_a_goal() -> None:
    env = started((0.0, 0.0, 0.0), goal=(1.2, 0.0), vase=(0.0, 1.0))
    total = met = 0.0
    gap = 1.2
    while not met:
        _, reward, *_, info = env.step(np.array([0.05, 0.0]))
        met += info["goal_met"]
        remaining = 1.2 - env.scene().robot[0]
        assert info["reward_approach"] == pytest.approx(gap - remaining, abs=1e-3)
        assert reward == info["reward_approach"] + info["reward_goal"]
        assert (info["reward_push"], info["reward_goal"]) == (0.0, float(info["goal_met"]))
        total, gap = total + reward, remaining
    assert gap <= 0.3
    assert total == pytest.approx(1.0 + 1.2 - gap, abs=1e-3)
    goal = env.scene().goal
    assert np.abs(goal).max() <= 1.5 - 0.305
    assert np.hypot(*(goal - env.scene().robot[:2])) >= 0.705
    assert np.hypot(*(goal - [0.0, 1.0])) >= 0.455


def test_a_pushed_vase_moves_and_costs_nothing() -> None:
    env = started((0.0, 0.0, 0.0), vase=(0.5, 0.0))
    touched = False
    for _ in range(60):
        *_, info = env.step(np.array([0.05, 0.0]))
        names = [env._batch.worlds.models[0].geom(name).id for name in ("vase", "pointarrow")]
        pairs = env._batch.worlds.data[0].contact.geom
        touched |= any(set(pair) == set(names) for pair in pairs)
        assert info["cost"] == info["cost_contact"] == info["reward_push"] == 0.0
    assert touched
    scene = env.scene()
    assert scene.box is None
    assert scene.vase[0] > 0.6
    # The nose ends 0.15 m ahead and does not enter it.
    assert scene.vase[0] - scene.robot[0] > 0.15 + 0.09


def test_sleep_leaves_the_resting_vase_alone() -> None:
    """The setting that the recipe uses changes a step by no more than round-off of contacts."""
    ends = []
    for sleep in (False, True):
        env = started((0.0, 0.0, 0.0), vase=(1.0, 1.0), sleep=sleep)
        for _ in range(100):
            env.step(np.array([0.02, 0.0]))
        ends.append(env.get_state()["worlds"]["qpos"][0])
    np.testing.assert_allclose(ends[0][:6], ends[1][:6], atol=1e-6)


def test_the_recipe_resolves_to_three_runs_at_limit_25() -> None:
    plan = resolve(load(["config/config.yaml", "config/bands.yaml"]))
    assert {run.variant for run in plan.runs} == {"PPO-L", "TRPO-L", "CPO"}
    for run in plan.runs:
        values = run.config["algorithm"]["hyperparameters"]
        assert (values["cost_limit"], values["epoch_steps"], values["hidden"]) == (25.0, 20_000, 64)
        assert run.config["task"]["settings"] == {"sleep": True}
        assert run.config["steps"] == 1_000_000
        assert run.config["seed"] >= 100
