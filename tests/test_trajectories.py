"""Recorded trajectories: the episodes of the evaluation, and multiplier maps of a moving robot."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from safemr import files
from safemr.certificates.energy import energy, largest
from safemr.certificates.falsification import make_simulator
from safemr.errors import UserError
from safemr.learning.evaluation import evaluate
from safemr.learning.interface import Interface
from safemr.learning.networks import StackedMLP
from safemr.learning.observation import ObservationTransform
from safemr.learning.policies import Policy, network_arrays
from safemr.measure import tracks, trajectories
from safemr.paper import PHI_H

TASK = "Pillars-0.15-Goal"
LAYOUT = {"name": "Short", "base": TASK, "settings": {"max_episode_steps": 60}}


@pytest.fixture(scope="module")
def policy() -> Policy:
    envs = make_simulator(TASK, 1)
    transform = ObservationTransform.for_layout(envs.observation_layout)
    envs.close()
    generator = torch.Generator().manual_seed(0)
    actor = StackedMLP(1, (transform.dim, 8, 4), "elu", generator=generator)
    multiplier = StackedMLP(1, (transform.dim, 8, 1), "elu", generator=generator)
    extras = {**network_arrays("multiplier", multiplier), "multiplier_cap": np.array(0.7)}
    return Policy(transform, actor, squash=True, extras=extras)


@pytest.mark.parametrize("action_repeat", [1, 7])
def test_recorded_episodes_are_those_of_the_evaluation(policy, tmp_path, action_repeat):
    policy = Policy(
        policy.transform, policy.network, squash=True, interface=Interface(action_repeat)
    )
    recorded = trajectories.episodes(policy, LAYOUT, seeds=[5, 6, 7], steps=60)
    envs = make_simulator(LAYOUT, 3)
    scores = evaluate(policy, envs, seed=5)
    envs.close()
    assert recorded["reward"].sum(0).mean() == pytest.approx(scores["return"], abs=1e-5)
    assert recorded["robot"].shape == (61, 3, 3)
    files.save_arrays(tmp_path / "a.npz", recorded)
    loaded = files.load_arrays(tmp_path / "a.npz")
    scene = tracks.scene_at(loaded, episode=1, step=60)
    np.testing.assert_array_equal(scene.robot, recorded["robot"][60, 1])
    assert scene.box is None
    assert scene.task.d_min == pytest.approx(0.25)


class Restless:
    """A policy that never does the same twice and holds what it does for five control steps."""

    action_repeat = 5

    def __init__(self) -> None:
        self.actions: list[np.ndarray] = []

    def act(self, observations, deterministic=True):
        generator = np.random.default_rng(len(self.actions))
        actions = generator.uniform(-1, 1, (len(observations), 2)).astype(np.float32)
        self.actions.append(actions)
        return actions


def test_every_control_step_of_a_held_action_is_recorded():
    restless = Restless()
    recorded = trajectories.episodes(restless, LAYOUT, seeds=[5, 6], steps=12)
    assert len(restless.actions) == 3
    envs = make_simulator(LAYOUT, 2)
    envs.reset(seed=[5, 6])
    for step in range(12):
        _, reward, *_ = envs.step(restless.actions[step // 5])
        np.testing.assert_array_equal(recorded["reward"][step], reward.astype(np.float32))
        robots = np.array([envs.scene(index).robot for index in range(2)], np.float32)
        np.testing.assert_array_equal(recorded["robot"][step + 1], robots)
    envs.close()


def test_no_more_steps_than_an_episode_has(policy):
    with pytest.raises(UserError, match="60 steps, 61 were asked"):
        trajectories.episodes(policy, LAYOUT, seeds=[0], steps=61)


def test_the_vase_is_recorded_where_there_is_one():
    envs = make_simulator("PointGoal1", 1)
    transform = ObservationTransform.for_layout(envs.observation_layout)
    actor = StackedMLP(1, (transform.dim, 8, 4), "elu", generator=torch.Generator().manual_seed(0))
    recorded = trajectories.episodes(
        Policy(transform, actor, squash=True), "PointGoal1", seeds=[5], steps=3
    )
    envs.reset(seed=[5])
    np.testing.assert_allclose(
        tracks.scene_at(recorded, episode=0, step=0).vase, envs.scene(0).vase, atol=1e-6
    )
    envs.close()


def test_multiplier_map_is_the_energy_of_a_moving_robot_around_the_obstacles(policy):
    speed, heading = 0.5, 0.7
    plane = trajectories.multiplier_map(
        policy, PHI_H, TASK, seed=2, points=21, speed=speed, heading=heading
    )
    x, y = np.meshgrid(plane["x"], plane["y"])
    gaps = np.stack([x, y], -1)[..., None, :] - plane["obstacles"]
    d = np.linalg.norm(gaps, axis=-1)
    d_dot = (gaps @ [np.cos(heading), np.sin(heading)]) / d * speed
    expected = largest(energy(d, d_dot, 0.25, *PHI_H))
    free = ~np.isnan(plane["multiplier"])
    assert 0.9 < free.mean() < 1
    # the robot has coasted for one step, in which drag takes 4% of its speed
    np.testing.assert_allclose(plane["phi"][free], expected[free], atol=0.03)
    assert (d.min(-1)[free] >= 0.25).all()
    inside = plane["multiplier"][free]
    assert (inside > 0).all()
    assert inside.max() <= 0.7 + 1e-6


def test_a_policy_without_multiplier_is_refused(policy):
    bare = Policy(policy.transform, policy.network, squash=True)
    with pytest.raises(UserError, match="without a multiplier"):
        trajectories.multipliers(bare, np.zeros((1, 44)))
