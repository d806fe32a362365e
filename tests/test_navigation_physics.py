"""The navigation tasks against closed forms: model constants, motion, lidar, costs, drawings."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import gymnasium
import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import envs  # noqa: F401  (registers the tasks)
from envs.drawing import draw_scene
from envs.navigation_kernels import observation_blocks, observe
from envs.navigation_physics import Worlds, compile_model
from envs.tasks import NAVIGATION_TASKS, REGISTERED_TASKS

TASKS = sorted(NAVIGATION_TASKS)
TIME_STEP = 0.02  # s, one environment step


def started(name: str, robot: list[float], goal: list[float], seed: int = 0) -> Any:
    """An environment with the robot at x, y, yaw and the goal at x, y, obstacles out of the way
    except the first, which is at the origin."""
    env = gymnasium.make(f"{name}-v0", disable_env_checker=True).unwrapped
    env.reset(seed=seed)
    state = env.get_state()
    worlds = state["worlds"]
    worlds["start"][0], worlds["goal"][0] = robot, goal
    worlds["obstacles"][0] = [[0.0, 0.0], [5.0, 5.0], [5.0, -5.0], [-5.0, 5.0]][: env.num_obstacles]
    if env.task.has_box:
        worlds["qpos"][0, 3:5] = [-3.0, -3.0]
    env.set_state(state)
    return env


@pytest.mark.parametrize("name", TASKS)
def test_model_constants(name: str) -> None:
    model = compile_model(NAVIGATION_TASKS[name])
    robot = model.body("robot").id
    assert model.body_mass[robot] == pytest.approx(0.00518879, abs=1e-8)
    assert model.body_ipos[robot] == pytest.approx([0.0192723, 0, 0], abs=1e-7)
    assert sorted(model.body_inertia[robot]) == pytest.approx(
        [1.842e-5, 2.649e-5, 2.649e-5], abs=1e-8
    )
    assert model.dof_damping[:3] == pytest.approx([0.01, 0.01, 0.005])
    size = float(name.split("-")[1])
    for j in range(NAVIGATION_TASKS[name].num_obstacles):
        assert model.geom(f"obstacle{j}").size[0] == size
    if name.endswith("Push"):
        assert model.body_mass[model.body("box").id] == pytest.approx(1.28e-4)
        names = ["world", "robot", "box", "goal", "obstacle0"]
    else:
        names = ["world", "robot", "goal", *(f"obstacle{j}" for j in range(4))]
    assert [model.body(i).name for i in range(model.nbody)] == names


@pytest.mark.parametrize("sleep", [False, True])
def test_solver_and_collision_options_are_mujocos_defaults(sleep: bool) -> None:
    options = compile_model(NAVIGATION_TASKS["Hazards-0.15-Push"].with_settings(sleep=sleep)).opt
    defaults = mujoco.MjModel.from_xml_string("<mujoco/>").opt
    fields = [name for name in dir(defaults) if not name.startswith("_")]
    fields = [name for name in fields if not callable(getattr(defaults, name))]
    different = {
        name
        for name in fields
        if not np.array_equal(getattr(options, name), getattr(defaults, name))
    }
    assert different == {"disableflags", "sleep_tolerance"} | ({"enableflags"} if sleep else set())
    off = mujoco.mjtDisableBit.mjDSBL_SENSOR | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    assert options.disableflags == off | defaults.disableflags
    assert options.enableflags == (mujoco.mjtEnableBit.mjENBL_SLEEP if sleep else 0)


@pytest.mark.parametrize("name", sorted(REGISTERED_TASKS))
def test_the_stepping_order_is_bitwise_ten_mujoco_steps(name: str) -> None:
    env = gymnasium.make(f"{name}-v0", disable_env_checker=True).unwrapped
    env.reset(seed=2)
    reference = Worlds(env.task, 1)
    reference.set_state(env.get_state()["worlds"])
    model, data = reference.models[0], reference.data[0]
    for action in np.random.default_rng(0).uniform(-1, 1, (100, 2)):
        env.step(action)
        data.ctrl[:] = action
        mujoco.mj_step(model, data, 10)
        state = env.get_state()["worlds"]
        assert np.array_equal(data.qpos, state["qpos"][0])
        assert np.array_equal(data.qvel, state["qvel"][0])


def test_speed_from_rest_at_full_thrust() -> None:
    env = started("Pillars-0.15-Goal", [-40.0, 9.0, 0.4], [1.0, 1.0])
    speeds = []
    for _ in range(100):
        observation, *_ = env.step(np.array([1.0, 0.0]))
        speeds.append(observation[env.observation_layout["velocimeter"]][0])
    assert [speeds[i] for i in (9, 24, 49, 99)] == pytest.approx([0.48, 0.93, 1.28, 1.47], abs=0.01)
    # The motor saturates at 0.05, so the thrust of a small action is as large as that of 1.
    slow = started("Pillars-0.15-Goal", [-40.0, 9.0, 0.4], [1.0, 1.0])
    for _ in range(10):
        observation, *_ = slow.step(np.array([0.05, 0.0]))
    assert observation[slow.observation_layout["velocimeter"]][0] == pytest.approx(speeds[9])


@pytest.mark.parametrize("name", TASKS)
def test_rates_are_derivatives_of_distances_and_rewards_add_up(name: str) -> None:
    env = started(name, [-1.5, 0.3, 0.1], [4.0, 4.0])
    push = name.endswith("Push")
    *_, info = env.step(np.array([0.04, 0.0]))
    total = 0.0
    start = env.scene()
    for _ in range(30):
        before = info
        observation, reward, _, _, info = env.step(np.array([0.04, 0.0]))
        slope = (info["d"] - before["d"]) / TIME_STEP
        mean_rate = (info["d_dot"] + before["d_dot"]) / 2
        # Within a step the chattering yaw servo swings the robot's origin by up to 0.01 m/s.
        np.testing.assert_allclose(slope, mean_rate, atol=1e-2)
        pose = env.scene().robot
        forward, left, _ = observation[env.observation_layout["velocimeter"]]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        velocity = np.array([c * forward - s * left, s * forward + c * left])
        away = pose[:2] - env.scene().obstacles
        expected = (away @ velocity) / np.linalg.norm(away, axis=1)
        np.testing.assert_allclose(info["d_dot"], expected, atol=1e-12)
        assert reward == info["reward_approach"] + info["reward_push"] + info["reward_goal"]
        total += reward
    end = env.scene()
    if push:
        distances = [np.hypot(np.linalg.norm(s.box[:2] - s.robot[:2]), 0.1) for s in (start, end)]
    else:
        distances = [np.linalg.norm(s.goal - s.robot[:2]) for s in (start, end)]
    assert total == pytest.approx(distances[0] - distances[1], abs=1e-4)


def test_goal_met_pays_one_and_moves_the_goal_clear_of_everything() -> None:
    env = started("Pillars-0.15-Goal", [-1.5, 0.0, 0.0], [-1.15, 0.0])
    paid = []
    for _ in range(40):
        before = env.scene()
        _, reward, terminated, _, info = env.step(np.array([0.05, 0.0]))
        assert not terminated
        met = np.linalg.norm(env.scene().robot[:2] - before.goal) <= 0.3
        assert info["goal_met"] == met
        if met:
            paid.append(reward - info["reward_approach"])
            moved = env.scene()
            assert not np.array_equal(moved.goal, before.goal)
            assert np.linalg.norm(moved.goal - moved.robot[:2]) >= 0.8
            break
    assert paid == pytest.approx([1.0])
    _, reward, _, _, info = env.step(np.array([0.0, 0.0]))
    assert abs(reward) < 0.05  # measured from the new goal: no jump


@pytest.mark.parametrize("name", ["Pillars-0.15-Goal", "Pillars-0.30-Goal"])
def test_pillar_cost_begins_exactly_at_d_min_and_the_nose_is_free(name: str) -> None:
    size = float(name.split("-")[1])
    backwards = started(name, [-1.0, 0.0, np.pi], [4.0, 4.0])
    costs = []
    for _ in range(150):
        *_, info = backwards.step(np.array([-0.05, 0.0]))
        assert (info["cost"] > 0) == (info["d"].min() <= backwards.d_min)
        assert info["cost_indicator"] == (info["cost"] > 0)
        assert info["cost_contact"] >= info["cost"]
        costs.append(info["cost"])
    assert sum(costs) > 0
    forwards = started(name, [-1.0, 0.0, 0.0], [4.0, 4.0])
    infos = [forwards.step(np.array([0.05, 0.0]))[4] for _ in range(150)]
    assert sum(info["cost"] for info in infos) == 0
    assert sum(info["cost_contact"] for info in infos) > 0
    assert min(info["d"].min() for info in infos) == pytest.approx(size + 0.15, abs=0.01)


def test_hazard_cost_is_the_depth_inside() -> None:
    env = started("Hazards-0.30-Push", [-0.6, 0.0, 0.0], [4.0, 4.0])
    costs = []
    for _ in range(60):
        *_, info = env.step(np.array([0.05, 0.0]))
        assert info["cost"] == pytest.approx(max(0.30 - info["d"][0], 0.0))
        assert info["cost_indicator"] == info["cost_contact"] == (info["d"][0] < 0.30)
        costs.append(info["cost"])
    assert max(costs) > 0.25


def lidar_by_definition(points: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray:
    """Safety Gym's aliased pseudo lidar, written down as its definition."""
    bins = np.zeros(16)
    for point in points:
        offset = complex(*(point - pose[:2])) * np.exp(-1j * pose[2])
        position = (np.angle(offset) % (2 * np.pi)) / (np.pi / 8)
        lower, alias = int(position) % 16, position % 1
        signal = np.exp(-abs(offset))
        bins[lower] = max(bins[lower], signal)
        bins[(lower + 1) % 16] = max(bins[(lower + 1) % 16], alias * signal)
        bins[(lower - 1) % 16] = max(bins[(lower - 1) % 16], (1 - alias) * signal)
    return bins


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(TASKS))
def test_observation_by_definition(seed: int, name: str) -> None:
    rng = np.random.default_rng(seed)
    task = NAVIGATION_TASKS[name]
    layout = task.observation_layout
    qpos, qvel, qacc = rng.normal(0, 2, (1, 10)), rng.normal(0, 1, (1, 9)), rng.normal(0, 5, (1, 9))
    pose, goal = rng.normal(0, 2, (1, 3)), rng.normal(0, 2, (1, 2))
    obstacles = rng.normal(0, 2, (1, task.num_obstacles, 2))
    observation = np.zeros((1, max(block.stop for block in layout.values())))
    blocks, reach = observation_blocks(layout), task.lidar_range
    observe(pose, qpos, qvel, qacc, obstacles, goal, blocks, reach, observation)
    c, s = np.cos(qpos[0, 2]), np.sin(qpos[0, 2])
    to_body = np.array([[c, s], [-s, c]])
    lidars = {"goal_lidar": goal, "pillars_lidar": obstacles[0], "hazards_lidar": obstacles[0]}
    lidars |= {"box_lidar": qpos[:, 3:5], "vases_lidar": np.zeros((0, 2))}
    expected = {
        "accelerometer": [*(to_body @ qacc[0, :2]), 9.81],
        "gyro": [0, 0, qvel[0, 2]],
        "magnetometer": [-0.5 * np.sin(pose[0, 2]), -0.5 * np.cos(pose[0, 2]), 0],
        "velocimeter": [*(to_body @ qvel[0, :2]), 0],
        **{block: lidar_by_definition(points, pose[0]) for block, points in lidars.items()},
    }
    for block, columns in layout.items():
        np.testing.assert_allclose(observation[0, columns], expected[block], atol=1e-12)


@pytest.mark.parametrize("name", sorted(REGISTERED_TASKS))
def test_top_down_drawing(name: str) -> None:
    env = gymnasium.make(f"{name}-v0").unwrapped
    env.reset(seed=0)
    scene = env.scene()
    _, ax = plt.subplots()
    path = scene.robot[:2] + np.linspace(0, 1, 20)[:, None] * [3.0, 0.0]
    draw_scene(ax, scene, trajectory=path)
    circles = [p for p in ax.patches if isinstance(p, matplotlib.patches.Circle)]
    drawn = {(*np.round(c.center, 6), round(c.radius, 6)) for c in circles}
    expected = {(*np.round(scene.goal, 6), 0.3), (*np.round(scene.robot[:2], 6), 0.1)}
    expected |= {(*np.round(xy, 6), env.task.obstacle_size) for xy in scene.obstacles}
    assert expected <= drawn
    polygons = [p for p in ax.patches if isinstance(p, matplotlib.patches.Polygon)]
    assert len(polygons) == (6 if env.task.has_box else 1 + env.task.has_vase)
    assert any(np.array_equal(line.get_xydata(), path) for line in ax.lines)
    assert ax.get_xlim()[1] >= path[:, 0].max()
    plt.close(ax.figure)


def test_frames_come_from_opengl_or_a_clear_error_comes() -> None:
    program = (
        "import gymnasium, numpy, envs\n"
        "e = gymnasium.make('Hazards-0.30-Push-v0', render_mode='rgb_array')\n"
        "e.reset(seed=0)\n"
        "try:\n"
        "    f = e.render(); print('frame', f.shape == (480, 480, 3), f.dtype, f.std() > 1)\n"
        "except RuntimeError as error:\n"
        "    print('error', 'envs.drawing.draw_scene' in str(error))\n"
        "e.close()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | ({"MUJOCO_GL": "egl"} if sys.platform == "linux" else {}),
    )
    assert done.stdout.strip() in ("frame True uint8 True", "error True")
