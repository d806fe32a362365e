"""Tasks with names of their own: what a configuration may say, and what its names lead to."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from safemr import paper, tasks
from safemr.certificates import falsification
from safemr.certificates.falsification import make_simulator
from safemr.errors import UserError
from safemr.experiment import config, plan_cache, planning, records, train
from safemr.paper import PHI_H

ROOT = Path(__file__).resolve().parents[1]
GOAL, PUSH = "Pillars-0.15-Goal", "Hazards-0.15-Push"
EIGHT = {"base": GOAL, "settings": {"num_obstacles": 8}}


def small(**changes: Any) -> dict[str, Any]:
    return {
        "tasks": [GOAL, {"Pillars-8": EIGHT}],
        "algorithms": {"SafeMR": {"algorithm": "safemr"}, "CPO": {"algorithm": "cpo"}},
        "seeds": [0],
        "budget": {"off_policy": 20_000, "on_policy": 40_000},
        "log_points": 4,
        "evaluation": {"points": 2, "episodes": 2},
        **changes,
    }


def resolve(**changes: Any) -> planning.Plan:
    return planning.resolve(config.parse(small(**changes)))


def test_a_task_and_one_with_other_settings_fit_in_one_configuration() -> None:
    plan = resolve()
    assert {run.task for run in plan.navigation} == {GOAL, "Pillars-8"}
    own, eight = (plan.navigation[0].config["task"], plan.navigation[-1].config["task"])
    # The paper's task is described as ever: the digests of its records depend on it.
    assert own == {"name": GOAL, "version": 1, "settings": {}}
    assert eight == {**own, "name": "Pillars-8", **EIGHT}
    assert plan.navigation[-1].path.parts[:2] == ("runs", "Pillars-8")
    assert len({run.digest for run in plan.runs}) == len(plan.runs)


def test_the_forms_of_tasks_say_the_same() -> None:
    forms = (
        [GOAL, {"Pillars-8": EIGHT}],
        {GOAL: None, "Pillars-8": EIGHT},
        [{GOAL: {}}, {"Pillars-8": EIGHT}],
    )
    resolved = {json.dumps([run.resolved for run in resolve(tasks=form).runs]) for form in forms}
    assert len(resolved) == 1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        # Settings under the name of a registered task would be judged as that task.
        (
            {"task_overrides": {GOAL: {"settings": {"num_obstacles": 8}}}},
            f"tasks: {{NAME: {{base: {GOAL}, settings: {{num_obstacles: 8}}}}}}",
        ),
        ({"tasks": {PUSH: EIGHT}}, f"{PUSH!r} is the name of a registered task"),
        ({"tasks": {PUSH.lower(): EIGHT}}, "is the name of a registered task"),
        ({"tasks": {"X": {**EIGHT, "base": "Pillars-0.15-Gaol"}}}, f"did you mean {GOAL!r}?"),
        ({"tasks": {"X": {**EIGHT, "settings": {"obstacles": 8}}}}, "unknown setting 'obstacles'"),
        ({"tasks": {"X": {**EIGHT, "settings": {"num_obstacles": 0}}}}, "num_obstacles"),
        ({"tasks": {"X": {**EIGHT, "settings": {}}}}, f"is empty: then it is {GOAL} itself"),
        ({"tasks": {"X": {"base": GOAL}}}, "tasks.X lacks 'settings'"),
        ({"tasks": {"X": {}}}, "unknown task 'X'"),
        ({"tasks": {"X": EIGHT, "x": EIGHT}}, "tasks names 'x' twice"),
        ({"tasks": {"X": EIGHT, "Y": EIGHT}}, "'X' and 'Y' are the same task"),
        (
            {"algorithms": {name: {"algorithm": "joint_sis", "seeds": [seed]}
                            for name, seed in (("A", 0), ("B", 1))}},
            "'A' and 'B' are the same algorithm",
        ),
        (
            {"sensitivity": {"task": GOAL, "algorithm": "SafeMR",
                             "points": [[0.45, 0.15], [0.4500001, 0.15]]}},
            "have the same label, SafeMR[0.45,0.15]",
        ),
        ({"tasks": [[GOAL]]}, "each of tasks must consist of letters"),
        ({"tasks": {}}, "tasks must be a list, not {}"),
        ({"tasks": [GOAL, {}]}, "each of tasks must consist of letters"),
        (
            {"task_overrides": {"Pillars-8": {"settings": {"num_obstacles": 9}}}},
            "num_obstacles belongs into tasks.Pillars-8.settings",
        ),
        ({"task_overrides": {"Pillars-9": {}}}, "did you mean 'Pillars-8'?"),
        (
            {"aircraft": {"task": GOAL, "algorithms": {"S": {"algorithm": "safemr"}}}},
            "Aircraft only",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_is_one_line(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as caught:
        resolve(**changes)
    assert said in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_budgets_and_the_simulations_settings_are_overrides_of_any_name() -> None:
    crates = {"base": PUSH, "settings": {"num_obstacles": 2}}
    override = {"settings": {"sleep": True}, "budget": {"off_policy": 8000}}
    plan = resolve(
        tasks=[PUSH, {"Crates": crates}], task_overrides={PUSH: override, "Crates": override}
    )
    settings = {run.task: run.config["task"]["settings"] for run in plan.runs}
    assert settings == {PUSH: {"sleep": True}, "Crates": {"num_obstacles": 2, "sleep": True}}
    assert {run.config["steps"] for run in plan.runs if run.variant == "SafeMR"} == {8000}


def test_what_a_task_has_is_no_question_of_its_name() -> None:
    named = {
        "Doors-Reach": {"base": PUSH, "settings": {"max_episode_steps": 70}},
        "Far-Push": {"base": GOAL, "settings": {"extent": 3.0}},
        "Slow-Goal": {"base": "Aircraft", "settings": {"other_turn": 0.5}},
    }
    everything = [*planning.task_names(), *({name: entry} for name, entry in named.items())]
    plan = resolve(tasks=everything)
    robots = {name for name, task in plan.tasks.items() if task.traits.point_robot}
    boxes = {name for name, task in plan.tasks.items() if task.traits.pushes_box}
    assert robots == {*paper.TASKS, "PointGoal1", "Doors-Reach", "Far-Push"}
    assert boxes == {PUSH, "Hazards-0.30-Push", "Doors-Reach"}
    assert plan.tasks["Doors-Reach"].traits.episode_steps == 70


def test_a_remembered_plan_keeps_what_tasks_have(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    parsed = config.parse(small())
    first = plan_cache.plan_for(parsed)
    monkeypatch.setattr(planning, "resolve", None)
    assert plan_cache.plan_for(parsed) == first


def test_no_module_asks_the_name_of_a_task_what_it_is() -> None:
    kinds = ('"-Goal"', '"-Push"', '"Push"', '"Goal"', '"Pillars', '"Hazards')
    files = [*(ROOT / "workflow").rglob("*.smk"), *(ROOT / "workflow").rglob("*.py")]
    files += list((ROOT / "safemr").rglob("*.py"))
    for path in files:
        for line in path.read_text(encoding="utf-8").splitlines():
            asked = any(word in line for word in ("endswith(", "startswith(", "rsplit("))
            assert not (asked and any(kind in line for kind in kinds)), f"{path}: {line}"


def test_an_environment_is_made_from_the_entry_of_a_record() -> None:
    entry = resolve().navigation[-1].config["task"]
    envs = make_simulator(entry, 2)
    assert envs.scene(0).obstacles.shape == (8, 2)
    assert envs.task.name == GOAL
    envs.close()
    assert planning.installed(entry) == entry
    assert planning.installed(GOAL) == {"name": GOAL, "version": 1, "settings": {}}
    with pytest.raises(UserError, match="Slow is none"):
        make_simulator({"name": "Slow", "base": "Aircraft", "settings": {}})


def test_a_state_found_on_a_task_is_replayed_on_it() -> None:
    """A search on larger obstacles has their d_min, and so has the replay of what it found."""
    wide = {"name": "Wide", "base": GOAL, "version": 1, "settings": {"obstacle_size": 0.3}}
    envs = make_simulator(wide, 32)
    search = falsification.falsify(envs, wide, PHI_H, count=64, rounds=1)
    envs.close()
    example = json.loads(json.dumps(search.example()))
    assert (example["task"], example["base"]) == ("Wide", GOAL)
    _, g = falsification.replay(example)
    assert g.min() == pytest.approx(search.worst_margin, abs=1e-9)
    own = {name: value for name, value in example.items() if name not in ("base", "settings")}
    _, other = falsification.replay({**own, "task": GOAL})
    assert not np.isclose(other.min(), g.min(), atol=1e-6)


def test_the_command_line_names_a_task_as_the_configuration_does() -> None:
    common = ["--task", GOAL, "--algorithm", "safemr", "--set", "task.num_obstacles=8"]
    common += ["--seed", "0", "--steps", "8000", "--log-points", "4", "--eval-episodes", "2"]
    with pytest.raises(UserError, match=r"makes another task of .*--task-name"):
        train.resolve(train._parse(common))
    resolved, _ = train.resolve(train._parse([*common, "--task-name", "Pillars-8"]))
    assert resolved["task"] == {"name": "Pillars-8", "version": 1, **EIGHT}
    assert records.record_path(resolved, "SafeMR").parts[1] == "Pillars-8"
    for wrong in (PUSH, "a/b"):
        with pytest.raises(UserError):
            train.resolve(train._parse([*common, "--task-name", wrong]))
    bare = [*common[:4], "--set", "task.sleep=true"]
    assert train.resolve(train._parse(bare))[0]["task"]["name"] == GOAL


def test_every_registered_task_is_described_by_its_own_environment() -> None:
    for name in planning.task_names():
        envs = tasks.make_envs(name, 1)
        alone = gymnasium.make(f"{name}-v0", disable_env_checker=True).unwrapped
        assert tasks.traits(envs).point_robot == tasks.traits(alone).point_robot
        assert tasks.traits(envs).pushes_box == tasks.traits(alone).pushes_box
        envs.close()
        alone.close()
