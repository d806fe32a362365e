"""Environments from outside: what a learner meets is what the environment said, or one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

import safemr
from safemr import cli, foreign_check
from safemr.certificates import energy
from safemr.environments import check_envs
from safemr.errors import UserError
from safemr.experiment import config, planning
from safemr.experiment.record import Record
from safemr.experiment.task_entries import ForeignTask
from safemr.foreign import FAR
from safemr.learning.interface import held
from safemr.learning.normalisation import LARGEST, SETTLED, Normaliser
from safemr.learning.observation import ObservationTransform
from safemr.learning.policies import Policy
from safemr.measure.evaluate import evaluate_record
from safemr.tasks import make_envs
from tests.foreign_worlds import EPISODE

ROOT = Path(__file__).resolve().parents[1]
MODULE = "tests.foreign_worlds"
SMALL: dict[str, Any] = {"start_steps": 64, "batch_size": 32, "hidden": 16, "n_step": 2}


def line(**settings: Any) -> dict[str, Any]:
    return {"name": "Line", "id": f"{MODULE}:Line-v2", "settings": settings}


def by_hand(seed: int, actions: np.ndarray) -> list[tuple[Any, ...]]:
    """One world of Gymnasium's, action in [-1, 1] -> x, speed, reward, d, d_dot, cost, ended."""
    env = gymnasium.make(f"{MODULE}:Line-v2", disable_env_checker=True)
    env.reset(seed=seed)
    rows = []
    for action in actions:
        observation, reward, _, ended, info = env.step(np.array([2.0 + 2.0 * action], np.float32))
        seen = [observation["speed"][0], observation["x"][0, 0]]
        rows.append((seen, reward, info["d"], info["d_dot"], info["cost"], ended))
        if ended:
            env.reset()
    return rows


@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_a_batch_is_each_world_by_hand(vectorization: str) -> None:
    """Scaled, flattened, padded, and with the end of an episode in `final_info`."""
    envs = make_envs({**line(), "vectorization": vectorization}, 3)
    # A Gaussian's samples are unbounded: they are clipped.
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (2 * EPISODE + 2, 3, 1))
    worlds = [by_hand(40 + i, actions[:, i, 0].clip(-1.0, 1.0)) for i in range(3)]
    envs.reset(seed=40)
    for t, action in enumerate(actions):
        observations, rewards, terminated, truncated, infos = envs.step(action)
        assert not terminated.any()
        for i in range(3):
            seen, reward, d, d_dot, cost, ended = worlds[i][t]
            assert truncated[i] == ended
            shown = infos["final_obs"] if ended else observations
            told = infos["final_info"] if ended else infos
            np.testing.assert_allclose(shown[i], seen, rtol=1e-6)
            assert (rewards[i], infos["cost"][i]) == pytest.approx((reward, cost), 1e-5)
            # A missing second wall repeats the first.
            np.testing.assert_allclose(told["d"][i], np.resize(d, 2), rtol=1e-5)
            np.testing.assert_allclose(told["d_dot"][i], np.resize(d_dot, 2), rtol=1e-5, atol=1e-9)
    envs.close()


@pytest.mark.parametrize("identity", ["Line-v2", "Free-v0", "Batched-v0"])
def test_what_is_made_is_what_learners_ask_for(identity: str) -> None:
    envs: Any = make_envs({"name": "X", "id": f"{MODULE}:{identity}"}, 3)
    check_envs(envs)
    assert envs.reports_distances == (identity != "Free-v0")
    assert envs.task_version == (2 if identity == "Line-v2" else identity == "Batched-v0")
    envs.close()


def test_padding_changes_no_energy_and_nobody_is_far() -> None:
    envs = make_envs(line(), 2)
    alone = gymnasium.make(f"{MODULE}:Line-v2", disable_env_checker=True)
    for walls in (2, 1):
        _, infos = envs.reset(seed=3)
        _, told = alone.reset(seed=3)
        assert len(told["d"]) == walls
        padded, mine = (
            energy.largest(energy.energy(info["d"], info["d_dot"], 0.5, 0.1, 1.0, 2.0))
            for info in (infos, told)
        )
        assert padded[0] == pytest.approx(mine)
    empty = make_envs(line(fault="nobody"), 2)
    _, infos = empty.reset(seed=0)
    assert (infos["d"] == FAR * 0.5).all()
    assert (infos["d_dot"] == 0.0).all()


def test_actions_are_held_over_the_ends_of_episodes() -> None:
    """Episodes of 7 steps, decisions of 3: the third has one step, and the next world waits."""
    envs = held(make_envs(line(), 2), 3)
    envs.reset(seed=0)
    action = np.ones((2, 1), np.float32)
    lengths, starts = [], []
    for _ in range(6):
        observations, _, _, truncated, infos = envs.step(action)
        lengths.append(infos["control_steps"].tolist())
        if truncated.any():
            assert infos["final_info"]["d"].shape == (2, 2)
            starts.append(observations[:, 1])
    assert lengths == [[3, 3], [3, 3], [1, 1]] * 2
    assert all((np.abs(start) <= 0.1).all() for start in starts)


def test_a_batch_that_restarts_all_worlds_for_one_is_refused() -> None:
    envs = make_envs({"name": "B", "id": f"{MODULE}:Batched-v0"}, 2)
    envs.reset(seed=0)
    with pytest.raises(UserError, match="reset_mask"):
        envs.reset(options={"reset_mask": np.array([True, False])})


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"fault": "no cost"}, "info lacks 'cost'"),
        ({"fault": "no d"}, "no 'd'"),
        ({"fault": "no d_dot"}, "no 'd_dot'"),
        ({"fault": "nan d"}, "nan"),
        ({"fault": "d is a number"}, "one number an obstacle"),
        ({"fault": "lengths"}, "different lengths"),
        ({"fault": "discrete"}, "Discrete(3)"),
        ({"fault": "unbounded"}, "finite"),
        ({"fault": "few obstacles", "num_obstacles": 1}, "num_obstacles=2"),
        ({"d_min": None}, "d_min"),
        ({"d_min": -1.0}, "d_min is -1.0"),
        ({"colour": "red"}, "colour"),
        ({"fault": "raises"}, "step 3 fails: RuntimeError: no bolt (foreign_worlds.py, line "),
        ({"fault": "short"}, "step(action) for (observation, reward, terminated,"),
    ],
)
def test_a_fault_is_one_line_with_a_remedy(settings: dict[str, Any], named: str) -> None:
    parts = {"num_obstacles": settings.pop("num_obstacles")} if "num_obstacles" in settings else {}
    with pytest.raises(UserError) as caught:
        make_envs({**line(**settings), **parts}, 2)
    text = str(caught.value)
    assert text.startswith("task Line: ")
    assert named in text
    assert "\n" not in text


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("wide", "3 numbers, its space 2"),
        ("nan observation", "not finite"),
        ("other spaces", "spaces changed"),
    ],
)
def test_what_goes_wrong_later_is_one_line_too(fault: str, named: str) -> None:
    def play() -> None:
        envs = make_envs(line(fault=fault), 2)
        envs.reset(seed=0)
        for _ in range(3 * EPISODE):
            envs.step(np.zeros((2, 1)))

    with pytest.raises(UserError, match=r"^[^\n]+$") as caught:
        play()
    assert named in str(caught.value)


@pytest.mark.filterwarnings("ignore::UserWarning")  # Gymnasium prints what its workers raise
@pytest.mark.parametrize("vectorization", ["sync", "async"])
def test_an_exception_of_its_own_is_one_line(
    vectorization: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where `check` did not meet it, as it plays little."""
    monkeypatch.setattr("safemr.foreign_check.PLAYED", 2)
    foreign_check._examined.cache_clear()
    envs = make_envs({**line(fault="raises"), "vectorization": vectorization}, 2)
    envs.reset(seed=0)
    for _ in range(2):
        envs.step(np.zeros((2, 1)))
    words = r"^task Line: step fails after 2 steps of 2 environments: RuntimeError: no bolt"
    with pytest.raises(UserError, match=words):
        envs.step(np.zeros((2, 1)))
    foreign_check._examined.cache_clear()


@pytest.mark.parametrize(
    ("identity", "named"),
    [
        ("no_such_package:X-v0", "no package no_such_package"),
        (f"{MODULE}:Lines-v2", "registers no Lines-v2"),
        ("Nowhere-v0", "Gymnasium knows no Nowhere-v0"),
        (f"{MODULE}:Endless-v0", "no limit"),
        (f"{MODULE}:Spaceless-v0", "it has no action_space; make it one of gymnasium.spaces"),
    ],
)
def test_check_says_what_is_missing(
    identity: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = cli.main(["check", identity])
    except SystemExit as ended:
        status = ended.code
    said = capsys.readouterr()
    assert status == 2
    assert named in said.out + said.err


def test_check_is_content_with_what_can_be_trained(capsys: pytest.CaptureFixture[str]) -> None:
    identity = f"{MODULE}:Line-v2"
    assert cli.main(["check", identity, "--set", "task.max_episode_steps=9"]) == 0
    said = capsys.readouterr().out
    assert "9 steps at most" in said
    assert "2: 1 scaled by their bounds, 1 by running statistics" in said
    assert f"safemr train --task {identity} --set task.max_episode_steps=9" in said
    assert cli.main(["check", f"{MODULE}:Free-v0"]) == 0  # no distances: no energy function
    assert capsys.readouterr().out.splitlines()[-1].endswith("--algorithm sac_lagrangian")
    # d_min may come from the configuration, and must not contradict the environment.
    given = ["--set", "task.d_min=0.3"]
    assert cli.main(["check", identity, *given]) == 2
    assert cli.main(["check", identity, *given, "--set", "task.fault=no d"]) == 2


def test_running_statistics_are_those_of_what_was_observed_and_settle() -> None:
    space = gymnasium.spaces.Box(
        np.array([-2.0, -np.inf, -np.inf]), np.array([6.0, np.inf, 1e30]), dtype=np.float64
    )
    transform = ObservationTransform.for_space(space)
    assert transform.unscaled.tolist() == [1, 2]
    normaliser = Normaliser(transform, 1000)
    raw = np.random.default_rng(0).normal([2.0, 50.0, 7.0], [2.0, 9.0, 0.0], (200, 3))
    for begin in range(0, 200, 20):
        normaliser.observe(transform(raw[begin : begin + 20]), step=begin // 20)
    normaliser.follow()
    expected = np.column_stack(
        ((raw[:, 0] - 2.0) / 4.0, (raw[:, 1] - raw[:, 1].mean()) / raw[:, 1].std(), 0.0 * raw[:, 2])
    )
    np.testing.assert_allclose(normaliser(transform(raw)), expected, atol=1e-4)
    # What a policy keeps reads alike, and clips what is far from all that was seen.
    settled = normaliser.settled(transform)
    np.testing.assert_allclose(settled(raw), expected, atol=1e-4)
    assert settled(np.array([[0.0, 1e6, 7.0]]))[0, 1] == LARGEST
    again = Normaliser(transform, 1000)
    again.load_state_dict(normaliser.state_dict())
    for one in (normaliser, again):
        one.observe(transform(raw + 100.0), step=int(1000 * SETTLED) + 1)
        one.follow()
        np.testing.assert_allclose(one(transform(raw)), expected, atol=1e-4)


def test_a_policy_without_shift_is_saved_as_before() -> None:
    transform = ObservationTransform.for_layout({"x": slice(0, 2)})
    assert Normaliser(transform, 1000).settled(transform) is transform
    seen = np.ones((3, 2), np.float32)
    assert Normaliser(transform, 1000)(seen) is seen


def run_of(task: dict[str, Any], name: str, values: dict[str, Any], steps: int) -> planning.Run:
    algorithm = planning.load_algorithm(name)
    overrides = {k: v for k, v in values.items() if k in algorithm.settable}
    return planning.make_run(
        task,
        algorithm,
        planning.hyperparameters(algorithm, overrides, name),
        variant=name,
        seed=100,
        steps=steps,
        log_every=steps // 4,
        evaluation={"every": steps // 2, "episodes": 2, "seed": 7},
    )


@pytest.mark.parametrize("name", ["safemr", "ppo_lagrangian"])
def test_a_resumed_run_begins_new_episodes_and_keeps_the_rest(name: str) -> None:
    entry = planning.describe_foreign("Line", ForeignTask.said(f"{MODULE}:Line-v2", {}, ""))
    values = SMALL | {"epoch_steps": 80}
    config_of = run_of(entry, name, values, 800).config
    algorithm = planning.load_algorithm(name)

    def trainer() -> Any:
        hyperparameters = algorithm.hyperparameters(**config_of["algorithm"]["hyperparameters"])
        return algorithm.trainer(hyperparameters, lambda n: make_envs(entry, n), 100, 800)

    first, resumed = trainer(), trainer()
    first.advance(400)
    resumed.load_state_dict(first.state_dict())
    raw = np.random.default_rng(0).normal(size=(5, 2))
    np.testing.assert_array_equal(resumed.policy.act(raw), first.policy.act(raw))
    loaded = Policy.from_arrays(first.policy.arrays())
    np.testing.assert_array_equal(loaded.act(raw), first.policy.act(raw))
    if name == "safemr":
        newest = slice((resumed.replay._head - 1) * 16, resumed.replay._head * 16)
        assert resumed.replay._fields["ended"][newest].all()
        # Bounds scale x; of the speed the memory keeps what was observed.
        stored = resumed.replay._fields["observations"][: resumed.replay.size * 16]
        assert torch.equal(stored, first.replay._fields["observations"][: len(stored)])
        assert 0.5 < float(stored[:, 0].abs().max()) <= 1.0
    resumed.advance(800)
    assert resumed.step >= 800


def test_train_from_python_and_from_the_command_line_make_one_record(tmp_path: Path) -> None:
    identity = f"{MODULE}:Line-v2"
    record = safemr.train(
        identity, steps=400, out=tmp_path, seed=3, log_points=2, eval_episodes=2,
        settings={"vectorization": "sync"}, interface={"action_repeat": 2}, quiet=True, **SMALL,
    )  # fmt: skip
    assert record.task == {
        "name": "Line", "id": identity, "version": 2, "settings": {}, "vectorization": "sync"
    }  # fmt: skip
    assert record.provenance["exact_resume"] is False
    assert record.provenance["task_package"]["package"] == "tests"
    assert record.policy().action_repeat == 2
    assert record.certificate().parameters.keys() == {"sigma", "k", "n"}
    assert evaluate_record(record, episodes=2)["length"] == EPISODE
    sets = [f"--set={key}={value}" for key, value in SMALL.items()]
    sets += ["--set=task.vectorization=sync", "--set=interface.action_repeat=2"]
    arguments = ["train", "--task", identity, "--algorithm", "safemr", "--steps", "400", "--seed"]
    arguments += ["3", "--log-points", "2", "--eval-episodes", "2", "--out", str(tmp_path), *sets]
    assert cli.main(arguments) == 0
    assert len(list(tmp_path.glob("runs/*/*/*"))) == 1
    assert Record.open(record.folder).rows == record.rows


def test_without_distances_only_what_needs_none_is_trained(tmp_path: Path) -> None:
    identity = f"{MODULE}:Free-v0"
    with pytest.raises(UserError, match="reports no d and d_dot"):
        safemr.train(identity, "safemr", steps=400, out=tmp_path)
    record = safemr.train(
        identity, "ppo_lagrangian", steps=320, out=tmp_path, log_points=2, eval_episodes=2,
        epoch_steps=160, hidden=16, quiet=True,
    )  # fmt: skip
    assert record.rows[-1]["eval_length"] == EPISODE


CONFIGURATION = {
    "tasks": {"Wire": {"id": f"{MODULE}:Line-v2", "settings": {"max_episode_steps": 9}}},
    "algorithms": {"SafeMR": {"algorithm": "safemr"}},
    "seeds": [0],
    "budget": {"off_policy": 8000},
    "log_points": 4,
    "evaluation": {"points": 2, "episodes": 2},
}


def test_a_configuration_names_it_and_the_plan_knows_what_it_has() -> None:
    plan = planning.resolve(config.parse(CONFIGURATION))
    (run,) = plan.runs
    assert run.config["task"] == {
        "name": "Wire", "id": f"{MODULE}:Line-v2", "version": 2,
        "settings": {"max_episode_steps": 9},
    }  # fmt: skip
    assert planning.installed(run.config["task"]) == run.config["task"]
    traits = plan.tasks["Wire"].traits
    assert (traits.episode_steps, traits.action_dim, traits.point_robot) == (9, 1, False)
    assert json.loads(run.resolved)["task"]["id"] == f"{MODULE}:Line-v2"


@pytest.mark.parametrize(
    ("entry", "named"),
    [
        ({"id": "a b"}, "must be like my_package:MyTask-v0"),
        ({"id": "a:B-v0", "d_min": "near"}, "must be a number"),
        ({"id": "a:B-v0", "vectorization": "asynch"}, "did you mean 'async'?"),
        ({"id": "a:B-v0", "setting": {}}, "did you mean 'settings'?"),
    ],
)
def test_a_wrong_entry_is_one_line(entry: dict[str, Any], named: str) -> None:
    with pytest.raises(UserError) as caught:
        config.parse({**CONFIGURATION, "tasks": {"Wire": entry}})
    assert named in str(caught.value)


def test_the_name_of_a_registered_task_is_taken() -> None:
    with pytest.raises(UserError, match="name of a registered task"):
        planning.resolve(
            config.parse({**CONFIGURATION, "tasks": {"Aircraft": {"id": f"{MODULE}:Line-v2"}}})
        )
