"""What the learners ask of a batch: every fault is named, and what passes is learnt on."""

from __future__ import annotations

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from safemr.environments import OPTIONAL_INFOS, REQUIRED_INFOS, check_envs, info_of
from safemr.errors import UserError
from safemr.experiment import planning
from safemr.learning.episode_statistics import EpisodeStatistics
from safemr.tasks import make_envs
from tests.toy import ToyEnvs

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("name", planning.task_names())
def test_every_registered_task_passes(name: str) -> None:
    envs = make_envs(name, 2)
    check_envs(envs)
    envs.close()


def test_the_check_leaves_no_trace_behind_the_next_seeded_reset() -> None:
    checked, fresh = (make_envs("Aircraft", 3) for _ in range(2))
    check_envs(checked)
    observations = [envs.reset(seed=7)[0] for envs in (checked, fresh)]
    np.testing.assert_array_equal(*observations)


class Broken(ToyEnvs):
    """The toy with one thing changed by the test."""

    def __init__(self, infos: Callable[[dict[str, Any]], Any] | None = None, **wrong: Any) -> None:
        super().__init__(3)
        self._change = infos
        for name, value in wrong.items():
            setattr(self, name, value)

    def step(self, actions: np.ndarray) -> Any:
        *rest, infos = super().step(actions)
        return (*rest, self._change(infos) if self._change else infos)


def without(name: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda infos: {key: value for key, value in infos.items() if key != name}


def instead(name: str, value: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda infos: infos | {name: value}


def box(low: float, high: float, *shape: int) -> gymnasium.spaces.Box:
    return gymnasium.spaces.Box(low, high, shape, np.float32)


FAULTS = [
    *((Broken(**{name: None}), f"method {name} is missing")
      for name in ("reset", "step", "close", "get_state", "set_state")),
    *((Broken(**{name: wrong}), name)
      for name in ("num_envs", "num_obstacles", "max_episode_steps")
      for wrong in (None, 0, 2.5, True)),
    *((Broken(d_min=wrong), "d_min") for wrong in (None, 0.0, -1.0, np.inf, "near")),
    (Broken(single_observation_space=None), "single_observation_space is None"),
    (Broken(single_observation_space=box(-1, 1, 2, 2)), "Box of one dimension"),
    (Broken(single_observation_space=box(-1, 1, 2)), "observations has shape (3, 1)"),
    (Broken(single_action_space=gymnasium.spaces.Discrete(2)), "single_action_space"),
    (Broken(single_action_space=box(-2, 2, 1)), "rescale"),
    *((Broken(observation_layout=wrong), "observation_layout")
      for wrong in (None, {"x": (0, 1)}, {"x": slice(0, 2)}, {"x": slice(None)})),
    (Broken(metadata={}), "SAME_STEP"),
    (Broken(metadata={"autoreset_mode": gymnasium.vector.AutoresetMode.NEXT_STEP}), "SAME_STEP"),
    (Broken(num_obstacles=2), "infos['d'] has shape (3, 1)"),
    (Broken(reset=lambda: None), "reset(seed=0) fails"),
    (Broken(reset=lambda seed: np.zeros((3, 1))), "no pair"),
    (Broken(reset=lambda seed: (np.zeros((3, 1)), {})), "the infos of reset lack 'd'"),
    (Broken(step=lambda actions: (np.zeros((3, 1)), 0.0)), "no five things"),
    *((Broken(without(name)), f"the infos of step lack {name!r}") for name in REQUIRED_INFOS),
    *((Broken(instead(name, np.zeros(2))), f"infos[{name!r}] has shape (2,)")
      for name in (*REQUIRED_INFOS, *OPTIONAL_INFOS)),
    (Broken(instead("cost", np.array([0.0, np.nan, 0.0]))), "not finite"),
    (Broken(instead("cost", -np.ones(3))), "negative"),
    (Broken(set_state=lambda state: None), "after set_state"),
]  # fmt: skip


@pytest.mark.parametrize(("envs", "named"), FAULTS, ids=[named for _, named in FAULTS])
def test_a_fault_is_named_in_one_line_with_a_remedy(envs: Any, named: str) -> None:
    with pytest.raises(UserError) as caught:
        check_envs(envs)
    line = str(caught.value)
    assert named in line
    assert line.startswith("Broken: ")
    assert "; " in line
    assert "\n" not in line


def test_the_toy_passes_and_needs_no_optional_info() -> None:
    check_envs(ToyEnvs(3))
    for name in OPTIONAL_INFOS:
        check_envs(Broken(without(name)))


def test_what_a_batch_does_not_say_has_a_default() -> None:
    cost = np.array([0.0, 2.0])
    assert info_of({"cost": cost}, "cost_contact").tolist() == [False, True]
    given = {"cost": cost, "cost_indicator": np.array([1.0, 0.0])}
    assert info_of(given, "cost_contact").tolist() == [1.0, 0.0]
    assert info_of(given, "reward_push") == info_of(given, "goal_met") == 0.0
    with pytest.raises(KeyError):
        info_of({}, "cost")


def test_episodes_have_the_same_columns_with_and_without_optional_infos() -> None:
    ended = np.ones(2, bool)
    bare = {"cost": np.array([0.0, 3.0])}
    zeros = dict.fromkeys(OPTIONAL_INFOS, np.zeros(2))
    full = (
        zeros
        | bare
        | {"control_steps": np.ones(2)}
        | dict.fromkeys(("cost_indicator", "cost_contact"), np.array([0.0, 1.0]))
    )
    rows = []
    for infos in (bare, full):
        statistics = EpisodeStatistics(2)
        statistics.update(np.ones(2), ended, ~ended, infos)
        rows.append(statistics.pop())
    assert rows[0] == rows[1]
    assert rows[0]["violation_rate"] == 0.5


def test_batches_are_made_in_one_place() -> None:
    found = [
        path.relative_to(ROOT).as_posix()
        for folder in ("safemr", "benchmarks", "workflow")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and node.attr in ("make_vec", "VectorEnv")
    ]
    # Those from outside are looked at in one, and both are reached by `make_envs` alone.
    assert found == ["safemr/foreign.py", "safemr/foreign_check.py", "safemr/tasks.py"]
