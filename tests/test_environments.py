"""The contract of every registered environment, scalar and batched (envs/contract.py)."""

from __future__ import annotations

import copy
import gc
import inspect
import pickle
import subprocess
import sys
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

import envs  # noqa: F401  (registers the tasks)
from envs import aircraft, navigation, rendering
from safemr.experiment.planning import describe_task
from safemr.experiment.train import make_envs

IDS = sorted(
    spec.id for spec in gymnasium.registry.values() if str(spec.entry_point).startswith("envs.")
)
VARIANTS: list[tuple[str, dict[str, Any]]] = [
    *((name, {}) for name in IDS),
    ("Hazards-0.30-Push-v0", {"sleep": True}),
    ("PointGoal1-v0", {"sleep": True}),
    ("Aircraft-v0", {"other_turn": 0.5}),
]
KINDS = ["scalar", "batch"]
INFO_KEYS = {"cost", "cost_indicator", "cost_contact", "d", "d_dot"}
GOAL_KEYS = {"goal_met", "reward_approach", "reward_push", "reward_goal"}

every_id = pytest.mark.parametrize("name", IDS)
every_variant = pytest.mark.parametrize(("name", "settings"), VARIANTS)
every_kind = pytest.mark.parametrize("kind", KINDS)


def make_batch(name: str, num_envs: int = 3, **settings: Any) -> Any:
    return gymnasium.make_vec(
        name, num_envs=num_envs, vectorization_mode="vector_entry_point", **settings
    )


def make_scalar(name: str, **settings: Any) -> Any:
    """An environment with a clock of its own."""
    if name == "Aircraft-v0":
        return aircraft.AircraftEnv(**settings)
    return navigation.NavigationEnv(name.removesuffix("-v0"), **settings)


def make(name: str, kind: str, **settings: Any) -> Any:
    return make_scalar(name, **settings) if kind == "scalar" else make_batch(name, **settings)


def label(name: str) -> str:
    return name.removesuffix("-v0")


def random_actions(name: str, steps: int, num_envs: int = 3, seed: int = 0) -> NDArray[np.float32]:
    """[steps, N, A] that go places: held for ten steps, sometimes far out of range."""
    rng = np.random.default_rng(seed)
    low, high = ([-1.0], [1.0]) if name == "Aircraft-v0" else ([-0.03, -0.8], [0.06, 0.8])
    held = rng.uniform(low, high, (steps // 10 + 1, num_envs, len(low)))
    actions = np.repeat(held, 10, axis=0)[:steps]
    actions[rng.random((steps, num_envs)) < 0.1] *= 40
    return actions.astype(np.float32)


def restful(env: Any, name: str) -> tuple[dict[str, Any] | None, NDArray[np.float32]]:
    """Reset options and an action with which no episode terminates."""
    shape = env.action_space.shape
    if name != "Aircraft-v0":
        return None, np.zeros(shape, np.float32)
    state = np.tile([5.5, 0.0, 0.0], (*shape[:-1], 1)).astype(float)  # parallel flight
    return {"state": state}, np.ones(shape, np.float32)


def assert_equal(first: Any, second: Any) -> None:
    """Bitwise equality of nested containers of arrays and numbers."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        for key in first:
            assert_equal(first[key], second[key])
    elif isinstance(first, list | tuple):
        assert len(first) == len(second)
        for one, other in zip(first, second, strict=True):
            assert_equal(one, other)
    else:
        np.testing.assert_array_equal(first, second)


def run(env: Any, actions: NDArray[np.float32]) -> list[Any]:
    """What the steps return; a scalar environment takes the actions of the first world."""
    results = []
    for action in actions:
        scalar = isinstance(env, gymnasium.Env)
        results.append(env.step(action[0] if scalar else action))
        if scalar and (results[-1][2] or results[-1][3]):
            results.append(env.reset())
    return results


# --- Gymnasium's interface ------------------------------------------------------------------------


def test_all_six_are_registered() -> None:
    assert len(IDS) == 6


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is.*infinity")
@every_id
def test_gymnasium_check(name: str) -> None:
    opengl = name != "Aircraft-v0"
    env = gymnasium.make(name, render_mode=None if opengl else "rgb_array")
    check_env(env.unwrapped, skip_render_check=opengl)


@every_id
def test_spaces_and_infos(name: str) -> None:
    scalar, batch = make_scalar(name), make_batch(name)
    assert scalar.observation_space.dtype == batch.observation_space.dtype == np.float64
    assert scalar.action_space.dtype == batch.action_space.dtype == np.float32
    assert batch.single_observation_space == scalar.observation_space
    assert batch.single_action_space == scalar.action_space
    observation, info = scalar.reset(seed=0)
    observations, infos = batch.reset(seed=0)
    for action in random_actions(name, 60):
        assert scalar.observation_space.contains(observation)
        assert batch.observation_space.contains(observations)
        keys = set(info)
        assert keys - {"diverged"} == INFO_KEYS | (set() if name == "Aircraft-v0" else GOAL_KEYS)
        assert {key for key in infos if not key.startswith("_final")} - {
            "final_obs",
            "final_info",
        } == keys | {f"_{key}" for key in keys}
        assert type(info["cost"]) is float
        assert type(info.get("goal_met", False)) is bool
        assert info["d"].shape == info["d_dot"].shape == (scalar.num_obstacles,)
        assert infos["d"].shape == (3, batch.num_obstacles)
        observation, reward, terminated, truncated, info = scalar.step(action[0])
        assert type(reward) is float
        assert type(terminated) is type(truncated) is bool
        observations, *_, infos = batch.step(action)
        if terminated or truncated:
            observation, info = scalar.reset()


@every_id
@every_kind
def test_attributes_that_the_learners_read(name: str, kind: str) -> None:
    env = make(name, kind)
    assert env.d_min > 0
    assert env.num_obstacles >= 1
    assert type(env.task_version) is int
    assert env.max_episode_steps == gymnasium.spec(name).max_episode_steps
    assert "max_episode_steps" in env.setting_names
    blocks = list(env.observation_layout.values())
    assert [block.start for block in blocks] == [0, *(block.stop for block in blocks[:-1])]
    assert blocks[-1].stop == env.observation_space.shape[-1]


@every_variant
def test_a_batch_equals_scalar_environments(name: str, settings: dict[str, Any]) -> None:
    num_envs, steps, settings = 3, 130, settings | {"max_episode_steps": 55}
    batch = make_batch(name, num_envs, **settings)
    scalars = [gymnasium.make(name, **settings) for _ in range(num_envs)]
    observations, infos = batch.reset(seed=11)
    for i, env in enumerate(scalars):
        observation, info = env.reset(seed=11 + i)
        assert_equal(observation, observations[i])
        assert_equal(info, {key: infos[key][i] for key in info})
    ended = 0
    for actions in random_actions(name, steps, num_envs):
        observations, rewards, terminated, truncated, infos = batch.step(actions)
        for i, env in enumerate(scalars):
            observation, reward, term, trunc, info = env.step(actions[i])
            assert (reward, term, trunc) == (rewards[i], terminated[i], truncated[i])
            source = infos
            if term or trunc:
                ended += 1
                assert infos["_final_obs"][i]
                assert infos["_final_info"][i]
                source = infos["final_info"]
                assert_equal(observation, infos["final_obs"][i])
                observation, fresh = env.reset()
                assert_equal(fresh["d"], infos["d"][i])
                assert_equal(fresh["d_dot"], infos["d_dot"][i])
            assert_equal(info, {key: source[key][i] for key in info})
            assert_equal(observation, observations[i])
    assert ended >= 2 * num_envs


@every_id
def test_autoreset_hands_out_copies(name: str) -> None:
    batch = make_batch(name, 2, max_episode_steps=3)
    assert batch.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.SAME_STEP
    options, action = restful(batch, name)
    batch.reset(seed=0, options=options)
    results = [batch.step(action) for _ in range(3)]
    kept = copy.deepcopy(results)
    observation, _, terminated, truncated, infos = results[-1]
    assert truncated.all()
    assert not terminated.any()
    assert not any("final_obs" in result[4] for result in results[:-1])
    assert infos["final_obs"].dtype == np.float64
    assert infos["final_info"].keys() == results[0][4].keys()
    assert not np.array_equal(infos["final_obs"], observation)
    run(batch, random_actions(name, 5, 2, seed=1))
    assert_equal(kept, results)


# --- seeds and options of a reset -----------------------------------------------------------------


@every_id
def test_seeding(name: str) -> None:
    batch, scalar = make_batch(name), make_scalar(name)
    first, _ = batch.reset(seed=3)
    unseeded, _ = batch.reset()
    again, _ = batch.reset(seed=3)
    assert_equal(first, again)
    assert not np.array_equal(first, unseeded)
    for seeds in ([4, None, 3], (4, None, np.int64(3))):
        batch.reset(seed=3)
        listed, _ = batch.reset(seed=seeds)
        assert_equal(listed[[2, 0]], first[[0, 1]])
        assert_equal(listed[1], unseeded[1])  # None: the world's own generator goes on
    assert_equal(batch.reset(seed=np.array([3, 4, 5]))[0], first)
    assert_equal(scalar.reset(seed=np.int64(3))[0], first[0])
    assert_equal(scalar.reset()[0], unseeded[0])


@every_id
def test_bad_seeds_are_named_and_change_nothing(name: str) -> None:
    for kind, bad in [
        *(("scalar", seed) for seed in (-1, 1.5, "7", True, [1], [1, 2, 3])),
        *(("batch", seed) for seed in (-1, 1.5, "123", True, {1, 2, 3}, np.zeros((3, 1), int))),
        *(("batch", seed) for seed in ([1, 2, -3], [1, 2, "3"], [1, 2, 3.0], [1, None, False])),
    ]:
        env = make(name, kind)
        env.reset(seed=0)
        before = env.get_state()
        with pytest.raises(ValueError, match=f"{label(name)}: a seed must be None or an integer"):
            env.reset(seed=bad)
        assert_equal(env.get_state(), before)
    with pytest.raises(ValueError, match=f"{label(name)}: 2 seeds for 3 environments"):
        env.reset(seed=[1, 2])


@every_id
@every_kind
def test_unknown_options_are_named_and_change_nothing(name: str, kind: str) -> None:
    env = make(name, kind)
    env.reset(seed=0)
    before = env.get_state()
    known = "reset_mask" if kind == "batch" else "none"
    if name == "Aircraft-v0":
        known = "state" if kind == "scalar" else "state, reset_mask"
    for key in ("reset_maks", "seed", *(["reset_mask"] if kind == "scalar" else [])):
        message = f"{label(name)}: reset has no option '{key}'; options: {known}$"
        with pytest.raises(ValueError, match=message):
            env.reset(seed=1, options={key: np.ones(3, bool)})
    with pytest.raises(ValueError, match="must be a dictionary"):
        env.reset(seed=1, options=["reset_mask"])
    assert_equal(env.get_state(), before)
    env.reset(options={})


@every_id
def test_reset_mask_starts_only_the_worlds_where_it_is_true(name: str) -> None:
    actions = random_actions(name, 12)
    masked, reference = make_batch(name), make_batch(name)
    for batch in (masked, reference):
        batch.reset(seed=5)
        last = run(batch, actions[:6])[-1]
    mask = np.array([False, True, False])
    options = {"reset_mask": mask}
    observations, infos = masked.reset(seed=[80, 90, 100], options=options)
    assert options == {"reset_mask": mask}
    fresh, fresh_info = make_scalar(name).reset(seed=90)
    assert_equal(observations[1], fresh)
    assert_equal(infos["d"][1], fresh_info["d"])
    assert_equal(observations[[0, 2]], last[0][[0, 2]])
    assert_equal(infos["d"][[0, 2]], last[4]["d"][[0, 2]])
    for key in infos:
        if key.startswith("_"):
            assert_equal(infos[key], mask)
    expected = run(reference, actions[6:])
    for result, other in zip(run(masked, actions[6:]), expected, strict=True):
        for one, another in zip(result[:4], other[:4], strict=True):
            assert_equal(one[[0, 2]], another[[0, 2]])
    assert masked.get_state()["steps"].tolist() == [12, 6, 12] or name == "Aircraft-v0"


@every_id
def test_a_bad_reset_mask_is_named_and_changes_nothing(name: str) -> None:
    batch = make_batch(name)
    some = np.array([True, False, True])
    with pytest.raises(ResetNeeded, match=f"{label(name)}: the first reset must start every"):
        batch.reset(options={"reset_mask": some})
    batch.reset(seed=0, options={"reset_mask": np.ones(3, bool)})
    before = batch.get_state()
    for mask, message in [
        (some.tolist(), "bool array"),
        (some.astype(int), "int64"),
        (some[:2], r"\(2,\)"),
        (np.zeros(3, bool), "true nowhere"),
    ]:
        with pytest.raises(ValueError, match=f"{label(name)}: reset_mask .*{message}"):
            batch.reset(seed=1, options={"reset_mask": mask})
        assert_equal(batch.get_state(), before)


def test_the_aircraft_start_where_they_are_put() -> None:
    batch = make_batch("Aircraft-v0")
    batch.reset(seed=0)
    states = np.array([[9.0, 1.0, 2.0], [np.nan] * 3, [8.0, 0.0, 1.0]])
    before = batch.get_state()["states"]
    batch.reset(options={"state": states, "reset_mask": np.array([True, False, True])})
    expected = np.array([states[0], before[1], states[2]])
    assert_equal(batch.get_state()["states"], expected)
    for bad in (states, states[:2], "here", [[1, 2, 3], [4, 5], 6]):
        with pytest.raises(ValueError, match="Aircraft: options\\['state'\\] must be 3 finite"):
            batch.reset(options={"state": bad})


# --- one clock ------------------------------------------------------------------------------------


def cheap(name: str) -> dict[str, Any]:
    """Settings for episodes at full length: a box at rest costs nothing while it sleeps."""
    return {"sleep": True} if "Push" in name or "PointGoal" in name else {}


def steps_until_truncated(env: Any, name: str, most: int = 1050) -> int | None:
    options, action = restful(env, name)
    env.reset(seed=0, options=options)
    for step in range(1, most + 1):
        _, _, terminated, truncated, _ = env.step(action)
        assert not np.any(terminated)
        if np.all(truncated):
            return step
        assert not np.any(truncated)
    return None


@every_id
@pytest.mark.parametrize("asked", ["registered", 7, 1010])
def test_spec_wrapper_and_what_happens_agree(name: str, asked: Any) -> None:
    settings = cheap(name)
    settings |= {} if asked == "registered" else {"max_episode_steps": asked}
    limit = asked if isinstance(asked, int) else gymnasium.spec(name).max_episode_steps
    assert limit is not None
    scalar = gymnasium.make(name, **settings)
    assert scalar.unwrapped.max_episode_steps is None  # TimeLimit alone keeps the time
    batch, direct = make_batch(name, 2, **settings), make_scalar(name, **settings)
    assert batch.max_episode_steps == direct.max_episode_steps == limit
    for env in (scalar, batch, gymnasium.make(scalar.spec), gymnasium.make_vec(batch.spec)):
        assert env.spec.max_episode_steps == limit
    for env in (scalar, batch):
        assert steps_until_truncated(env, name) == limit
    assert steps_until_truncated(direct, name) == limit
    with pytest.raises(ResetNeeded):
        direct.step(direct.action_space.sample())


@every_id
def test_none_stands_for_the_registered_limit(name: str) -> None:
    limit = gymnasium.spec(name).max_episode_steps
    assert gymnasium.make(name, max_episode_steps=None).spec.max_episode_steps == limit
    for kind in KINDS:
        assert make(name, kind, max_episode_steps=None).max_episode_steps == limit


@every_id
def test_minus_one_means_no_limit_for_gymnasium_make(name: str) -> None:
    env = gymnasium.make(name, max_episode_steps=-1, **cheap(name))
    assert env.spec.max_episode_steps is env.unwrapped.max_episode_steps is None
    assert steps_until_truncated(env, name) is None


@every_id
def test_synchronous_batches_keep_the_same_time(name: str) -> None:
    batch = gymnasium.make_vec(name, 2, vectorization_mode="sync", max_episode_steps=9)
    batch.reset(seed=0)
    options, action = restful(batch, name)
    if options is None:
        assert steps_until_truncated(batch, name) == 9
    else:  # Gymnasium gives every environment the same options
        batch.reset(options={"state": options["state"][0]})
        assert [bool(batch.step(action)[3].all()) for _ in range(9)] == [False] * 8 + [True]


@every_id
@every_kind
def test_bad_limits_and_sizes_are_named(name: str, kind: str) -> None:
    for limit in (0, -1, 2.5, "7", True):
        with pytest.raises(ValueError, match=f"{label(name)}: max_episode_steps .*{limit!r}"):
            make(name, kind, max_episode_steps=limit)
    for size in (0, -1, 2.5, True):
        with pytest.raises(ValueError, match=f"{label(name)}: num_envs .*{size!r}"):
            make_batch(name, size)


@every_id
def test_two_clocks_are_refused(name: str) -> None:
    spec = copy.deepcopy(gymnasium.spec(name))
    spec.kwargs["max_episode_steps"] = 50
    with pytest.raises(ValueError, match=f"{label(name)}: give max_episode_steps to gymnasium"):
        gymnasium.make(spec)


@every_id
def test_the_limit_is_a_setting_of_a_run(name: str) -> None:
    task = describe_task(label(name), {"max_episode_steps": 12})
    assert task["settings"] == {"max_episode_steps": 12}
    assert steps_until_truncated(make_envs(task, 2), name) == 12


# --- steps ----------------------------------------------------------------------------------------

BAD_ACTIONS = [
    (lambda good: good * np.nan, "finite"),
    (lambda good: good + np.inf, "finite"),
    (lambda good: good[..., :0], "shape"),
    (lambda good: np.concatenate([good, good], -1), "shape"),
    (lambda good: good[None], "shape"),
    (lambda good: np.float32(0.0), "shape"),
    (lambda good: np.full(good.shape, "a"), "real numbers"),
    (lambda good: good + 1j, "real numbers"),
    (lambda good: np.full(good.shape, None), "real numbers"),
    (lambda good: good > 0, "real numbers"),
]


@every_id
@every_kind
def test_bad_actions_are_named_and_change_nothing(name: str, kind: str) -> None:
    env = make(name, kind)
    env.reset(seed=0)
    before = env.get_state()
    good = np.full(env.action_space.shape, 0.5, np.float32)
    for make_bad, message in BAD_ACTIONS:
        with pytest.raises(ValueError, match=f"{label(name)}.*{message}"):
            env.step(make_bad(good))
        assert_equal(env.get_state(), before)
    if kind == "batch":
        good[1, -1] = np.nan
        with pytest.raises(ValueError, match=r"nan.* (environment|encounter) 1|environment 1.*nan"):
            env.step(good)


@every_id
def test_actions_out_of_range_are_clipped(name: str) -> None:
    results = []
    for factor in (1.0, 7.0):
        env = make_scalar(name)
        env.reset(seed=0)
        actions = np.full((20, 1, *env.action_space.shape), -1.0, np.float32)
        results.append(run(env, factor * actions))
    assert_equal(*results)


@every_id
@every_kind
def test_a_step_belongs_to_an_episode(name: str, kind: str) -> None:
    env = make(name, kind, max_episode_steps=4)
    options, action = restful(env, name)
    with pytest.raises(ResetNeeded, match=label(name)):
        env.step(action)
    env.reset(options=options)
    for _ in range(4):
        env.step(action)
    if kind == "scalar":
        snapshot = env.get_state()
        for other in (env, copy.deepcopy(env), make(name, kind)):
            other.set_state(snapshot)
            with pytest.raises(ResetNeeded, match=label(name)):
                other.step(action)
    else:
        env.step(action)  # it was reset within the step before
    env.reset()
    env.step(action)


@every_id
@every_kind
def test_a_closed_environment_says_so(name: str, kind: str) -> None:
    env = make(name, kind)
    env.reset(seed=0)
    snapshot = env.get_state()
    env.close()
    env.close()
    env.set_state(snapshot)
    with pytest.raises(ClosedEnvironmentError, match=label(name)):
        env.step(env.action_space.sample())
    with pytest.raises(ClosedEnvironmentError, match=label(name)):
        env.reset()


@pytest.mark.filterwarnings("error::pytest.PytestUnraisableExceptionWarning")
@every_id
@every_kind
def test_a_failed_construction_leaves_nothing_to_close(name: str, kind: str) -> None:
    for settings in ({"max_episode_steps": 0}, {"render_mode": "human"}):
        with pytest.raises(ValueError, match=label(name)):
            make(name, kind, **settings)
        gc.collect()


# --- snapshots and copies -------------------------------------------------------------------------


@every_variant
@every_kind
@pytest.mark.parametrize("warm_up", [3, 90])
def test_a_restored_snapshot_continues_bit_for_bit(
    name: str, settings: dict[str, Any], kind: str, warm_up: int
) -> None:
    actions = random_actions(name, warm_up + 40)
    env = make(name, kind, max_episode_steps=120, **settings)
    env.reset(seed=5)
    run(env, actions[:warm_up])
    snapshot = copy.deepcopy(env.get_state())
    expected = run(env, actions[warm_up:])
    for target in (env, make(name, kind, max_episode_steps=120, **settings)):
        target.set_state(snapshot)
        assert_equal(target.get_state(), snapshot)
        assert_equal(run(target, actions[warm_up:]), expected)


@every_id
@every_kind
def test_snapshots_hold_plain_types_and_fit_only_their_task(name: str, kind: str) -> None:
    def leaves(value: Any) -> list[Any]:
        if isinstance(value, dict):
            return [leaf for one in value.values() for leaf in leaves(one)]
        return [value]

    state = make(name, kind).get_state()
    assert {type(leaf) for leaf in leaves(state)} <= {np.ndarray, int, float, str, bool}
    others = {"Aircraft-v0", "Pillars-0.15-Goal-v0", "PointGoal1-v0", "Hazards-0.15-Push-v0"}
    for other in sorted(others - {name}):
        if label(name).split("-")[0] != label(other).split("-")[0]:
            with pytest.raises(ValueError, match=label(other)):
                make(other, kind).set_state(state)
    with pytest.raises(ValueError, match=label(name)):
        make_batch(name, 2).set_state(state)


def busy(name: str, kind: str, settings: dict[str, Any]) -> Any:
    """An environment in mid-episode, with an episode or more behind it."""
    settings = settings | {"max_episode_steps": 67}
    # A scalar environment comes with all of Gymnasium's wrappers.
    env = make_batch(name, **settings) if kind == "batch" else gymnasium.make(name, **settings)
    env.reset(seed=5)
    run(env, random_actions(name, 90))
    return env


WAYS = {
    # Gymnasium's wrappers share what they wrap when they are copied; what they wrap does not.
    "copy": lambda env: copy.copy(env.unwrapped),
    "deepcopy": copy.deepcopy,
    "pickle": lambda env: pickle.loads(pickle.dumps(env)),
}


@every_variant
@every_kind
def test_copies_are_independent_and_equal(name: str, settings: dict[str, Any], kind: str) -> None:
    actions = random_actions(name, 40, seed=1)
    expected = run(busy(name, kind, settings), actions)
    original = busy(name, kind, settings)
    before = original.unwrapped.get_state()
    orphans = [way(original) for way in WAYS.values()]
    for way in WAYS.values():
        other = way(original)
        assert_equal(other.unwrapped.get_state(), before)
        assert_equal(run(other, actions), expected)
        assert_equal(original.unwrapped.get_state(), before)
    assert_equal(run(original, actions), expected)
    del original, other
    gc.collect()
    for orphan in orphans:
        assert_equal(orphan.unwrapped.get_state(), before)
        assert_equal(run(orphan, actions), expected)


@every_id
@every_kind
def test_a_copy_of_what_was_never_reset_or_has_ended_is_the_same(name: str, kind: str) -> None:
    env = make(name, kind)
    fresh = copy.deepcopy(env)
    with pytest.raises(ResetNeeded):
        fresh.step(fresh.action_space.sample())
    assert_equal(fresh.reset(seed=2), env.reset(seed=2))
    env.close()
    with pytest.raises(ClosedEnvironmentError):
        copy.deepcopy(env).reset()


CONTINUE = f"""
from __future__ import annotations
import pickle, sys
import gymnasium
from typing import Any
from numpy.typing import NDArray
import numpy as np
{inspect.getsource(run)}
jobs = pickle.load(sys.stdin.buffer)
pickle.dump([run(env, actions) for env, actions in jobs], sys.stdout.buffer)
"""


def test_pickles_continue_in_another_process() -> None:
    jobs, expected = [], []
    for name, settings in VARIANTS:
        for kind in KINDS:
            env, actions = busy(name, kind, settings), random_actions(name, 40, seed=1)
            jobs.append((env, actions))
    done = subprocess.run(
        [sys.executable, "-c", CONTINUE],
        input=pickle.dumps(jobs),
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr.decode()
    for env, actions in jobs:
        expected.append(run(env, actions))
    assert_equal(pickle.loads(done.stdout), expected)


def test_copies_remember_contacts_and_sleep() -> None:
    """The states in which a copy is least likely to go on as the original."""
    pillars = make_batch("Pillars-0.30-Goal-v0", 8)
    pillars.reset(seed=0)
    forward = np.tile(np.array([0.06, 0.0], np.float32), (200, 8, 1))
    touched = 0.0
    for action in forward:
        *_, infos = pillars.step(action)
        touched += infos["cost_contact"].sum()
        if infos["cost_contact"].any():
            break
    assert touched > 0
    push = make_batch("Hazards-0.15-Push-v0", 8, sleep=True)
    push.reset(seed=0)
    for _ in range(40):
        push.step(np.zeros((8, 2)))
    assert (push.get_state()["worlds"]["asleep"].max(axis=1) >= 0).all()
    for env in (pillars, push):
        copies = [way(env) for way in WAYS.values()]
        expected = run(env, forward[:60])
        for other in copies:
            assert_equal(run(other, forward[:60]), expected)


# --- pictures -------------------------------------------------------------------------------------


@every_id
@every_kind
def test_render_modes_are_what_the_metadata_say(name: str, kind: str) -> None:
    env = make(name, kind)
    assert env.metadata["render_modes"] == ["rgb_array"]
    assert env.metadata["render_fps"] > 0
    env.reset(seed=0)
    assert env.render() is None
    with pytest.raises(ValueError, match=f"{label(name)}: render_mode must be None or 'rgb_array'"):
        make(name, kind, render_mode="human")
    shown = make(name, kind, render_mode="rgb_array")
    assert shown.render_mode == "rgb_array"
    with pytest.raises(ResetNeeded):
        shown.render()


class Camera:
    """Stands in for mujoco.Renderer; its frame is where things stand."""

    opened = 0

    def __init__(self, model: Any) -> None:
        Camera.opened += 1

    def update_scene(self, data: Any, camera: str) -> None:
        self.positions = data.geom_xpos.copy()

    def render(self) -> NDArray[np.float64]:
        return self.positions

    def close(self) -> None:
        pass

    def __reduce__(self) -> Any:
        raise AssertionError("an OpenGL context cannot be copied")


@every_id
def test_frames_of_a_batch_are_those_of_scalar_environments(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rendering, "_open", Camera)
    batch = make_batch(name, 3, render_mode="rgb_array")
    batch.reset(seed=4)
    run(batch, random_actions(name, 15))
    scalars = [make_scalar(name, render_mode="rgb_array") for _ in range(3)]
    for i, env in enumerate(scalars):
        env.reset(seed=4 + i)
        run(env, random_actions(name, 15)[:, i:])
    Camera.opened = 0
    for _ in range(2):
        before = batch.get_state()
        frames = batch.render()
        assert_equal(batch.get_state(), before)
        assert_equal(list(frames), [env.render() for env in scalars])
    assert not np.array_equal(frames[0], frames[1])
    assert Camera.opened == (0 if name == "Aircraft-v0" else 1 + len(scalars))
    for env in (batch, scalars[0]):
        for way in WAYS.values():
            assert_equal(way(env).render(), env.render())


def test_a_frame_shows_the_present_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    """A goal that was met has moved since MuJoCo computed where things stand."""
    monkeypatch.setattr(rendering, "_open", Camera)
    env = make_scalar("Pillars-0.15-Goal-v0", render_mode="rgb_array")
    env.reset(seed=0)
    state = env.get_state()
    state["worlds"]["goal"][0] = state["worlds"]["start"][0, :2] + 0.2
    env.set_state(state)
    *_, info = env.step(np.zeros(2, np.float32))
    assert info["goal_met"]
    shown = env.render()[:, :2]
    assert (np.abs(shown - env.scene().goal) < 1e-9).all(axis=1).any()


def test_other_turn_is_a_number() -> None:
    for bad in ("1.0", True, None, [1.0], np.nan):
        for kind in KINDS:
            with pytest.raises(ValueError, match="other_turn"):
                make("Aircraft-v0", kind, other_turn=bad)
