"""The navigation environments, beyond the contract of all (test_environments.py)."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import envs  # noqa: F401  (registers the tasks)
from envs.layout import LayoutError
from envs.scene import first_scene
from envs.tasks import NAVIGATION_TASKS, REGISTERED_TASKS, NavigationTask

TASKS = sorted(NAVIGATION_TASKS)


def make_vec(name: str, num_envs: int, **settings: Any) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(
        f"{name}-v0", num_envs=num_envs, vectorization_mode="vector_entry_point", **settings
    )


def assert_equal(first: Any, second: Any) -> None:
    """Bitwise equality of nested dictionaries of arrays and numbers."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_equal(first[key], second[key])
    else:
        np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("name", TASKS)
def test_attributes(name: str) -> None:
    scalar, vector = gymnasium.make(f"{name}-v0").unwrapped, make_vec(name, 2)
    size = float(name.split("-")[1])
    push = name.endswith("Push")
    for env in (scalar, vector):
        assert env.d_min == pytest.approx(size if push else size + 0.1)
        assert env.num_obstacles == (1 if push else 4)
        assert list(env.observation_layout) == sorted(env.observation_layout)
        assert env.observation_space.shape[-1] == (76 if push else 44)
    assert vector.max_episode_steps == 1000
    _, info = scalar.reset(seed=0)
    assert type(info["diverged"]) is bool


def test_a_sleeping_box_stays_asleep_in_a_snapshot() -> None:
    vector = make_vec("Hazards-0.15-Push", 2, sleep=True)
    vector.reset(seed=0)
    for _ in range(40):
        vector.step(np.zeros((2, 2)))
    snapshot = vector.get_state()
    assert (snapshot["worlds"]["asleep"].max(axis=1) >= 0).all()
    restored = make_vec("Hazards-0.15-Push", 2, sleep=True)
    restored.set_state(snapshot)
    restored.step(np.zeros((2, 2)))
    assert (restored.get_state()["worlds"]["asleep"].max(axis=1) >= 0).all()


def test_a_foreign_snapshot_is_refused() -> None:
    state = make_vec("Pillars-0.15-Goal", 2).get_state()
    with pytest.raises(ValueError, match=r"state 'start'.*\(3, 3\)"):
        make_vec("Pillars-0.15-Goal", 3).set_state(state)
    with pytest.raises(ValueError, match="obstacles"):
        make_vec("Hazards-0.15-Push", 2).set_state(state)


@pytest.mark.parametrize("name", ["Pillars-0.15-Goal", "Hazards-0.15-Push"])
def test_divergence_ends_the_episode_without_nan(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a log file
    vector = make_vec(name, 3)
    vector.reset(seed=0)
    state = vector.get_state()
    state["worlds"]["qvel"][1, 0] = 1e13
    vector.set_state(state)
    observation, reward, terminated, truncated, infos = vector.step(np.zeros((3, 2)))
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()
    assert reward[1] == -10.0
    assert infos["diverged"].tolist() == [False, True, False]
    for array in (observation, infos["final_obs"], infos["final_info"]["d"], infos["d"]):
        assert np.isfinite(array).all()
    observation, reward, terminated, _, _ = vector.step(np.zeros((3, 2)))
    assert np.isfinite(observation).all()
    assert np.abs(reward).max() < 1
    assert not terminated.any()


def test_a_copy_of_a_diverged_world_has_ended_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning to a log file
    env = gymnasium.make("Hazards-0.15-Push-v0").unwrapped
    env.reset(seed=0)
    state = env.get_state()
    state["worlds"]["qvel"][0, 0] = 1e13
    env.set_state(state)
    *_, terminated, _, info = env.step(np.zeros(2, np.float32))
    assert terminated
    assert info["diverged"]
    log = Path("MUJOCO_LOG.TXT")
    warnings = log.read_text() if log.exists() else ""
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert_equal(other.get_state(), env.get_state())
        assert_equal(other.scene().robot, env.scene().robot)
        with pytest.raises(gymnasium.error.ResetNeeded):
            other.step(np.zeros(2, np.float32))
        assert_equal(other.reset(seed=1)[0], copy.copy(env).reset(seed=1)[0])
    assert (log.read_text() if log.exists() else "") == warnings


def test_no_room_for_a_new_goal_terminates_and_still_pays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = gymnasium.make("Pillars-0.15-Goal-v0").unwrapped
    env.reset(seed=0)
    state = env.get_state()
    robot = state["worlds"]["start"][0, :2]
    state["worlds"]["goal"][0] = robot + 0.2
    env.set_state(state)
    monkeypatch.setattr("envs.navigation_batch.sample_goal", lambda *_: None)
    _, reward, terminated, truncated, info = env.step(np.zeros(2, np.float32))
    assert (terminated, truncated, info["goal_met"], info["reward_goal"]) == (
        True,
        False,
        True,
        1.0,
    )
    assert reward == pytest.approx(1.0, abs=1e-3)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, np.float32))


def test_unknown_and_bad_settings_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for settings, message in [
        ({"obstacle_siz": 0.2}, "no setting 'obstacle_siz'; settings: .*obstacle_size"),
        ({"obstacle_size": -1.0}, "obstacle_size must be positive"),
        ({"goal_keepout": 2.5}, "goal_keepout must be in"),
        ({"num_obstacles": 2.5}, "num_obstacles must be a positive integer"),
        ({"sleep": "yes"}, "sleep must be true or false"),
        ({"render_mode": "human"}, "render_mode"),
        ({"version": 7}, "no setting 'version'"),
    ]:
        with pytest.raises(ValueError, match=message):
            make_vec("Pillars-0.15-Goal", 2, **settings)
    monkeypatch.setattr("envs.layout.LAYOUT_ATTEMPTS", 5)
    crowded = make_vec("Pillars-0.15-Goal", 2, num_obstacles=50)
    with pytest.raises(LayoutError, match="50 obstacles"):
        crowded.reset(seed=0)


def test_every_task_is_one_frozen_dataclass() -> None:
    assert {f"{name}-v0" for name in NAVIGATION_TASKS} <= set(gymnasium.registry)
    with pytest.raises(AttributeError):
        NAVIGATION_TASKS["Pillars-0.15-Goal"].obstacle_size = 1.0  # type: ignore[misc]
    changed = NAVIGATION_TASKS["Pillars-0.15-Goal"].with_settings(num_obstacles=2)
    assert isinstance(changed, NavigationTask)
    assert gymnasium.make("Pillars-0.15-Goal-v0", num_obstacles=2).unwrapped.num_obstacles == 2


def test_training_imports_neither_opengl_nor_matplotlib() -> None:
    program = (
        "import sys, gymnasium, numpy, envs\n"
        "v = gymnasium.make_vec('Pillars-0.15-Goal-v0', num_envs=2, "
        "vectorization_mode='vector_entry_point')\n"
        "v.reset(seed=0); v.step(numpy.zeros((2, 2)))\n"
        "print([m for m in ('OpenGL', 'matplotlib', 'torch', 'safemr') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", REGISTERED_TASKS)
def test_the_first_scene_needs_no_simulator(name: str) -> None:
    """That of a task drawn from its layout alone is that of an episode's start."""
    env = gymnasium.make(f"{name}-v0").unwrapped
    env.reset(seed=3)
    drawn, simulated = first_scene(REGISTERED_TASKS[name], 3), env.scene()
    assert (drawn.task, drawn.box is None) == (simulated.task, simulated.box is None)
    for part in ("robot", "goal", "obstacles", "box", "vase"):
        ours, theirs = getattr(drawn, part), getattr(simulated, part)
        assert (ours is None) == (theirs is None)
        if ours is not None:
            np.testing.assert_allclose(ours[..., :2], theirs[..., :2], rtol=0, atol=1e-12)
            turned = ours[2:] - theirs[2:] if part in ("robot", "box", "vase") else 0.0
            np.testing.assert_allclose(np.cos(turned), 1.0, rtol=0, atol=1e-12)
