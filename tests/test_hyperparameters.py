"""Every hyperparameter does something, or is refused by name; each has a meaning to be shown."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import re
import subprocess
import sys
import typing
from pathlib import Path
from typing import Any

import pytest
import torch
from toy import envs_for

from safemr.errors import UserError
from safemr.experiment import catalogue, listing, planning, train
from safemr.learning import hyperparameters

ROOT = Path(__file__).resolve().parents[1]
STEPS = 800
SMALL: dict[str, dict[str, Any]] = {
    "off_policy": {
        **{"num_envs": 4, "hidden": 8, "batch_size": 16, "start_steps": 100, "update_every": 4},
        **{"replay_capacity": 200, "certificate_travel": 3.0, "certificate_start": 0.1},
    },
    "on_policy": {"num_envs": 4, "hidden": 8, "epoch_steps": 200, "value_batch": 100},
}
# Values that make themselves felt in so short a run; half of the default where none stands here.
OTHER: dict[str, list[Any]] = {
    **{"activation": ["elu"], "n_step": [3], "replay_capacity": [100], "start_steps": [200]},
    **{"multiplier_cap": [0.01], "multiplier_grad_norm": [1e-4], "constraint_floor": [-0.5]},
    **{"eta": [0.5], "gamma": [0.5], "policy_delay": [1], "lr_final": [0.9], "a": [0.1]},
    **{"num_envs": [8, 2], "multiplier_delay": [8], "updates_together": [2]},
    **{"sigma_min": [0.3], "k_min": [1.0], "certificate_start": [0.5]},
    **{"cost_rate_limit": [0.5], "cost_limit": [10.0], "kl_stop": [0.01], "clip": [0.01]},
    **{"target_kl": [1e-4, 1.0], "cost_tolerance": [10.0], "backtrack_iterations": [1]},
    **{"multiplier_initial": [9.0], "policy_passes": [1], "policy_batch": [50]},
    **{"backtrack_factor": [0.1], "epoch_steps": [400], "conjugate_gradient_iterations": [1]},
}
# What needs other settings to be felt.
BESIDE: dict[str, dict[str, Any]] = {
    "backtrack_factor": {"target_kl": 1.0},  # the line search has to refuse a step
    "backtrack_iterations": {"target_kl": 1.0},
    "target_kl": {"policy_lr": 0.01},  # PPO has to reach the bound
    "kl_stop": {"policy_lr": 0.01},
    **{f"explore_{what}": {"explore_share": 0.5} for what in ("hold_min", "hold_max", "until")},
    "certificate_derivative": {"sigma": 0.9, "a": 0.1},  # the point has to enter the unsafe set
}
# No loss can raise sigma, and k and n move little: these bounds of the box refuse a start beyond.
BOUNDS_OF_THE_START = {"sigma_max": 0.2, "k_max": 0.2, "n_min": 3.0, "n_max": 0.2}
ELSEWHERE = (
    "device",  # says where the numbers are made, not which
    *("family", "start", "family_version"),  # tests/test_your_certificate.py has another family
)


def small(algorithm: catalogue.Algorithm) -> dict[str, Any]:
    """The settings of a short run that an algorithm has."""
    names = {field.name for field in dataclasses.fields(algorithm.hyperparameters)}
    return {k: v for k, v in SMALL[algorithm.family].items() if k in names}


def trained(algorithm: catalogue.Algorithm, values: dict[str, Any]) -> torch.Tensor:
    """The policy's parameters after a short training on the toy task, unchecked values allowed."""
    config = algorithm.hyperparameters(**small(algorithm))
    for name, value in values.items():
        object.__setattr__(config, name, value)
    trainer = algorithm.trainer(config, envs_for(algorithm.name), 0, STEPS)
    trainer.advance(STEPS)
    return trainer.policy.network.parameters.detach().clone()


def candidates(algorithm: catalogue.Algorithm, name: str) -> list[Any]:
    """Other values of a hyperparameter."""
    hint = typing.get_type_hints(algorithm.hyperparameters)[name]
    names = {field.name: field.default for field in dataclasses.fields(algorithm.hyperparameters)}
    default = SMALL[algorithm.family].get(name, names[name])
    if name in OTHER:
        return OTHER[name]
    if typing.get_origin(hint) is typing.Literal:
        return [value for value in typing.get_args(hint) if value != default]
    assert isinstance(default, (int, float)), f"say in OTHER what else {name} may be"
    return [type(default)(default / 2 if default else 0.5)]


def accepted(algorithm: catalogue.Algorithm, values: dict[str, Any]) -> bool:
    with contextlib.suppress(UserError):
        catalogue.hyperparameters(algorithm, small(algorithm) | values, "test")
        return True
    return False


FIELDS = {
    (name, field.name)
    for name in planning.algorithm_names()
    for field in dataclasses.fields(planning.load_algorithm(name).hyperparameters)
}


@pytest.mark.slow
@pytest.mark.parametrize("name", planning.algorithm_names())
def test_every_hyperparameter_changes_the_numbers_or_is_refused(name: str) -> None:
    algorithm = planning.load_algorithm(name)
    reference = {"": trained(algorithm, {})}
    silent = []
    for field in sorted(field for owner, field in FIELDS if owner == name):
        if field in ELSEWHERE or field in BOUNDS_OF_THE_START:
            continue
        beside = {k: v for k, v in BESIDE.get(field, {}).items() if (name, k) in FIELDS}
        base = reference.setdefault(str(beside or ""), trained(algorithm, beside))
        tried = [{**beside, field: value} for value in candidates(algorithm, field)]
        allowed = [values for values in tried if accepted(algorithm, values)]
        changes = [not torch.equal(trained(algorithm, values), base) for values in allowed]
        if allowed and not any(changes):
            silent.append(field)
    assert not silent, f"{name} accepts {', '.join(silent)} and does not use them: see UNUSED"


@pytest.mark.parametrize("name", planning.algorithm_names())
def test_what_is_declared_unused_is_so_and_cannot_be_set(name: str) -> None:
    algorithm = planning.load_algorithm(name)
    ignored = hyperparameters.unused(algorithm.hyperparameters)
    if not ignored:
        return
    reference = trained(algorithm, {})
    for field in ignored:
        assert torch.equal(trained(algorithm, {field: 0.7}), reference), field
        default = getattr(algorithm.hyperparameters(), field)
        for value in (default, 0.7):
            with pytest.raises(UserError, match=f"{name} does not use {field}"):
                catalogue.hyperparameters(algorithm, {field: value}, "test")
        with pytest.raises(UserError, match=field):
            algorithm.hyperparameters(**{field: -0.7})
        # It stays in the resolved settings: digests of records do not move.
        assert catalogue.hyperparameters(algorithm, {}, "test")[field] == default


# Fields that came after runs had been recorded, with the default that those runs had.
ADDED = {
    "off_policy": {
        "explore_share": 0.0,
        "explore_hold_min": 3,
        "explore_hold_max": 15,
        "explore_until": 0.8,
    },
    "on_policy": {"backend": "torch"},
}
OF_ENERGIES = {"record_critic": False}  # where phi is what the constraint critic learns
OF_FAMILIES = {"family": "paper", "start": (), "family_version": 0}


@pytest.mark.parametrize("name", planning.algorithm_names())
def test_what_came_later_is_resolved_only_where_it_is_set(name: str) -> None:
    algorithm = planning.load_algorithm(name)
    config, added = algorithm.hyperparameters(), ADDED[algorithm.family]
    added = {**added, **({**OF_ENERGIES, **OF_FAMILIES} if algorithm.certificate else {})}
    assert {field: getattr(config, field) for field in added} == added
    plain = catalogue.hyperparameters(algorithm, {}, "test")
    assert plain == {k: v for k, v in dataclasses.asdict(config).items() if k not in added}
    assert catalogue.hyperparameters(algorithm, added, "test") == plain
    for field, default in added.items():
        if field in OF_FAMILIES:  # tests/test_your_certificate.py
            continue
        if isinstance(default, str):
            other: Any = {"backend": "fused"}[field]
        elif isinstance(default, bool):
            other = not default
        else:
            other = default / 2 if isinstance(default, float) and default else default + 1
        changed = catalogue.hyperparameters(algorithm, {field: other}, "test")
        assert changed == {**plain, field: other}


def test_settings_of_the_records_are_what_is_resolved_today() -> None:
    """As many keys and the same values: the same digests, so nothing is trained anew."""
    seen = set()
    for path in ROOT.glob("results/**/config.json"):
        recorded = json.loads(path.read_text())["algorithm"]
        if recorded["name"] in planning.algorithm_names():
            algorithm = planning.load_algorithm(recorded["name"])
            values = recorded["hyperparameters"]
            if recorded["version"] == algorithm.version:
                again = {k: v for k, v in values.items() if k in algorithm.settable}
                assert catalogue.hyperparameters(algorithm, again, path.as_posix()) == values
                seen.add(algorithm.name)
    assert seen >= {"safemr", "joint_sis", "fac", "neural_safemr"}
    assert seen >= {"ppo_lagrangian", "trpo_lagrangian", "cpo"}


@pytest.mark.parametrize("name", ["joint_sis", "safemr"])
def test_the_box_refuses_a_start_outside(name: str) -> None:
    for bound, value in BOUNDS_OF_THE_START.items():
        with pytest.raises(UserError, match=rf"^{bound.partition('_')[0]} = "):
            planning.load_algorithm(name).hyperparameters(**{bound: value})


@pytest.mark.parametrize(
    ("value", "interval", "expected"),
    [
        (0, "(0, 1]", False),
        (1, "(0, 1]", True),
        (0, "[0, 1)", True),
        (1, "[0, 1)", False),
        (1e12, "[0, inf)", True),
        (-float("inf"), "[-inf, 0]", True),
        (float("nan"), "[0, 1]", False),
    ],
)
def test_intervals(value: float, interval: str, expected: bool) -> None:
    assert hyperparameters.within(value, interval) is expected


@pytest.mark.parametrize("name", planning.algorithm_names())
def test_every_number_has_a_range_and_every_default_lies_in_it(name: str) -> None:
    config = planning.load_algorithm(name).hyperparameters
    ranges = hyperparameters.declared(config, "RANGES")
    hints = typing.get_type_hints(config)
    for field in dataclasses.fields(config):
        if hints[field.name] in (int, float):
            assert hyperparameters.within(field.default, ranges[field.name]), field.name


@pytest.mark.parametrize("name", planning.algorithm_names())
def test_every_hyperparameter_has_a_meaning(name: str) -> None:
    found = hyperparameters.meanings(planning.load_algorithm(name).hyperparameters)
    assert not [field for field, meaning in found.items() if len(meaning) < 8]


def test_where_a_meaning_is_read() -> None:
    @dataclasses.dataclass(frozen=True)
    class Parent(hyperparameters.Hyperparameters):
        # Heading

        first: float = 1.0  # behind # it
        # above it,
        # in two lines
        second: float = 2.0
        third: float = 3.0

    @dataclasses.dataclass(frozen=True)
    class Child(Parent):
        second: float = 5.0  # the child's

    assert hyperparameters.meanings(Parent) == {
        "first": "behind # it",
        "second": "above it, in two lines",
        "third": "",
    }
    assert hyperparameters.meanings(Child)["second"] == "the child's"
    assert hyperparameters.meanings(Child)["first"] == "behind # it"


# --- safemr list ----------------------------------------------------------------------------------


def test_the_overview_names_every_task_and_algorithm(capsys: pytest.CaptureFixture[str]) -> None:
    assert listing.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    for task in planning.task_names():
        (line,) = (line for line in lines if line.split()[:1] == [task])
        assert re.search(r"\d obstacles?, d_min [\d.]+ m, episodes of [\d,]+ steps", line)
    for file in (ROOT / "config").glob("*.yaml"):
        (line,) = (line for line in lines if line.split()[:1] == [file.name])
        assert len(line.split()) > 2
    for name in planning.algorithm_names():
        (line,) = (line for line in lines if line.split()[:1] == [name])
        assert line.split()[1] == planning.load_algorithm(name).family
        assert len(line.split()) > 4  # a description


def test_an_algorithm_is_listed_with_type_default_and_meaning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert listing.main(["safemr", "sac_lagrangian"]) == 0
    ours, other = capsys.readouterr().out.split("\n\n")
    config = planning.load_algorithm("safemr").hyperparameters
    for field, meaning in hyperparameters.meanings(config).items():
        default = next(f.default for f in dataclasses.fields(config) if f.name == field)
        assert f"  {field} " in ours
        assert f" = {default}\n" in ours
        assert meaning.split()[0] in ours
    assert "fused | torch = fused" in ours
    assert "  cost_rate_limit " in other
    assert "sigma " not in other, "it has no energy function"
    assert listing.main(["--all"]) == 0
    printed = capsys.readouterr().out
    assert all(f"{name} (o" in printed for name in planning.algorithm_names())
    with pytest.raises(UserError, match="did you mean 'ppo_lagrangian'"):
        listing.main(["ppo"])


def test_a_task_is_listed_with_its_settings(capsys: pytest.CaptureFixture[str]) -> None:
    assert listing.main(["Hazards-0.30-Push", "Aircraft"]) == 0
    push, aircraft = capsys.readouterr().out.split("\n\n")
    for name, value in (("obstacle_size", "0.3"), ("max_episode_steps", "1000")):
        assert re.search(rf"^  {name} += {value}$", push, re.MULTILINE)
    assert "MuJoCo's sleep flag" in push
    assert re.search(r"^  max_episode_steps +(= 200)$", aircraft, re.MULTILINE)
    with pytest.raises(UserError, match=r"unknown task 'Hazards-0\.31-Push'.*did you mean"):
        listing.main(["Hazards-0.31-Push"])


def test_the_help_of_train_says_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        train.main(["--help"])
    assert ended.value.code == 0
    printed = "".join(capsys.readouterr().out.split())
    for name in (*planning.task_names(), *planning.algorithm_names(), "safemrlist"):
        assert name in printed, name


def test_the_help_of_safemr_imports_nothing_heavy() -> None:
    program = (
        "import sys; from safemr import cli; cli.main(['--help']); "
        "print([m for m in ('torch', 'mujoco', 'gymnasium', 'numpy') if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "safemr list" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"
