"""How learners meet a task: decisions of several control steps, scaled actions, decoded lidars."""

from __future__ import annotations

import copy
import functools
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from envs.navigation_kernels import _add_to_lidar
from safemr.errors import UserError
from safemr.experiment import planning
from safemr.learning.evaluation import play
from safemr.learning.interface import DecisionEnvs, Interface, held, interface_of
from safemr.learning.observation import ObservationTransform, decoded
from safemr.learning.policies import Policy
from safemr.tasks import make_envs

PUSH, GOAL = "Hazards-0.30-Push", "Pillars-0.15-Goal"
SUMS = ("cost", "cost_indicator", "cost_contact", "goal_met", "reward_approach", "reward_push")


def short(task: str, steps: int) -> dict[str, Any]:
    return {"name": task, "settings": {"max_episode_steps": steps}}


def by_hand(
    task: Any, seed: int, actions: NDArray[Any], repeat: int, decisions: int
) -> list[dict[str, Any]]:
    """One world of its own, action [decisions, A] held by a loop of single steps; until it ends."""
    envs = make_envs(task, 1)
    observation, infos = envs.reset(seed=seed)
    rows = []
    for action in actions[:decisions]:
        row = {"reward": 0.0, "control_steps": 0, **dict.fromkeys(SUMS, 0.0)}
        for _ in range(repeat):
            observation, reward, terminated, truncated, infos = envs.step(action[None])
            row["reward"] += reward[0]
            row["control_steps"] += 1
            for name in SUMS:
                row[name] += infos[name][0] if name in infos else 0.0
            row |= {"terminated": bool(terminated[0]), "truncated": bool(truncated[0])}
            if terminated[0] or truncated[0]:
                break
        over = row["terminated"] or row["truncated"]
        source = infos["final_info"] if over else infos
        row["reached"] = (infos["final_obs"] if over else observation)[0].copy()
        row |= {name: source[name][0].copy() for name in ("d", "d_dot")}
        row["next"] = observation[0].copy()
        rows.append(row)
        if over:
            break
    envs.close()
    return rows


@pytest.mark.parametrize(
    ("task", "repeat"),
    [(short(PUSH, 23), 5), (short(GOAL, 20), 5), (short(GOAL, 7), 10), ("Aircraft", 4)],
    ids=["push, 23 steps", "goal, 20 steps", "an episode within a decision", "early ends"],
)
def test_a_batch_of_decisions_is_each_world_by_hand(task: Any, repeat: int) -> None:
    """Bit for bit, over the first episode of each world, whenever it ends."""
    count, decisions = 6, 60
    envs = held(make_envs(task, count), repeat)
    size = int(np.prod(envs.single_action_space.shape))
    actions = np.random.default_rng(1).uniform(-1, 1, (decisions, count, size)).astype(np.float32)
    expected = [by_hand(task, 50 + i, actions[:, i], repeat, decisions) for i in range(count)]
    envs.reset(seed=50)
    ends = set()
    for t in range(max(map(len, expected))):
        observations, rewards, terminated, truncated, infos = envs.step(actions[t])
        for i in range(count):
            if t >= len(expected[i]):
                continue
            row = expected[i][t]
            over = row["terminated"] or row["truncated"]
            assert rewards[i] == row["reward"]
            assert (terminated[i], truncated[i]) == (row["terminated"], row["truncated"])
            assert infos["control_steps"][i] == row["control_steps"]
            for name in SUMS:
                assert infos[name][i] == row[name], name
            reached = infos["final_info"] if over else infos
            for name in ("d", "d_dot"):
                np.testing.assert_array_equal(reached[name][i], row[name])
            shown = infos["final_obs"] if over else observations
            np.testing.assert_array_equal(shown[i], row["reached"])
            if over:
                ends.add((t, row["control_steps"]))
    assert ends, "no episode ended: nothing was tested"
    envs.close()


def test_worlds_that_end_together_begin_like_worlds_alone() -> None:
    """Episodes of 23 steps and decisions of 5: the fifth has 3 steps, and none is lost."""
    task = short(PUSH, 23)
    envs = held(make_envs(task, 3), 5)
    alone = [held(make_envs(task, 1), 5) for _ in range(3)]
    envs.reset(seed=9)
    for i, one in enumerate(alone):
        one.reset(seed=9 + i)
    generator = np.random.default_rng(0)
    lengths = []
    for _ in range(20):
        actions = generator.uniform(-1, 1, (3, 2)).astype(np.float32)
        batch = envs.step(actions)
        for i, one in enumerate(alone):
            np.testing.assert_array_equal(batch[0][i], one.step(actions[i : i + 1])[0][0])
        lengths.append(batch[4]["control_steps"][0])
    assert lengths == [5, 5, 5, 5, 3] * 4


def test_a_world_that_ended_early_waits_and_begins_in_its_own_first_state() -> None:
    """After the decision no control step of the next episode has been spent on the old action."""
    envs = held(make_envs("Aircraft", 16), 8)
    envs.reset(seed=3)
    waited = 0
    for _ in range(30):
        actions = np.ones((16, 1), np.float32)
        *_, terminated, truncated, infos = envs.step(actions)
        early = (terminated | truncated) & (infos["control_steps"] < 8)
        waited += int(early.sum())
        state = envs.get_state()
        assert (np.asarray(state["steps"])[terminated | truncated] == 0).all()
    assert waited > 3


def test_each_violating_control_step_within_a_decision_counts() -> None:
    """Also where the decision ends outside the hazard."""
    envs = held(make_envs(PUSH, 8), 10)
    envs.reset(seed=0)
    generator, left = np.random.default_rng(2), 0
    for _ in range(300):
        if _ % 3 == 0:
            actions = generator.uniform(-1, 1, (8, 2)).astype(np.float32)
        infos = envs.step(actions)[-1]
        outside = (infos["d"] > envs.d_min).all(1)
        left += int((outside & (infos["cost_indicator"] > 0)).sum())
    assert left > 0


def test_the_default_leaves_the_environments_alone() -> None:
    envs = make_envs(GOAL, 1)
    assert Interface().around(envs) is envs
    assert Interface().entry() == {}
    assert interface_of(envs) == Interface()
    assert interface_of(Interface(5).around(envs)) == Interface(5)


def test_scaled_actions_are_clipped_first() -> None:
    interface = Interface(1, (0.05, 1.0))
    given = np.array([[2.0, -3.0], [0.5, 0.25]], np.float32)
    np.testing.assert_allclose(interface.scaled(given), [[0.05, -1.0], [0.025, 0.25]], rtol=1e-7)
    plain, wrapped = make_envs(GOAL, 2), interface.around(make_envs(GOAL, 2))
    assert isinstance(wrapped, DecisionEnvs)
    plain.reset(seed=0), wrapped.reset(seed=0)
    np.testing.assert_array_equal(plain.step(interface.scaled(given))[0], wrapped.step(given)[0])


# --- decoding ------------------------------------------------------------------------------------


@given(
    st.floats(-3, 3),
    st.floats(-3, 3),
    st.floats(-np.pi, np.pi),
    st.floats(-4, 4),
    st.floats(-4, 4),
)
def test_a_lidar_of_one_object_holds_its_bearing_and_distance(
    x: float, y: float, heading: float, ox: float, oy: float
) -> None:
    distance = np.hypot(ox - x, oy - y)
    if distance < 1e-3:
        return
    bins = np.zeros(16)
    pose = np.array([x, y, heading])
    _add_to_lidar(bins, pose, np.cos(heading), np.sin(heading), ox, oy, np.inf)
    bearing = np.arctan2(oy - y, ox - x) - heading
    expected = [np.cos(bearing), np.sin(bearing), distance - 1.0, np.exp(-distance)]
    np.testing.assert_allclose(decoded(bins), expected, atol=1e-9)


def test_a_decoded_transform_replaces_the_bins_in_their_place() -> None:
    envs = make_envs(PUSH, 4)
    layout = envs.observation_layout
    raw, _ = envs.reset(seed=0)
    names = ("box_lidar", "goal_lidar", "hazards_lidar")
    plain = ObservationTransform.for_layout(layout)
    transform = ObservationTransform.for_layout(layout, names)
    assert transform.dim == plain.dim - 3 * 12
    seen = transform(raw)
    assert seen.flags.f_contiguous
    at = 2  # after the accelerometer, which has two columns; sensors stand in alphabetical order
    np.testing.assert_allclose(seen[:, at : at + 4], decoded(raw[:, layout["box_lidar"]]), 1e-6)
    np.testing.assert_array_equal(seen[:, :at], plain(raw)[:, :at])
    np.testing.assert_array_equal(transform(raw[0]), seen[0])


# --- learners ------------------------------------------------------------------------------------

INTERFACE = {"action_repeat": 3, "action_scale": [0.05, 1.0], "decode": "single"}
SMALL = {
    "off_policy": {"num_envs": 4, "start_steps": 600, "batch_size": 32, "explore_share": 0.2},
    "on_policy": {"num_envs": 4, "epoch_steps": 1200},
}
# The oracle is looked for for seconds, and then it is feasible actor-critic.
LEFT_OUT = ("neural_safemr", "fac_oracle")
NAMES = [name for name in planning.algorithm_names() if name not in LEFT_OUT]


def trainer_of(name: str, task: Any, steps: int) -> Any:
    algorithm = planning.load_algorithm(name)
    interface = Interface.read(INTERFACE).fitted(make_envs(task, 1))

    def environments(count: int) -> Any:
        return interface.around(make_envs(task, count))

    config = algorithm.hyperparameters(**SMALL[algorithm.family])
    return algorithm.trainer(config, environments, 100, steps)


@functools.cache
def trained(name: str) -> Any:
    trainer = trainer_of(name, short(GOAL, 50), 6_000)
    return trainer, trainer.advance(3_000)


@pytest.mark.parametrize("name", NAMES)
def test_budgets_and_episodes_are_counted_in_control_steps(name: str) -> None:
    """Episodes of 50 steps: 16 decisions of 3 and one of 2."""
    trainer, metrics = trained(name)
    assert metrics["train_length"] == 50.0
    assert trainer.step >= 3_000
    assert trainer.step == trainer.envs.get_state()["steps"].sum() + 50 * 4 * (
        (trainer.step // 4) // 50
    )
    if trainer.family == "off_policy":
        decisions = trainer.replay.size * 4
        assert decisions == pytest.approx(trainer.step * 17 / 50, abs=4 * 17)
        assert trainer.agent.updates == pytest.approx((trainer.step - 600) * 17 / 50 / 8, abs=5)


@pytest.mark.parametrize("name", NAMES)
def test_a_resumed_run_continues_bit_for_bit(name: str) -> None:
    first, other = (trainer_of(name, short(GOAL, 50), 6_000) for _ in range(2))
    first.advance(2_000)
    other.load_state_dict(copy.deepcopy(first.state_dict()))  # a file holds no reference either
    for trainer in (first, other):
        trainer.advance(4_000)
    ours, theirs = first.policy.arrays(), other.policy.arrays()
    assert ours.keys() == theirs.keys()
    for key, array in ours.items():
        np.testing.assert_array_equal(array, theirs[key], err_msg=key)
    np.testing.assert_array_equal(
        first.envs.get_state()["worlds"]["qpos"], other.envs.get_state()["worlds"]["qpos"]
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_saved_policy_holds_scales_and_decodes(name: str) -> None:
    policy = trained(name)[0].policy
    again = Policy.from_arrays(policy.arrays())
    assert again.action_repeat == 3
    envs = make_envs(short(GOAL, 50), 8)
    observations, _ = envs.reset(seed=1)
    actions = policy.act(observations, deterministic=False, generator=torch.Generator())
    assert np.abs(actions[:, 0]).max() <= 0.05 < np.abs(actions[:, 1]).max()
    np.testing.assert_array_equal(policy.act(observations), again.act(observations))
    calls = []

    class Counted:
        action_repeat = again.action_repeat

        def act(self, observations: Any, deterministic: bool = True) -> Any:
            calls.append(1)
            return again.act(observations, deterministic)

    assert play(Counted(), envs, 1).pop()["length"] == 50.0
    assert len(calls) == 17
    with pytest.raises(UserError, match="trained on another task"):
        again.act(np.zeros((2, 3)))


def test_a_plain_policy_says_nothing_of_an_interface() -> None:
    algorithm = planning.load_algorithm("fac")
    config = algorithm.hyperparameters(num_envs=1)
    trainer = algorithm.trainer(config, functools.partial(make_envs, GOAL), 100, 10_000)
    names = trainer.policy.arrays().keys()
    assert not names & {"action_repeat", "action_scale", "lidars", "width"}


def test_extended_exploration_holds_and_fades() -> None:
    trainer = trainer_of("fac", short(GOAL, 50), 6_000)
    policy = torch.full((4, 2), 2.0)  # no random action looks like it
    drawn = []
    for _ in range(4_000):
        drawn.append((trainer._explore(policy) != policy).all(1).numpy())
    exploring = np.array(drawn)
    runs = [
        len(part)
        for column in exploring.T
        for part in np.split(column, np.flatnonzero(np.diff(column)) + 1)
        if part[0]
    ]
    config = trainer.config
    assert min(runs) >= config.explore_hold_min
    assert np.mean(runs) < 2 * config.explore_hold_max  # two may follow each other
    # p a decision that is free, 9 decisions each: 0.2 * 9 / (1 + 0.2 * 8)
    assert exploring.mean() == pytest.approx(0.2 * 9 / (1 + 0.2 * 8), abs=0.03)
    trainer.step = int(config.explore_until * 6_000)
    for _ in range(config.explore_hold_max):  # what has begun is finished
        trainer._explore(policy)
    assert all((trainer._explore(policy) == policy).all() for _ in range(100))
