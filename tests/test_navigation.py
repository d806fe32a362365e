"""The navigation environments: Gymnasium's contract, batches, autoreset, snapshots, bad input."""

from __future__ import annotations

import copy
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

import envs  # noqa: F401  (registers the tasks)
from envs.layout import LayoutError
from envs.tasks import NAVIGATION_TASKS, NavigationTask

TASKS = sorted(NAVIGATION_TASKS)
VARIANTS = [
    ("Pillars-0.15-Goal", {}),
    ("Pillars-0.30-Goal", {}),
    ("Hazards-0.15-Push", {}),
    ("Hazards-0.30-Push", {"sleep": True}),
]
INFO_KEYS = {
    *("cost", "cost_indicator", "cost_contact", "d", "d_dot", "goal_met", "diverged"),
    *("reward_approach", "reward_push", "reward_goal"),
}


def make_vec(name: str, num_envs: int, **settings: Any) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(
        f"{name}-v0", num_envs=num_envs, vectorization_mode="vector_entry_point", **settings
    )


def random_actions(steps: int, num_envs: int, seed: int = 0) -> NDArray[np.float32]:
    """Actions that go places: held for ten steps, small thrust, sometimes out of range."""
    rng = np.random.default_rng(seed)
    held = rng.uniform([-0.03, -0.8], [0.06, 0.8], (steps // 10 + 1, num_envs, 2))
    actions = np.repeat(held, 10, axis=0)[:steps]
    actions[rng.random((steps, num_envs)) < 0.1] *= 40
    return actions.astype(np.float32)


def assert_equal(first: Any, second: Any) -> None:
    """Bitwise equality of nested dictionaries of arrays and numbers."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_equal(first[key], second[key])
    else:
        np.testing.assert_array_equal(first, second)


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is.*infinity")
@pytest.mark.parametrize("name", TASKS)
def test_gymnasium_check(name: str) -> None:
    check_env(gymnasium.make(f"{name}-v0").unwrapped, skip_render_check=True)


@pytest.mark.parametrize("name", TASKS)
def test_attributes_and_info(name: str) -> None:
    scalar, vector = gymnasium.make(f"{name}-v0").unwrapped, make_vec(name, 2)
    size = float(name.split("-")[1])
    push = name.endswith("Push")
    for env in (scalar, vector):
        assert env.d_min == pytest.approx(size if push else size + 0.1)
        assert env.num_obstacles == (1 if push else 4)
        assert env.max_episode_steps == 1000
        assert env.task_version >= 1
        blocks = list(env.observation_layout.values())
        assert list(env.observation_layout) == sorted(env.observation_layout)
        assert [block.start for block in blocks[1:]] == [block.stop for block in blocks[:-1]]
        assert blocks[-1].stop == (76 if push else 44)
    observation, info = scalar.reset(seed=0)
    assert info.keys() == INFO_KEYS
    assert observation.shape == (76 if push else 44,)
    *_, info = scalar.step(scalar.action_space.sample())
    assert info.keys() == INFO_KEYS
    assert type(info["cost"]) is float
    assert type(info["goal_met"]) is bool
    assert info["d"].shape == info["d_dot"].shape == (scalar.num_obstacles,)
    _, infos = vector.reset(seed=0)
    assert infos.keys() == INFO_KEYS | {f"_{key}" for key in INFO_KEYS}
    *_, infos = vector.step(vector.action_space.sample())
    assert infos.keys() == INFO_KEYS | {f"_{key}" for key in INFO_KEYS}
    assert infos["d"].shape == (2, vector.num_obstacles)


@pytest.mark.parametrize(("name", "settings"), VARIANTS)
def test_a_batch_equals_scalar_environments(name: str, settings: dict[str, Any]) -> None:
    num_envs, steps = 3, 130
    settings = settings | {"max_episode_steps": 55}
    vector = make_vec(name, num_envs, **settings)
    scalars = [gymnasium.make(f"{name}-v0", **settings) for _ in range(num_envs)]
    observations, infos = vector.reset(seed=11)
    for i, env in enumerate(scalars):
        observation, info = env.reset(seed=11 + i)
        assert_equal(observation, observations[i])
        assert_equal(info, {key: infos[key][i] for key in info})
    for actions in random_actions(steps, num_envs):
        observations, rewards, terminated, truncated, infos = vector.step(actions)
        for i, env in enumerate(scalars):
            observation, reward, term, trunc, info = env.step(actions[i])
            assert (reward, term, trunc) == (rewards[i], terminated[i], truncated[i])
            source = infos
            if term or trunc:
                assert infos["_final_obs"][i]
                source = infos["final_info"]
                assert_equal(observation, infos["final_obs"][i])
                observation, fresh = env.reset()
                assert_equal(fresh["d"], infos["d"][i])
                assert_equal(fresh["d_dot"], infos["d_dot"][i])
            assert_equal(info, {key: source[key][i] for key in info})
            assert_equal(observation, observations[i])


def test_autoreset_hands_out_copies_and_tells_time_limit_from_termination() -> None:
    vector = make_vec("Pillars-0.15-Goal", 2, max_episode_steps=3)
    assert vector.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    vector.reset(seed=0)
    results = [vector.step(actions) for actions in random_actions(3, 2)]
    kept = copy.deepcopy(results)
    _, _, terminated, truncated, infos = results[-1]
    assert truncated.all()
    assert not terminated.any()
    assert not any("final_obs" in result[4] for result in results[:-1])
    assert infos["final_obs"].dtype == np.float64
    assert infos["final_info"].keys() == INFO_KEYS | {f"_{key}" for key in INFO_KEYS}
    assert not np.array_equal(infos["final_obs"], results[-1][0])
    for actions in random_actions(5, 2, seed=1):
        vector.step(actions)
    for before, after in zip(kept, results, strict=True):
        for old, new in zip(before, after, strict=True):
            assert_equal(old, new)


@pytest.mark.parametrize(("name", "settings"), VARIANTS)
@pytest.mark.parametrize("warm_up", [3, 90])
def test_a_restored_snapshot_continues_bit_for_bit(
    name: str, settings: dict[str, Any], warm_up: int
) -> None:
    actions = random_actions(warm_up + 60, 3)
    vector = make_vec(name, 3, max_episode_steps=120, **settings)
    vector.reset(seed=5)
    for step in actions[:warm_up]:
        vector.step(step)
    snapshot = copy.deepcopy(vector.get_state())
    expected = [vector.step(step) for step in actions[warm_up:]]
    restored = make_vec(name, 3, max_episode_steps=120, **settings)
    for target in (vector, restored):
        target.set_state(snapshot)
        assert_equal(target.get_state(), snapshot)
        for step, old in zip(actions[warm_up:], expected, strict=True):
            for a, b in zip(old, target.step(step), strict=True):
                assert_equal(a, b)


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


def test_snapshots_hold_plain_types_only() -> None:
    def leaves(value: Any) -> list[Any]:
        return (
            [x for v in value.values() for x in leaves(v)] if isinstance(value, dict) else [value]
        )

    state = make_vec("Hazards-0.15-Push", 2).get_state()
    assert {type(leaf) for leaf in leaves(state)} <= {np.ndarray, int, float, str, bool}


def test_a_foreign_snapshot_is_refused() -> None:
    state = make_vec("Pillars-0.15-Goal", 2).get_state()
    with pytest.raises(ValueError, match=r"state 'start'.*\(3, 3\)"):
        make_vec("Pillars-0.15-Goal", 3).set_state(state)
    with pytest.raises(ValueError, match="obstacles"):
        make_vec("Hazards-0.15-Push", 2).set_state(state)


@pytest.mark.parametrize("name", TASKS)
def test_seeding(name: str) -> None:
    vector = make_vec(name, 3)
    first, _ = vector.reset(seed=3)
    unseeded, _ = vector.reset()
    again, _ = vector.reset(seed=3)
    listed, _ = vector.reset(seed=[4, None, 3])
    assert_equal(first, again)
    assert not np.array_equal(first, unseeded)
    assert_equal(listed[[2, 0]], first[[0, 1]])
    with pytest.raises(ValueError, match="2 seeds for 3"):
        vector.reset(seed=[1, 2])


BAD_ACTIONS = [
    (np.array([np.nan, 0.0]), "must be finite"),
    (np.array([0.0, np.inf]), "must be finite"),
    (np.zeros(3), "shape"),
    (np.zeros((1, 2)), "shape"),
    (np.float32(0.0), "shape"),
    (np.array(["a", "b"]), "real numbers"),
    (np.array([1j, 0]), "real numbers"),
    (np.array([None, 0]), "real numbers"),
]


@pytest.mark.parametrize(("action", "message"), BAD_ACTIONS)
def test_bad_actions_are_named_and_change_nothing(action: Any, message: str) -> None:
    env = gymnasium.make("Pillars-0.15-Goal-v0", disable_env_checker=True).unwrapped
    env.reset(seed=0)
    before = env.get_state()
    with pytest.raises(ValueError, match=f"Pillars-0.15-Goal.*{message}"):
        env.step(action)
    assert_equal(env.get_state(), before)


def test_a_bad_action_in_a_batch_names_its_environment() -> None:
    vector = make_vec("Pillars-0.15-Goal", 3)
    vector.reset(seed=0)
    actions = np.zeros((3, 2))
    actions[1, 1] = np.nan
    with pytest.raises(ValueError, match="environment 1"):
        vector.step(actions)


def test_actions_out_of_range_are_clipped() -> None:
    results = []
    for action in ([7.0, -3.0], [1.0, -1.0]):
        env = gymnasium.make("Hazards-0.15-Push-v0", disable_env_checker=True)
        env.reset(seed=0)
        results.append([env.step(np.array(action))[0] for _ in range(20)])
    assert_equal(*results)


def test_stepping_needs_a_reset() -> None:
    env = gymnasium.make("Pillars-0.15-Goal-v0").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, np.float32))
    vector = make_vec("Pillars-0.15-Goal", 2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        vector.step(np.zeros((2, 2)))


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
