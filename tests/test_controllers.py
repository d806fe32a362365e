"""Scripted controllers on the real tasks: what they are worth, as ordinary entries."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

from safemr.learning.evaluation import evaluate
from safemr.measure import controllers
from safemr.report import tables

PUSH, GOAL = "Hazards-0.15-Push", "Pillars-0.15-Goal"


def score(task: str, controller: type[controllers.VelocityController], episodes: int, **settings):
    envs = gymnasium.make_vec(
        f"envs:{task}-v0", episodes, vectorization_mode="vector_entry_point", **settings
    )
    scores = evaluate(controller(envs), envs, seed=100)
    envs.close()
    return scores


def test_goal_seeker_reaches_goals_and_does_not_care_for_obstacles():
    scores = score(GOAL, controllers.GoalSeeker, 6)
    assert scores["goals"] > 4
    assert scores["return"] > 10
    assert scores["cost_contact"] > 0


def test_touching_the_box_is_worth_the_approach_and_nothing_else():
    scores = score(PUSH, controllers.BoxToucher, 6, sleep=True)
    assert 1.2 < scores["return"] < 1.9
    assert scores["goals"] == 0
    assert abs(scores["reward_push"]) < 0.15
    assert scores["reward_approach"] == pytest.approx(scores["return"], abs=0.15)


def test_pusher_brings_the_box_to_goals():
    scores = score(PUSH, controllers.Pusher, 8, sleep=True)
    assert scores["return"] > 3
    assert scores["goals"] > 0.5
    assert scores["reward_push"] > 1


def test_controllers_drive_at_the_velocity_they_want():
    class Eastward(controllers.VelocityController):
        def wanted(self, scene, velocity):
            return np.array([0.6, 0.0])

    envs = gymnasium.make_vec(
        f"envs:{PUSH}-v0", 3, vectorization_mode="vector_entry_point", sleep=True
    )
    driver = Eastward(envs)
    observations, _ = envs.reset(seed=7)
    for _ in range(250):
        before = np.array([envs.scene(i).robot[:2] for i in range(3)])
        observations, *_ = envs.step(driver.act(observations))
    after = np.array([envs.scene(i).robot[:2] for i in range(3)])
    envs.close()
    np.testing.assert_allclose((after - before) / 0.02, [[0.6, 0.0]] * 3, atol=0.08)


def test_scores_enter_the_tables_like_any_other_variant(tmp_path):
    # What a task is called says nothing of what can act in it.
    short = [
        {"name": name, "base": base, "settings": {"max_episode_steps": 20}}
        for name, base in (("Doors-Reach", GOAL), ("Crates", PUSH))
    ]
    scores = controllers.controller_scores(short, seeds=(0, 1), episodes=2)
    assert set(scores["task"]) == {"Doors-Reach", "Crates"}
    assert set(scores.loc[scores["metric"] == "eval_length", "value"]) == {20.0}
    assert set(scores["variant"]) == {
        "scripted: ignores obstacles", "scripted: touches the box", "scripted: pushes the box"
    }  # fmt: skip
    display = tables.full_results(scores).display
    assert set(display["seeds"]) == {"2"}
    assert not display.isin([tables.MISSING]).any().any()
    again = controllers.controller_scores(short, seeds=(0, 1), episodes=2)
    assert scores.equals(again)


def test_safety_gyms_own_task_has_its_reference_line():
    (name,) = set(controllers.controller_scores(["PointGoal1"], seeds=(0,), episodes=1)["variant"])
    assert name == "scripted: ignores obstacles"


def test_a_task_of_another_kind_has_no_reference_line():
    assert controllers.controller_scores(("Aircraft",)).empty
