"""What a variant is in a comparison follows from its algorithm or its entry, not from its label."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from safemr import paper
from safemr.errors import UserError
from safemr.experiment import catalogue, config, plan_cache, planning
from safemr.experiment.strict_yaml import read_yaml
from safemr.report import aircraft as aircraft_tables
from safemr.report import tables, unseen_layouts
from safemr.report.figures import aircraft
from tests.sample_scores import score_rows

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = read_yaml(ROOT / "config/config.yaml")
TASK = "Pillars-0.15-Goal"
RENAMED = {
    "Plain": {"algorithm": "sac_lagrangian"},
    "Ours": {"algorithm": "safemr"},
    "Ours-0": {"algorithm": "joint_sis"},
    "By-hand": {"algorithm": "fac", "sigma": 0.0, "k": 0.0, "n": 1.0},
}


def plan_of(algorithms: dict[str, Any], **changes: Any) -> planning.Plan:
    raw = copy.deepcopy(DEFAULT) | {"algorithms": algorithms, "tasks": [TASK], "sensitivity": None}
    raw["task_overrides"] = {}
    return planning.resolve(config.parse(raw | {"aircraft": None, "seeds": [0]} | changes))


def test_the_default_grid_has_the_roles_of_the_paper() -> None:
    plan = planning.resolve(config.parse(DEFAULT))
    assert plan.grid.of("method") == [paper.METHOD, "FAC-oracle", "SafeMR-guarded"]
    assert plan.grid.of("ablation") == [paper.ABLATION]
    assert plan.grid.of("handcrafted") == ["FAC-phi0", "FAC-phih"]
    assert plan.grid.of("baseline") == [*paper.CMDP_BASELINES]
    assert plan.grid.rivals == [*paper.BASELINES]
    assert plan.grid.pair() == plan.encounter.pair() == [paper.METHOD, paper.ABLATION]
    assert plan.grid.learned == [paper.METHOD, paper.ABLATION, "SafeMR-guarded"]
    assert plan.encounter.of("handcrafted") == ["FAC-phi0", "FAC-phih"]


def test_every_algorithm_has_a_role_and_says_what_it_learns() -> None:
    found = {
        name: (algorithm.role, algorithm.learns, algorithm.certificate)
        for name in planning.algorithm_names()
        for algorithm in (planning.load_algorithm(name),)
    }
    assert found == {
        **dict.fromkeys(("safemr", "safemr_guarded"), ("method", "zeta", "energy")),
        "joint_sis": ("ablation", "zeta", "energy"),
        "neural_safemr": ("method", "network", "neural"),
        **dict.fromkeys(("fac", "fac_oracle"), ("handcrafted", "nothing", "energy")),
        **dict.fromkeys(
            ("cpo", "ppo_lagrangian", "trpo_lagrangian", "sac_lagrangian"),
            ("baseline", "nothing", None),
        ),
    }


def test_labels_mean_nothing() -> None:
    plan = plan_of(RENAMED)
    assert plan.grid.first("method", "none") == "Ours"
    assert plan.grid.rivals == ["Plain", "Ours-0", "By-hand"]
    assert plan.grid.learned == plan.grid.pair() == ["Ours", "Ours-0"]
    swapped = plan_of({"SafeMR": RENAMED["Plain"], "JointSIS": RENAMED["Ours"]})
    assert swapped.grid.of("method") == ["JointSIS"]
    assert swapped.grid.rivals == ["SafeMR"]
    assert plan_of({"PPO-L": {"algorithm": "ppo_lagrangian"}}).grid.pair() == []


def test_an_entry_may_say_its_role_which_changes_no_record() -> None:
    said = copy.deepcopy(RENAMED)
    said["Plain"]["role"], said["Ours"]["role"] = "method", "baseline"
    plain, changed = plan_of(RENAMED), plan_of(said)
    assert changed.grid.of("method") == ["Plain"]
    assert changed.grid.learned == ["Ours", "Ours-0"]  # what is learned is the algorithm's
    assert [run.digest for run in changed.runs] == [run.digest for run in plain.runs]
    assert "role" not in json.dumps([run.config for run in changed.runs])


def test_an_entry_outside_is_neither_method_nor_learned() -> None:
    outside = {"CEM": {"algorithm": "cross_entropy", "steps": 4000}}
    plan = plan_of({"Ours": {"algorithm": "safemr"}}, outside=outside)
    assert plan.grid.of("outside") == plan.grid.rivals == ["CEM"]
    assert plan.grid.learned == ["Ours"]


@pytest.mark.parametrize("role", ["methd", "outside", "", None, 3, ["method"]])
def test_an_unknown_role_is_one_line(role: Any) -> None:
    with pytest.raises(UserError) as caught:
        plan_of({"Ours": {"algorithm": "safemr", "role": role}})
    line = str(caught.value)
    assert line.startswith("unknown role ")
    assert "algorithms.Ours" in line
    assert "\n" not in line
    if role == "methd":
        assert "did you mean 'method'?" in line


@pytest.mark.parametrize("part", ["ROLE", "LEARNS"])
def test_a_module_with_an_unknown_role_is_refused(part: str, monkeypatch) -> None:
    monkeypatch.setattr(f"safemr.algorithms.cpo.{part}", "champion", raising=False)
    with pytest.raises(UserError, match=rf"cpo\.py: {part} must be one of"):
        catalogue.load_algorithm.__wrapped__("cpo")


def test_the_kept_plan_has_the_roles(tmp_path) -> None:
    said = {"Ours": {"algorithm": "safemr", "role": "baseline"}}
    raw = {**DEFAULT, "tasks": [TASK], "sensitivity": None, "aircraft": None, "seeds": [0]}
    given, other = (
        replace(config.parse({**raw, "algorithms": algorithms}), results_root=tmp_path)
        for algorithms in (said, {"Ours": {"algorithm": "safemr"}})
    )
    fresh, kept = plan_cache.plan_for(given), plan_cache.plan_for(given)
    assert fresh == kept
    assert kept.grid.of("baseline") == ["Ours"]
    assert plan_cache.plan_for(other).grid.of("method") == ["Ours"]


def renamed_scores() -> pd.DataFrame:
    labels = {paper.METHOD: "Ours", paper.ABLATION: "Ours-0", "FAC-phih": "By-hand"}
    return score_rows().replace({"variant": labels})


def test_table_one_is_about_the_method_whatever_its_label() -> None:
    rivals = ["Ours-0", *paper.CMDP_BASELINES, "FAC-phi0", "By-hand"]
    ours = tables.table_one(renamed_scores(), method="Ours", baselines=rivals)
    papers = tables.table_one(score_rows())
    numbers = [name for name in papers.data if name != "baseline"]
    pd.testing.assert_frame_equal(ours.data[numbers], papers.data[numbers])
    assert ours.display.iloc[0, 0] == "Ours"
    assert "Efficiency of Ours against" in ours.caption
    assert ours.data["safemr"].notna().any()


def test_the_unseen_layouts_are_compared_with_the_method_whatever_its_label() -> None:
    made = [
        unseen_layouts.table(scores, scores, episodes=10, **given)
        for scores, given in ((score_rows(), {}), (renamed_scores(), {"method": "Ours"}))
    ]
    behind = [table.data.set_index(["task", "return"])["behind"].sort_index() for table in made]
    pd.testing.assert_series_equal(*behind)
    assert behind[0].notna().any()
    assert "Ours minus it" in made[1].display.columns


def test_a_handcrafted_certificate_is_no_learned_one_in_the_aircrafts_figures() -> None:
    rows = pd.DataFrame({"kind": "learner", "variant": ["Ours", "By-hand", "FACtory"]})
    assert aircraft._moving(rows, ["By-hand"]) == ["Ours", "FACtory"]


def test_the_aircrafts_note_compares_the_pair_of_the_configuration() -> None:
    rows = [(variant, seed, metric, 0.1 * seed + 0.5 * (variant == "Ours"))
            for variant in ("Ours", "Ours-0") for seed in range(3)
            for metric in ("volume_ratio", "missed_share", "iou")]  # fmt: skip
    scores = pd.DataFrame(rows, columns=["variant", "seed", "metric", "value"])
    scores["task"] = paper.AIRCRAFT_TASK
    note = aircraft_tables._verdict(scores, "Ours", "Ours-0")
    assert note.startswith("Ours minus Ours-0, ")
    assert "volume ratio +0.500" in note


def test_no_rule_reads_a_label_or_lists_algorithms() -> None:
    labels = {f'"{name}"' for name in (*paper.ALGORITHMS, *planning.algorithm_names())}
    labels |= {name.replace('"', "'") for name in labels}
    excused = {"outside.smk"}  # the one rule of the one algorithm that it runs
    found = {
        (path.name, label)
        for folder in ("workflow/rules", "workflow/scripts")
        for path in sorted((ROOT / folder).iterdir())
        for label in labels
        if path.is_file() and path.name not in excused and label in path.read_text()
    }
    assert not found


@pytest.mark.parametrize(
    ("own", "told"),
    [
        ({}, "0 to 3"),
        ({"JointSIS": [0, 2]}, "0 to 3 (JointSIS: 0, 2)"),
        ({"FAC": [1, 2, 3], "PPO-L": [1, 2, 3]}, "0 to 3 (FAC, PPO-L: 1 to 3)"),
    ],
)
def test_captions_tell_whose_seeds_are_others(own: dict[str, list[int]], told: str) -> None:
    entries = {"SafeMR": "safemr", "JointSIS": "joint_sis", "FAC": "fac", "PPO-L": "ppo_lagrangian"}
    algorithms = {
        label: {"algorithm": name, **({"seeds": own[label]} if label in own else {})}
        for label, name in entries.items()
    }
    assert plan_of(algorithms, seeds=[3, 0, 1, 2]).seeds_told == told
