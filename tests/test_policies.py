"""A policy acts on one observation as on a batch, and refuses those of another task."""

from __future__ import annotations

import functools
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

import envs  # noqa: F401  registers the tasks
from safemr.errors import UserError
from safemr.experiment import planning
from safemr.experiment.train import make_envs
from safemr.learning.contract import environment_seed
from safemr.learning.policies import Policy

ROOT = Path(__file__).resolve().parents[1]
TASK = {"name": "Pillars-0.15-Goal", "version": 1, "settings": {}}
FAMILIES = {
    "safemr": {"num_envs": 2, "hidden": 16},
    "ppo_lagrangian": {"num_envs": 2, "hidden": 16, "epoch_steps": 100},
}


@pytest.fixture(scope="module", params=FAMILIES)
def policy(request: pytest.FixtureRequest) -> Policy:
    algorithm = planning.load_algorithm(request.param)
    config = algorithm.hyperparameters(**FAMILIES[request.param])
    return algorithm.trainer(config, functools.partial(make_envs, TASK), 0, 1_000).policy


def saved(policy: Policy) -> Policy:
    return Policy.from_arrays(policy.arrays())


@pytest.mark.parametrize("read", [lambda policy: policy, saved], ids=["trained", "saved"])
@pytest.mark.parametrize("deterministic", [True, False])
def test_an_observation_straight_from_the_environment(policy, read, deterministic) -> None:
    acting = read(policy)
    environment = gymnasium.make(f"{TASK['name']}-v0")
    observation, _ = environment.reset(seed=3)
    one = acting.act(observation, deterministic, torch.Generator().manual_seed(0))
    batch = acting.act(observation[None], deterministic, torch.Generator().manual_seed(0))
    assert one.shape == environment.action_space.shape
    assert one.dtype == np.float32
    np.testing.assert_array_equal(one, batch[0])
    assert environment.action_space.contains(np.clip(one, -1, 1))
    environment.step(acting.act(observation, deterministic))
    environment.close()


@pytest.mark.parametrize("read", [lambda policy: policy, saved], ids=["trained", "saved"])
@pytest.mark.parametrize("task", ["Hazards-0.15-Push", "PointGoal1", "Aircraft"])
def test_observations_of_another_task_are_refused(policy, read, task) -> None:
    acting = read(policy)
    observation = gymnasium.make(f"{task}-v0").reset(seed=0)[0]
    for wrong in (observation, np.stack([observation] * 3)):
        with pytest.raises(UserError, match=r"trained on another task") as caught:
            acting.act(wrong)
        assert str(wrong.shape) in str(caught.value)
    with pytest.raises(UserError, match="batch"):
        acting.act(np.zeros((2, 3, 44)))


def test_environment_seeds_of_the_families_and_of_neighbouring_runs_are_apart() -> None:
    """The numbers are those of every recorded run: 4 is the stream off policy, 3 on policy."""
    assert [environment_seed(seed, 4) for seed in (0, 1)] == [937182424, 1774568316]
    assert [environment_seed(seed, 3) for seed in (0, 1)] == [1306511473, 2005377912]
    seeds = [environment_seed(seed, stream) for seed in range(20) for stream in (3, 4)]
    apart = np.diff(np.sort(seeds))
    assert apart.min() > 1000, "sub-environments of neighbouring runs would share layouts"


def test_seeds_of_a_run_are_made_in_one_place() -> None:
    """Every stream of a run comes from `safemr.learning.contract`."""
    made = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "safemr").rglob("*.py")
        if "SeedSequence" in path.read_text(encoding="utf-8")
    }
    assert made == {"safemr/learning/contract.py"}
