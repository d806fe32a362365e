"""The configuration: what a valid one means, and one clear line for everything else."""

from __future__ import annotations

import copy
import datetime
import importlib
import math
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from safemr.errors import UserError
from safemr.experiment import config, planning, train
from safemr.experiment.plan_cache import plan_for
from safemr.experiment.strict_yaml import StrictLoader

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = ROOT / "config/config.yaml"

VALID: dict[str, Any] = {
    "tasks": ["Pillars-0.15-Goal", "Hazards-0.15-Push"],
    "algorithms": {
        "SafeMR": {"algorithm": "safemr", "a": 0.35, "b": 0.15, "start_steps": 100},
        "PPO-L": {"algorithm": "ppo_lagrangian", "epoch_steps": 800},
    },
    "seeds": [100, 101],
    "budget": {"off_policy": 1000, "on_policy": 2000},
    "log_points": 10,
    "evaluation": {"points": 5, "episodes": 2, "seed": 10000},
    "unseen_layouts": {"episodes": 3, "seed": 20000},
    "task_overrides": {
        "Hazards-0.15-Push": {
            "settings": {"sleep": True},
            "budget": {"off_policy": 3000},
            "hyperparameters": {"off_policy": {"update_every": 16}},
        }
    },
    "sensitivity": {
        "task": "Pillars-0.15-Goal",
        "algorithm": "SafeMR",
        "points": [[0.35, 0.15], [0.45, 0.15]],
        "seeds": [100],
    },
    "aircraft": {
        "algorithms": {
            "JointSIS": {"algorithm": "joint_sis", "start_steps": 100, "target_entropy": -1.0}
        },
        "seeds": [100],
    },
    "outside": {"Script": {"algorithm": "script", "steps": 100, "hyperparameters": {"gain": 1.0}}},
    "results_root": "results",
    "figures_root": "paper_figures",
    "wandb": {"mode": "disabled", "project": "safemr"},
    "safe": {"cost_tolerance": 1.0, "zero_violation_share": 0.95},
    "filters": {
        "policies": ["PPO-L"],
        "certificates": ["phi_h", "SafeMR"],
        "episodes": 3,
        "seed": 40000,
    },
}

NOT_A_NUMBER = ["1", "1e5", None, [], {}, True, datetime.date(2020, 1, 1)]
NOT_AN_INTEGER = [*NOT_A_NUMBER, 1.5, math.nan]
NOT_POSITIVE = [*NOT_AN_INTEGER, 0, -1, 10**30]
NOT_A_MAPPING = ["text", 3, [1], True, 1.5]
NOT_A_NAME = [
    None,
    3,
    "",
    " ",
    "a b",
    "../x",
    "a/b",
    "-a",
    "/etc",
    "Größe",
    "\u202ex",
    "x" * 61,
    "a\nb",
]
NOT_A_LIST = [None, 3, "100", {}, {"a": 1}, [], True]
NOT_A_ROOT = [
    *(None, 3, [], "", ".", "..", "../..", "a/../b", "a/..", "/", ".git", "../.git", "a//b", "a b"),
    *("safemr", "workflow/x", "tests", "examples/x", "a/./b", "C:\\x", "{wildcard}", "résultats"),
    *("$HOME", "~/home", "a\0b", "//x", "/..", "/../x"),
    *(str(ROOT), str(ROOT.parent), str(ROOT / "safemr"), str(ROOT / "tests/x"), str(ROOT / ".git")),
    str(ROOT / "README.md"),
]

# Each value is of its type; with the task (two actions, episodes of 1,000 steps) and the budget
# (1,000 steps) it can only end in absurd numbers or in nothing learned.
HOPELESS: list[dict[str, Any]] = [
    *({"target_entropy": value} for value in [2 * math.log(2), 1.4, 2.0, 1e9]),
    *(
        {name: value}
        for name in ["critic_lr", "policy_lr", "temperature_lr"]
        for value in [2, 1e25]
    ),
    *({"gamma": 1.0}, {"polyak": 1.5}, {"polyak": 0.0}, {"initial_log_temperature": 80.0}),
    *({"constraint_scale": value} for value in [1e-30, 1e30]),
    *({"multiplier_cap": 1e30}, {"sigma": 1e9}, {"n": 200.0}, {"k": 1e9}, {"length_scale": 1e-9}),
    *({"hidden": 10**9}, {"num_envs": 10**6}, {"replay_capacity": 10**10}, {"a": 1e30}),
    *({"batch_size": 1_000, "replay_capacity": 500}, {"n_step": 1_001, "start_steps": 0}),
    *({"start_steps": value} for value in [999, 1_000, 5_000]),
    *({"update_every": 900}, {"updates_together": 500}, {"certificate_delay": 113}),
    {"policy_delay": 200, "multiplier_delay": 200},
]
HOPELESS_EPOCHS: list[dict[str, Any]] = [
    *({"epoch_steps": 2_008}, {"target_kl": 1e6}, {"gamma": 1.0}, {"cost_gamma": 1.0}),
    *(
        {"epoch_steps": 800, name: 2.0}
        for name in ["value_lr", "policy_lr", "multiplier_lr", "clip"]
    ),
    *({"epoch_steps": 800, "initial_log_std": value} for value in [-100.0, 50.0]),
    {"epoch_steps": 800, "multiplier_initial": 1e12},
]

WRONG: dict[tuple[str, ...], list[Any]] = {
    ("tasks",): [
        *NOT_A_LIST,
        *([name] for name in NOT_A_NAME),
        *(["Pillars-0.15-Gaol"], ["pillars-0.15-goal"], ["Pillars-0.15-Goal-v0"], ["CartPole"]),
        ["Pillars-0.15-Goal", "Pillars-0.15-Goal"],
    ],
    ("seeds",): [
        *NOT_A_LIST,
        *([seed] for seed in [*NOT_AN_INTEGER, -1, 2**31, "seed"]),
        *([1, 1], [1, 2, 1], [1, "2"]),
    ],
    ("algorithms",): [
        *(None, {}, *NOT_A_MAPPING),
        *({name: {"algorithm": "fac"}} for name in NOT_A_NAME[2:]),
        *({"X": value} for value in [None, {}, *NOT_A_MAPPING]),
        {"X": {"algoritm": "fac"}},
        *({"X": {"algorithm": name}} for name in [*NOT_A_NAME, "FAC", "safe_mr", "os", "__init__"]),
        {"A": {"algorithm": "fac"}, "a": {"algorithm": "joint_sis"}},
        {
            "A": {"algorithm": "fac", "start_steps": 100},
            "B": {"algorithm": "fac", "n": 2.0, "start_steps": 100},
        },
    ],
    ("algorithms", "SafeMR"): [
        *({"algorithm": "safemr", "gamma": value} for value in [*NOT_A_NUMBER, math.inf, 2, -0.1]),
        *({"algorithm": "safemr", "batch_size": value} for value in NOT_POSITIVE[:-1]),
        *({"algorithm": "safemr", "activation": value} for value in [3, "Elu", None, ["elu"]]),
        *({"algorithm": "safemr", key: 1} for key in ["gama", "Sigma", "lr", "__class__"]),
        *({"algorithm": "safemr", "start_steps": 100, **values} for values in HOPELESS),
        *({"algorithm": "ppo_lagrangian", **values} for values in HOPELESS_EPOCHS),
    ],
    ("budget",): [None, {}, {"off_policy": 1000}, *NOT_A_MAPPING, {"offpolicy": 1000}],
    ("budget", "off_policy"): [*NOT_POSITIVE, 5],
    ("log_points",): [*NOT_POSITIVE, 7],
    ("evaluation",): [None, {}, *NOT_A_MAPPING, {"points": 5}, {"point": 5, "episodes": 2}],
    ("evaluation", "points"): NOT_POSITIVE,
    ("evaluation", "episodes"): NOT_POSITIVE,
    ("evaluation", "seed"): [*NOT_AN_INTEGER, -1, 2**31],
    ("interface",): [
        *(*NOT_A_MAPPING, 0, [], False, {"action_repat": 5}, {3: 1}),
        *({"action_repeat": value} for value in [*NOT_AN_INTEGER, 0, -1, 1_001, 10**30]),
        *({"action_scale": value} for value in [None, 1.0, "0.05", True, {}, [1.0], [0.1] * 3]),
        *({"action_scale": [0.5, value]} for value in [*NOT_A_NUMBER, 0, -0.1, 1.5, math.nan]),
        *({"action_scale": [value, 0.5]} for value in [math.inf, 10**400]),
        *({"decode": value} for value in [None, 3, True, "goal_lidar", "Single", [3], {"a": 1}]),
        *({"decode": [name]} for name in ["pillars_lidar", "goal_ldar", "gyro", "box_lidar", ""]),
        {"decode": ["goal_lidar", "goal_lidar"]},
    ],
    ("task_overrides", "Hazards-0.15-Push", "interface"): [
        *(*NOT_A_MAPPING, {"repeat": 5}, {"action_repeat": 0}, {"action_scale": [0.05]}),
        *({"decode": ["pillars_lidar"]}, {"decode": ["vases_lidar"]}),
    ],
    ("unseen_layouts",): [*NOT_A_MAPPING, {"seed": 1}, {"episode": 5}],
    ("unseen_layouts", "episodes"): NOT_POSITIVE,
    ("unseen_layouts", "seed"): [*NOT_AN_INTEGER, -1, 2**31],
    ("filters",): [*NOT_A_MAPPING, {"policies": ["PPO-L"]}, {"policy": ["PPO-L"]}],
    ("filters", "policies"): [*NOT_A_LIST, ["PPO"], ["PPO-L", "PPO-L"]],
    ("filters", "certificates"): [*NOT_A_LIST, ["phi_1"], ["phi_h", "phi_h"]],
    ("filters", "episodes"): NOT_POSITIVE,
    ("filters", "seed"): [*NOT_AN_INTEGER, -1, 2**31],
    ("filters", "tasks"): [*NOT_A_LIST, ["Pillars-0.30-Goal"]],
    ("filters", "seeds"): [*NOT_A_LIST, [0], [100, 100]],
    ("task_overrides",): [
        *NOT_A_MAPPING,
        *({name: {}} for name in ["Pillar-0.15-Goal", *NOT_A_NAME[2:]]),
    ],
    ("task_overrides", "Hazards-0.15-Push"): [*NOT_A_MAPPING, {"setting": {}}, {"steps": 5}],
    ("task_overrides", "Hazards-0.15-Push", "settings"): [
        *NOT_A_MAPPING,
        *({"sleeep": True}, {"sleep": "yes"}, {"sleep": 1}, {"num_obstacles": 0}, {"name": "x"}),
        *({"obstacle_size": -1.0}, {"obstacle_size": math.nan}, {"extent": datetime.date.today()}),
        *({"max_episode_steps": steps} for steps in (*NOT_POSITIVE, None)),
        # Keywords of Gymnasium, not settings: the first one would train another task.
        *({"task": "Pillars-0.15-Goal"}, {"render_mode": "rgb_array"}, {"num_envs": 4}),
    ],
    ("task_overrides", "Hazards-0.15-Push", "budget"): [
        *(*NOT_A_MAPPING, {"off": 1}, {"on_policy": 0}),
    ],
    ("task_overrides", "Hazards-0.15-Push", "hyperparameters"): [
        *NOT_A_MAPPING,
        *({"off_policy": value} for value in NOT_A_MAPPING),
        *({"offpolicy": {}}, {"off_policy": {"update_evry": 1}}),
        {"off_policy": {"update_every": 0}},
    ],
    ("sensitivity",): [*NOT_A_MAPPING, {"task": "Pillars-0.15-Goal"}, {"point": [[1, 1]]}],
    ("sensitivity", "task"): [*NOT_A_NAME, "Pillars"],
    ("sensitivity", "algorithm"): [*NOT_A_NAME, "safemr", "PPO-L"],
    ("sensitivity", "points"): [
        *(*NOT_A_LIST, [1], [[1]], [[1, 2, 3]], [["a", "b"]], [[-1, 0]], [[1, 1]] * 2),
    ],
    ("aircraft",): [*NOT_A_MAPPING, {"seeds": [1]}, {"task": "Boat"}],
    ("aircraft", "algorithms"): [None, {}, *NOT_A_MAPPING, {"X": {"algorithm": "x"}}],
    ("outside",): [*NOT_A_MAPPING, {"SafeMR": {"algorithm": "x", "steps": 100}}],
    ("outside", "Script"): [
        *(None, {}, *NOT_A_MAPPING, {"algorithm": "x"}, {"algorithm": "x", "step": 1}),
    ],
    ("outside", "Script", "steps"): [*NOT_POSITIVE, 5],
    ("outside", "Script", "hyperparameters"): [
        *NOT_A_MAPPING,
        *({"x": math.nan}, {"x": datetime.date.today()}, {"x": b"bytes"}, {1: 2}),
    ],
    ("results_root",): NOT_A_ROOT,
    ("figures_root",): NOT_A_ROOT,
    ("allow_missing",): ["yes", 1, 0, None, [], "true"],
    ("sizes",): ["yes", 1, 0, None, [], "true"],
    ("wandb",): [None, *NOT_A_MAPPING, {"modes": "online"}],
    ("wandb", "mode"): [None, True, "on", "Online", ["online"], 3],
    ("wandb", "project"): NOT_A_NAME,
    ("safe", "cost_tolerance"): [*NOT_A_NUMBER, -1, math.nan, math.inf],
    ("safe", "zero_violation_share"): [*NOT_A_NUMBER, -0.1, 1.1, math.nan],
    (): [
        *NOT_A_MAPPING,
        *({**VALID, key: 1} for key in ["task", "Seeds", "budgets", "", "results", "é", 3, None]),
        *({k: v for k, v in VALID.items() if k != lost} for lost in list(VALID)[:4]),
    ],
}  # fmt: skip

BAD_TEXTS = {
    "duplicate top-level key": "seeds: [1]\nseeds: [2]\n",
    "duplicate algorithm": "algorithms:\n  A: {algorithm: fac}\n  A: {algorithm: safemr}\n",
    "duplicate hyperparameter": "algorithms: {A: {algorithm: fac, n: 1.0, n: 2.0}}\n",
    "unclosed list": "seeds: [1, 2\n",
    "tab": "seeds:\n\t- 1\n",
    "bad indentation": "budget:\n  off_policy: 1\n on_policy: 2\n",
    "a list": "- tasks\n- seeds\n",
    "a scalar": "tasks\n",
    "two documents": "seeds: [1]\n---\nseeds: [2]\n",
    "python object": "seeds: !!python/object/apply:os.system ['touch hacked']\n",
    "python name": "seeds: !!python/name:os.system\n",
    "unknown anchor": "seeds: *nothing\n",
    "unhashable key": "? [1, 2]\n: 3\n",
    "recursive": "tasks: &a [*a]\n",
    "control character": "seeds: [1]\x07\n",
    "number as key": "3: 4\n",
    "yes as key": "yes: 4\n",
}


def changed(path: tuple[str, ...], value: Any) -> Any:
    """VALID with one place replaced."""
    if not path:
        return value
    result = copy.deepcopy(VALID)
    place = result
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return result


def resolve(raw: Any) -> planning.Plan:
    return planning.resolve(config.parse(raw))


def one_line(error: UserError) -> str:
    text = str(error)
    assert text
    assert text.isascii() or "\n" not in text
    assert len(text.splitlines()) == 1
    assert len(text) < 500
    return text


CASES = [(path, value) for path, values in WRONG.items() for value in values]


def test_enough_distinct_bad_inputs() -> None:
    assert len({(path, repr(value)) for path, value in CASES} | {*BAD_TEXTS}) >= 400


@pytest.mark.parametrize("path", WRONG, ids=lambda path: ".".join(path) or "top")
def test_each_bad_value_is_one_clear_line(
    path: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for value in WRONG[path]:
        with pytest.raises(UserError) as caught:
            resolve(changed(path, value))
        one_line(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", BAD_TEXTS.values(), ids=BAD_TEXTS)
def test_each_bad_file_is_one_clear_line(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        config.load([DEFAULT, path])
    one_line(caught.value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["bad.yaml"]


def test_unreadable_files_are_named(tmp_path: Path) -> None:
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00seeds")
    for path in (tmp_path / "missing.yaml", tmp_path, binary):
        with pytest.raises(UserError, match=path.name):
            config.load([path])


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        ((), {**VALID, "sedes": [1]}, "unknown key 'sedes' in the config; did you mean 'seeds'?"),
        (("tasks",), ["Pillars-0.15-Gaol"], "did you mean 'Pillars-0.15-Goal'?"),
        (("algorithms", "X"), {"algorithm": "safmr"}, "did you mean 'safemr'?"),
        (("algorithms", "X"), {"algorithm": "fac", "gama": 0.9}, "did you mean 'gamma'?"),
        (("algorithms", "X"), {"algorithm": "ppo"}, "did you mean 'ppo_lagrangian'?"),
        (("algorithms", "X"), {"algorithm": "PPO-L"}, "did you mean 'ppo_lagrangian'?"),
        (("algorithms", "X"), {"algorithm": "ppo-l"}, "did you mean 'ppo_lagrangian'?"),
        (("algorithms", "X"), {"algorithm": "trpo"}, "did you mean 'trpo_lagrangian'?"),
        (("algorithms", "X"), {"algorithm": "sac"}, "did you mean 'sac_lagrangian'?"),
        (("algorithms", "X"), {"algorithm": "jointsis"}, "did you mean 'joint_sis'?"),
        (("algorithms", "X"), {"algorithm": "FAC-phih"}, "did you mean 'fac'?"),
        (("algorithms", "X"), {"algorithm": "cop"}, "did you mean 'cpo'?"),
        (("tasks",), ["Pillars"], "did you mean 'Pillars-0.15-Goal' or 'Pillars-0.30-Goal'?"),
        (("tasks",), ["Pillars-0.15-Goal-v0"], "did you mean 'Pillars-0.15-Goal'?"),
        (("sensitivity", "algorithm"), "SafeMT", "did you mean 'SafeMR'?"),
        (("wandb", "mode"), "ofline", "did you mean 'offline'?"),
        (("task_overrides", "Hazards-0.15-Push", "settings"), {"slep": True}, "'slep'"),
        (("interface",), {"action_repat": 5}, "in interface; did you mean 'action_repeat'?"),
        (
            ("task_overrides", "Hazards-0.15-Push", "interface"),
            {"scale": [0.05, 1.0]},
            "in task_overrides.Hazards-0.15-Push.interface; did you mean 'action_scale'?",
        ),
    ],
)
def test_misspelt_names_are_named_with_the_nearest(
    path: tuple[str, ...], value: Any, expected: str
) -> None:
    with pytest.raises(UserError) as caught:
        resolve(changed(path, value))
    assert expected in one_line(caught.value)


@pytest.mark.parametrize(
    ("algorithm", "name", "value", "reason"),
    [
        # The value is the default: what is refused is to set it.
        ("sac_lagrangian", "sigma", 0.3, "a hyperparameter of fac, joint_sis, neural_safemr, s"),
        (
            "sac_lagrangian",
            "constraint_floor",
            -0.001,
            "a hyperparameter of fac, fac_oracle, joint_sis",
        ),
        (
            "cpo",
            "policy_lr",
            3e-4,
            "a hyperparameter of fac, fac_oracle, joint_sis, neural_safemr, ppo_lagran",
        ),
        ("fac", "certificate_travel", 0.33, "a hyperparameter of joint_sis, safemr"),
        ("joint_sis", "a", 0.35, "a hyperparameter of neural_safemr, safemr"),
    ],
)
def test_what_an_algorithm_does_not_use_is_refused_by_name(
    algorithm: str, name: str, value: float, reason: str
) -> None:
    with pytest.raises(UserError) as caught:
        resolve(changed(("algorithms", "X"), {"algorithm": algorithm, name: value}))
    text = one_line(caught.value)
    assert f"algorithms.X: {algorithm} does not use {name}" in text
    assert reason in text


def test_tuning_a_family_to_a_task_skips_whom_it_does_not_concern() -> None:
    """SAC-Lagrangian has no energy, so the unit of its lengths does not stop it."""
    raw = changed(
        ("aircraft", "algorithms", "SAC-L"),
        {"algorithm": "sac_lagrangian", "start_steps": 100, "target_entropy": -1.0},
    )
    raw["task_overrides"]["Aircraft"] = {"hyperparameters": {"off_policy": {"length_scale": 5.0}}}
    lengths = {
        run.variant: run.config["algorithm"]["hyperparameters"].get("length_scale")
        for run in resolve(raw).aircraft
    }
    assert lengths.pop("SAC-L") is None
    assert set(lengths.values()) == {5.0}


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=6,
)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(sorted(WRONG)), anything)
def test_random_values_end_in_a_plan_or_one_line(path: tuple[str, ...], value: Any) -> None:
    try:
        plan = resolve(changed(path, value))
    except UserError as error:
        one_line(error)
    else:
        assert all(".." not in run.path.parts and not run.path.is_absolute() for run in plan.runs)


def test_roots_may_lie_outside_the_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    before = [run.path for run in resolve(VALID).runs]
    for key in ("results_root", "figures_root"):
        for root in ("../up", "../../up/a.b", f"{tmp_path}/away", "/data/safemr", "x/y"):
            parsed = config.parse(changed((key,), root))
            assert getattr(parsed, key) == Path(root)
            assert [run.path for run in planning.resolve(parsed).runs] == before
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="is a file"):
        config.parse(changed(("results_root",), "../file"))
    monkeypatch.chdir(ROOT / "docs")  # the same words from another folder
    with pytest.raises(UserError, match="among the sources"):
        config.parse(changed(("results_root",), "../safemr/x"))


def test_the_grid() -> None:
    plan = resolve(VALID)
    assert len(plan.navigation) == 2 * 2 * 2
    assert len(plan.aircraft) == 1
    assert len(plan.outside) == 2 * 2
    assert plan.points == {"SafeMR": (0.35, 0.15), "SafeMR[0.45,0.15]": (0.45, 0.15)}
    # The first point is the headline variant itself: not a run of its own.
    assert len(plan.trained) == 8 + 1 + 1
    push = next(run for run in plan.navigation if run.task == "Hazards-0.15-Push")
    assert push.config["steps"] == 3000
    assert push.config["task"]["settings"] == {"sleep": True}
    assert push.config["algorithm"]["hyperparameters"]["update_every"] == 16
    assert push.config["log_every"] == 300
    assert push.config["evaluation"] == {"every": 600, "episodes": 2, "seed": 10000}


def test_a_variant_stands_above_the_tuning_of_a_task() -> None:
    raw = changed(("algorithms", "SafeMR", "update_every"), 4)
    plan = resolve(raw)
    values = {
        run.task: run.config["algorithm"]["hyperparameters"]["update_every"]
        for run in plan.navigation
        if run.variant == "SafeMR"
    }
    assert set(values.values()) == {4}


def test_a_variant_may_have_seeds_of_its_own() -> None:
    plan = resolve(changed(("algorithms", "PPO-L", "seeds"), [101, 105]))
    seeds = {
        variant: {run.seed for run in plan.navigation if run.variant == variant}
        for variant in ("SafeMR", "PPO-L")
    }
    assert seeds == {"SafeMR": set(VALID["seeds"]), "PPO-L": {101, 105}}
    for wrong in ([], [1, 1], "0-4", [-1]):
        with pytest.raises(UserError, match=r"algorithms\.PPO-L\.seeds"):
            resolve(changed(("algorithms", "PPO-L", "seeds"), wrong))


CHANGES: list[tuple[tuple[str, ...], Any, int]] = [
    (("algorithms", "PPO-L", "seeds"), [101, 105], 2),  # one more on each of two tasks
    (("seeds",), [100, 102], 4 + 2),  # two tasks x two algorithms, one outside variant on two
    (("budget", "on_policy"), 2500, 4),
    (("budget", "off_policy"), 1100, 2 + 1 + 1),  # Pillars, its point, the aircraft
    (("algorithms", "SafeMR", "gamma"), 0.98, 4 + 1),
    (("algorithms", "PPO-L", "gamma"), 0.98, 4),
    (("task_overrides", "Hazards-0.15-Push", "settings", "sleep"), False, 4 + 2),
    (("sensitivity", "points"), [[0.45, 0.15], [0.5, 0.5]], 1),
    (("outside", "Script", "version"), 2, 4),
    (("evaluation", "episodes"), 3, 14),
    (("interface",), {"action_repeat": 2}, 13),  # all but the aircraft's
    (("task_overrides", "Hazards-0.15-Push", "interface"), {"action_repeat": 2}, 4 + 2),
    (("interface",), {"action_repeat": 1}, 0),
    (("unseen_layouts", "episodes"), 50, 0),
    (("filters", "episodes"), 50, 0),
    (("sizes",), True, 0),
    (("wandb", "mode"), "offline", 0),
    (("safe", "cost_tolerance"), 2.0, 0),
    (("figures_root",), "elsewhere", 0),
]


@pytest.mark.parametrize(("path", "value", "count"), CHANGES, ids=lambda item: str(item)[:40])
def test_a_change_makes_exactly_the_runs_it_touches_new(
    path: tuple[str, ...], value: Any, count: int
) -> None:
    before = {run.path for run in resolve(VALID).runs}
    after = {run.path for run in resolve(changed(path, value)).runs}
    assert len(before) == 14
    assert len(after - before) == count


PUSH = "Hazards-0.15-Push"
HELD = {"action_repeat": 5, "action_scale": [0.05, 1], "decode": "single"}


def met(raw: Any) -> dict[str, Any]:
    """Task -> the interface of its runs, None where their configs have none."""
    found: dict[str, list[Any]] = {}
    for run in resolve(raw).runs:
        found.setdefault(run.task, []).append(run.config.get("interface"))
    assert all(entry == entries[0] for entries in found.values() for entry in entries)
    return {task: entries[0] for task, entries in found.items()}


def test_an_interface_is_that_of_every_run_of_the_tasks_with_its_lidars_named() -> None:
    entry = {"action_repeat": 5, "action_scale": [0.05, 1.0]}
    assert met(changed(("interface",), HELD)) == {
        "Pillars-0.15-Goal": {**entry, "decode": ["goal_lidar"]},  # of four pillars no bearing
        PUSH: {**entry, "decode": ["box_lidar", "goal_lidar", "hazards_lidar"]},
        "Aircraft": None,
    }
    # The task of the sensitivity study is met like `tasks`, though it be none of them.
    elsewhere = changed(("sensitivity", "task"), "Pillars-0.30-Goal")
    elsewhere["interface"] = {"action_repeat": 2}
    assert met(elsewhere)["Pillars-0.30-Goal"] == {"action_repeat": 2}


def test_a_tasks_own_interface_replaces_the_common_one_wholly() -> None:
    raw = changed(("task_overrides", PUSH, "interface"), {"action_repeat": 2})
    raw["task_overrides"]["Aircraft"] = {"interface": {"action_scale": [0.5]}}
    assert met(raw) == {
        "Pillars-0.15-Goal": None,
        PUSH: {"action_repeat": 2},
        "Aircraft": {"action_scale": [0.5]},
    }
    raw["interface"] = HELD
    assert met(raw)[PUSH] == {"action_repeat": 2}
    for nothing in (None, {}, {"action_repeat": 1, "action_scale": [], "decode": []}):
        raw["task_overrides"][PUSH]["interface"] = nothing
        assert met(raw)[PUSH] is None
    del raw["task_overrides"][PUSH]["interface"]
    assert met(raw)[PUSH] is not None


def test_an_interface_that_changes_nothing_leaves_digests_as_they_are() -> None:
    before = {run.path for run in resolve(VALID).runs}
    default = {"action_repeat": 1, "action_scale": [], "decode": []}
    for nothing in (None, {}, default):
        assert {run.path for run in resolve(changed(("interface",), nothing)).runs} == before
    spelled = changed(("interface",), {**HELD, "action_scale": [0.05, 1.0]})
    paths = {run.path for run in resolve(changed(("interface",), HELD)).runs}
    assert paths == {run.path for run in resolve(spelled).runs}
    aircraft = {path for path in before if "Aircraft" in path.parts}
    assert paths & before == aircraft


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"action_repat": 5}, "did you mean 'action_repeat'?"),
        ({"action_repeat": 0}, "interface.action_repeat must be an integer of at least 1, not 0"),
        ({"action_repeat": 2.5}, "interface.action_repeat must be an integer"),
        ({"action_repeat": True}, "interface.action_repeat must be an integer"),
        ({"action_repeat": 1001}, "must not exceed the 1000 steps of an episode"),
        ({"action_scale": [0.05]}, "interface.action_scale must have 2 numbers"),
        ({"action_scale": [0, 1]}, "interface.action_scale must be numbers in (0, 1], not [0, 1]"),
        ({"action_scale": [-0.1, 1]}, "interface.action_scale must be numbers in (0, 1]"),
        ({"action_scale": "small"}, "one number in (0, 1] for each component of an action"),
        ({"decode": ["pillars_lidar"]}, "task Pillars-0.15-Goal: interface.decode: pillars_lidar"),
        ({"decode": ["goal_ldar"]}, "those are goal_lidar"),
        ({"decode": "all"}, "must be a list of lidars or 'single', not 'all'"),
    ],
)
def test_what_is_wrong_with_an_interface_is_said_with_the_remedy(
    entry: dict[str, Any], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = {**VALID, "task_overrides": {}, "interface": entry}
    with pytest.raises(UserError) as caught:
        resolve(raw)
    assert said in one_line(caught.value)
    ((name, value),) = entry.items()
    command = ["--task", "Pillars-0.15-Goal", "--algorithm", "fac", "--set"]
    assert train.main([*command, f"interface.{name}={value}"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said.replace("interface.", "--set interface.") in line


def test_an_interface_of_a_task_without_runs_is_checked_too() -> None:
    raw = changed(("task_overrides", "Hazards-0.30-Push"), {"interface": {"action_scale": [1.0]}})
    with pytest.raises(UserError, match=r"task Hazards-0\.30-Push: task_overrides"):
        resolve(raw)


def test_the_command_line_sets_an_interface_like_a_configuration() -> None:
    settings = [f"interface.{name}={value}" for name, value in HELD.items()]
    command = ["--task", PUSH, "--algorithm", "fac", "--steps", "10000"]
    for setting in settings:
        command += ["--set", setting]
    run, _ = train.resolve(train._parse(command))
    assert run["interface"] == met(changed(("interface",), HELD))[PUSH]
    run, _ = train.resolve(train._parse([*command[:6], "--set", "interface.action_repeat=1"]))
    assert "interface" not in run


def test_equal_settings_have_equal_digests() -> None:
    spelled_out = changed(("algorithms", "SafeMR", "a"), 0.35)
    spelled_out["algorithms"]["SafeMR"]["gamma"] = 0.99  # the default
    spelled_out["algorithms"]["SafeMR"]["temperature_lr"] = 3e-4
    assert {r.path for r in resolve(spelled_out).runs} == {r.path for r in resolve(VALID).runs}


def test_version_bumps_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    before = {run.path for run in resolve(VALID).runs}
    module = importlib.import_module("safemr.algorithms.ppo_lagrangian")
    monkeypatch.setattr(module, "VERSION", module.VERSION + 1)
    planning.load_algorithm.cache_clear()
    after = {run.path for run in resolve(VALID).runs}
    planning.load_algorithm.cache_clear()
    assert {path.parts[2] for path in after - before} == {"PPO-L"}
    assert len(after - before) == 4


def test_later_files_replace_whole_sections(tmp_path: Path) -> None:
    overlay = tmp_path / "overlay.yaml"
    overlay.write_text("algorithms: {Mine: {algorithm: fac, critic_lr: 1e-3}}\nsensitivity: null\n")
    loaded = config.load([DEFAULT, overlay], {"seeds": [7]})
    as_text = config.load([DEFAULT], {"seeds": ["7"], "allow_missing": "true"})
    assert as_text.seeds == (7,)
    assert as_text.allow_missing
    assert list(loaded.algorithms) == ["Mine"]
    assert loaded.algorithms["Mine"].overrides == {"critic_lr": 0.001}
    assert loaded.seeds == (7,)
    assert loaded.tasks == config.load([DEFAULT]).tasks


def test_points_make_a_map_when_they_are_all_pairs():
    nine = [(a, b) for a in (0.1, 0.2, 0.3) for b in (0.1, 0.2, 0.3)]
    for points, expected in ((nine, True), (nine[:8], False), (nine[:6], False)):
        assert config.Sensitivity("task", "SafeMR", tuple(points), (0,)).is_map is expected
    assert config.load([DEFAULT, ROOT / "config/map.yaml"]).sensitivity.is_map


@pytest.mark.parametrize("path", sorted((ROOT / "config").glob("*.yaml")), ids=lambda p: p.stem)
def test_every_shipped_config_is_valid(path: Path) -> None:
    assert resolve(yaml.load(path.read_text(), StrictLoader)).runs


@pytest.mark.parametrize(
    "path", sorted({*(ROOT / "config").glob("*.yaml")} - {DEFAULT}), ids=lambda path: path.stem
)
def test_a_shipped_configuration_is_read_by_a_protocol_of_its_own(path: Path) -> None:
    """What it says nothing of is the default's: another default would judge its runs otherwise."""
    assert {"protocol", "sizes"} <= yaml.safe_load(path.read_text()).keys()


def test_settings_of_a_family_without_an_algorithm_set_nothing(tmp_path: Path) -> None:
    """Someone's own algorithms over a file whose tasks have settings for both families."""
    hyperparameters = {"off_policy": {"update_every": 16}, "on_policy": {"gamma": 0.98}}
    base, overlay = tmp_path / "base.yaml", tmp_path / "mine.yaml"
    overrides = {"Hazards-0.15-Push": {"hyperparameters": hyperparameters}}
    both = {**VALID, "task_overrides": overrides, "aircraft": None, "sensitivity": None}
    both.pop("filters")
    base.write_text(yaml.safe_dump(both))
    for mine in (
        {"algorithm": "joint_sis", "start_steps": 100},
        {"algorithm": "cpo", "epoch_steps": 800},
    ):
        overlay.write_text(yaml.safe_dump({"algorithms": {"Mine": mine}}))
        assert planning.resolve(config.load([base, overlay])).runs
    hyperparameters["off_policy"]["upadte_every"] = 16  # CPO does not read it, but it is none
    base.write_text(yaml.safe_dump(both))
    with pytest.raises(UserError, match=r"'upadte_every' in task_overrides.*off_policy"):
        planning.resolve(config.load([base, overlay]))


def test_the_default_is_the_papers_grid_and_two_certificates_more() -> None:
    plan = planning.resolve(config.load([DEFAULT]))
    beside = {"FAC-oracle", "SafeMR-guarded"}  # the two are not the paper's
    papers = [run for run in plan.navigation if run.variant not in beside]
    assert len(papers) == 7 * 4 * 5
    assert len(plan.navigation) == 140 + 2 * 4 * 5
    assert len(plan.aircraft) == 4 * 10
    assert len(plan.trained) == 180 + 2 * 5 + 40
    assert plan.seeds_told == "0 to 4"


def test_captions_tell_whose_seeds_are_others() -> None:
    raw = yaml.load(DEFAULT.read_text(), StrictLoader)
    for name in ("FAC-oracle", "SafeMR-guarded"):
        raw["algorithms"][name]["seeds"] = [0, 2]
    told = planning.resolve(config.parse(raw)).seeds_told
    assert told == "0 to 4 (FAC-oracle, SafeMR-guarded: 0, 2)"


def test_plans_are_remembered_until_something_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    calls = []
    real = planning.resolve
    monkeypatch.setattr(planning, "resolve", lambda c: calls.append(c) or real(c))
    first = plan_for(config.parse(VALID))
    assert plan_for(config.parse(VALID)) == first
    assert len(calls) == 1
    plan_for(config.parse(changed(("seeds",), [5])))
    assert len(calls) == 2
    held = config.parse(changed(("interface",), HELD))
    assert plan_for(held) == plan_for(held) == real(held)
    assert len(calls) == 3
    (tmp_path / "results/.work/plan.json").write_text("{")
    assert plan_for(config.parse(VALID)) == first
    assert len(calls) == 4


def test_sizes_are_drawn_against_flights_on_unseen_layouts() -> None:
    assert config.parse(VALID | {"sizes": True}).sizes
    with pytest.raises(UserError, match="say unseen_layouts, too"):
        config.parse(VALID | {"sizes": True, "unseen_layouts": None})


def test_sizes_may_stand_beside_those_of_another_root() -> None:
    assert config.parse(VALID | {"sizes": True}).sizes_beside is None
    elsewhere = VALID | {"results_root": "results/mine"}
    both = config.parse(elsewhere | {"sizes": {"beside": "results"}})
    assert both.sizes
    assert both.sizes_beside == Path("results")
    with pytest.raises(UserError, match="own results_root"):
        config.parse(VALID | {"sizes": {"beside": "results"}, "results_root": "results"})
    for wrong in ({}, {"besides": "results"}, {"beside": ""}, {"beside": "config"}, "yes"):
        with pytest.raises(UserError, match="sizes"):
            config.parse(VALID | {"sizes": wrong})


def with_own_seeds(**changes: Any) -> dict[str, Any]:
    """`VALID`, SafeMR with seeds of its own."""
    algorithms = VALID["algorithms"] | {"SafeMR": {"algorithm": "safemr", "seeds": [100, 102]}}
    return VALID | {"algorithms": algorithms, "sensitivity": None, **changes}


def test_filters_take_the_seeds_of_what_they_name() -> None:
    filters = {"policies": ["SafeMR"], "certificates": ["phi_h"], "episodes": 3}
    read = config.parse(with_own_seeds(filters=filters)).filters
    assert read is not None
    assert read.seeds == (100, 102)
    some = config.parse(with_own_seeds(filters=filters | {"seeds": [102]})).filters
    assert some is not None
    assert some.seeds == (102,)
    with pytest.raises(UserError, match=r"unknown seed 101 in filters\.seeds"):
        config.parse(with_own_seeds(filters=filters | {"seeds": [101]}))
    both = config.parse(with_own_seeds(filters=filters | {"policies": ["SafeMR", "PPO-L"]})).filters
    assert both is not None
    assert both.seeds == (100, 101, 102)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"unseen_layouts": {"episodes": 3, "seed": 9998}}, "unseen_layouts would fly"),
        ({"unseen_layouts": {"episodes": 100, "seed": 0, "own": True}}, "own: seed 100 would"),
        ({"unseen_layouts": {"episodes": 98, "seed": 0, "own": True}}, "own: seed 102 would"),
        ({"filters": VALID["filters"] | {"seed": 10_001}}, "filters would fly"),
    ],
)
def test_unseen_layouts_are_not_those_of_evaluations(changes: dict[str, Any], said: str) -> None:
    """Evaluations are on layouts 10,000 and 10,001; seeds are 100 to 102."""
    with pytest.raises(UserError, match=said):
        config.parse(with_own_seeds(**changes))
    config.parse(with_own_seeds(unseen_layouts={"episodes": 3, "seed": 10_002}))
    config.parse(with_own_seeds(unseen_layouts={"episodes": 3, "seed": 9_997}))


def test_layouts_of_seeds_of_an_entry_must_be_there_too() -> None:
    algorithms = VALID["algorithms"] | {"SafeMR": {"algorithm": "safemr", "seeds": [30_000_000]}}
    own = {"unseen_layouts": {"episodes": 100, "own": True}, "sensitivity": None, "filters": None}
    with pytest.raises(UserError, match="seed 30000000 would fly layouts up to"):
        config.parse(VALID | own | {"algorithms": algorithms})
