"""Claims: the rules' verdicts on a small score table, and what missing runs do to them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sample_scores import OTHER, TASK, expected_runs, score_rows

from safemr import paper
from safemr.report import claims
from safemr.report.findings import Evidence


@pytest.fixture
def scores() -> pd.DataFrame:
    return score_rows()


def evidence(scores: pd.DataFrame, **changes: object) -> Evidence:
    empty = pd.DataFrame(columns=["task", "variant", "seed", "step", "metric", "value"])
    base = Evidence(scores, empty, tasks=(TASK,))
    return replace(base, **changes)  # type: ignore[arg-type]


def verdict(name: str, given: Evidence) -> str:
    (claim,) = [claim for claim in claims.claims(given.tasks) if claim.name == name]
    return claim.judge(given).verdict


def with_baselines(scores: pd.DataFrame) -> pd.DataFrame:
    """The other CMDP baselines get CPO's runs."""
    cpo = scores[scores["variant"] == "CPO"]
    return pd.concat([scores, *(cpo.assign(variant=name) for name in ("PPO-L", "TRPO-L"))])


@pytest.mark.parametrize(
    ("shift", "expected"), [(0.0, "confirmed"), (-2.3, "inconclusive"), (-9.0, "refuted")]
)
def test_highest_return_follows_the_interval_of_the_difference(scores, shift, expected):
    scores = with_baselines(scores)
    ours = (scores["variant"] == "SafeMR") & (scores["metric"] == "eval_return")
    scores.loc[ours, "value"] += shift
    assert verdict(f"highest_return[{TASK}]", evidence(scores)) == expected


def test_the_methods_certificates_are_its_own_and_those_of_its_points():
    row = {"task": TASK, "infeasible_share": 0.0,
           "margin_inside_aligned": 1.0, "margin_outside_aligned": 1.0,
           "margin_inside_drag": -1.0, "margin_outside_drag": -1.0}  # fmt: skip
    elsewhere = {**row, "certificate": "SafeMR (seed 0)", "worst_margin": 0.5, "task": "Pillars-8"}
    names = {"SafeMR (seed 0)": -0.1, "SafeMR[0.45,0.15] (seed 0)": -0.2,
             "SafeMR-literal (seed 0)": 0.3, "paper [0.35, 0.15]": 0.4}  # fmt: skip
    rows = [{"certificate": name, "worst_margin": worst, **row} for name, worst in names.items()]
    finding = claims.parameters_feasible(
        "SafeMR", evidence(score_rows(), certificates=pd.DataFrame([*rows, elsewhere]))
    )
    assert finding.verdict == "confirmed"
    assert finding.estimate.mean == -0.1
    assert finding.reason.startswith("2 certificates")


def test_an_unsafe_method_cannot_have_the_highest_safe_return(scores):
    scores = with_baselines(scores)
    ours = (scores["variant"] == "SafeMR") & (scores["metric"] == "eval_cost_indicator")
    scores.loc[ours, "value"] = 5.0
    assert verdict(f"highest_return[{TASK}]", evidence(scores)) == "refuted"


@pytest.mark.parametrize(
    ("shares", "expected"),
    [([1.0, 1.0, 1.0], "confirmed"), ([1.0, 1.0, 0.98], "refuted"),
     ([0.9, 0.93, 0.96], "refuted"), ([0.98, 0.981, 0.979], "refuted")],
)  # fmt: skip
def test_zero_violations(scores, shares, expected):
    ours = (scores["variant"] == "SafeMR") & (scores["metric"] == "eval_zero_violation_share")
    scores.loc[ours & (scores["task"] == TASK), "value"] = shares
    assert verdict("zero_violations", evidence(scores)) == expected


def test_unsafe_baselines_and_safe_ones(scores):
    given = evidence(with_baselines(scores))
    assert verdict("unsafe[CPO]", given) == "confirmed"
    assert verdict("safe_but_lower[JointSIS]", given) == "confirmed"
    assert verdict("safe_but_lower[FAC-phih]", given) == "confirmed"
    safe = scores.replace({"variant": {"FAC-phih": "CPO", "CPO": "FAC-phih"}})
    assert verdict("unsafe[CPO]", evidence(safe)) == "refuted"
    assert verdict("safe_but_lower[FAC-phih]", evidence(safe)) == "refuted"


@pytest.mark.parametrize(
    ("shift", "expected"), [(9.0, "confirmed"), (0.0, "inconclusive"), (-9.0, "refuted")]
)
def test_a_higher_return_is_one_on_every_task(scores, shift, expected):
    ours = scores[(scores["variant"] == "SafeMR") & (scores["task"] == TASK)]
    theirs = ours.assign(variant="PPO-L")
    theirs.loc[theirs["metric"] == "eval_return", "value"] += shift
    given = evidence(pd.concat([scores, theirs]))
    assert verdict("higher_return[PPO-L]", given) == expected


def test_equal_shares_in_every_seed_are_no_interval(scores):
    scores = with_baselines(scores)
    for metric, value in (("eval_cost_indicator", 0.3), ("eval_zero_violation_share", 0.9)):
        scores.loc[(scores["variant"] == "CPO") & (scores["metric"] == metric), "value"] = value
    assert verdict("unsafe[CPO]", evidence(scores)) == "inconclusive"


def test_one_missing_seed_makes_a_claim_inconclusive_and_is_named(scores):
    given = evidence(scores, expected=expected_runs(4))
    (claim,) = [claim for claim in claims.claims((TASK,)) if claim.name == "unsafe[CPO]"]
    finding = claim.judge(given)
    assert finding.verdict == "inconclusive"
    assert finding.reason == "runs missing: CPO on Pillars-0.15-Goal (seed 3)"


def test_one_task_can_refute_but_not_confirm_what_is_said_of_all(scores):
    both = (TASK, "Hazards-0.30-Push")  # no run on the second
    given = evidence(with_baselines(scores), tasks=both)
    assert verdict("zero_violations", replace(given, tasks=(TASK,))) == "confirmed"
    (claim,) = [claim for claim in claims.claims(both) if claim.name == "zero_violations"]
    finding = claim.judge(given)
    assert finding.verdict == "inconclusive"
    assert "runs missing: SafeMR on Hazards-0.30-Push (all)" in finding.reason
    assert f"{TASK}: confirmed" in finding.reason
    safe = scores.replace({"variant": {"FAC-phih": "CPO", "CPO": "FAC-phih"}})
    assert verdict("unsafe[CPO]", evidence(safe, tasks=both)) == "refuted"


def test_points_must_all_beat_joint_sis(scores):
    labels = {"SafeMR": (0.35, 0.15), "SafeMR[0.45,0.15]": (0.45, 0.15),
              "SafeMR[0.35,0.25]": (0.35, 0.25)}  # fmt: skip
    ours = scores[(scores["variant"] == "SafeMR") & (scores["task"] == TASK)]
    good = pd.concat([scores, *(ours.assign(variant=name) for name in list(labels)[1:])])
    assert verdict("sensitivity_return", evidence(good, points=labels)) == "confirmed"
    assert verdict("sensitivity_cost", evidence(good, points=labels)) == "confirmed"
    worse = (good["variant"] == "SafeMR[0.35,0.25]") & (good["metric"] == "eval_return")
    good.loc[worse, "value"] -= 8
    assert verdict("sensitivity_return", evidence(good, points=labels)) == "refuted"
    assert verdict("sensitivity_return", evidence(scores)) == "inconclusive"


@pytest.mark.parametrize(
    ("volumes", "missed", "expected"),
    [((1.7, 1.9), 0.005, ("confirmed", "confirmed")), ((1.9, 1.7), 0.05, ("refuted", "refuted"))],
)
def test_aircraft_claims(scores, volumes, missed, expected):
    rows = []
    for seed, noise in enumerate((-0.01, 0.0, 0.01)):
        for variant, volume in zip(("SafeMR", "JointSIS"), volumes, strict=True):
            rows.append((variant, seed, volume + noise, missed * (1 + 0.1 * noise)))
    rows.append(("phi_h", np.nan, 0.78, 0.76))
    table = pd.DataFrame(rows, columns=["variant", "seed", "volume_ratio", "missed_share"])
    given = evidence(scores, aircraft=table)
    assert (verdict("conservativeness", given), verdict("coverage", given)) == expected
    assert verdict("handcrafted_coverage", given) == "confirmed"
    fourth = pd.DataFrame({"task": "Aircraft", "variant": ["SafeMR"], "seed": 3})
    lacking = replace(given, expected=fourth)
    assert verdict("conservativeness", lacking) == verdict("coverage", lacking) == "inconclusive"


@pytest.mark.parametrize(
    ("worst", "aligned", "expected"),
    [(0.02, 1.0, "refuted"), (-0.01, 1.0, "confirmed"), (-0.01, -1.0, "inconclusive")],
)
def test_one_state_without_a_safe_action_refutes_feasibility(scores, worst, aligned, expected):
    row = {"task": TASK, "certificate": "paper [0.35, 0.15]",
           "worst_margin": worst, "infeasible_share": 0.0,
           "margin_inside_aligned": aligned, "margin_outside_aligned": aligned,
           "margin_inside_drag": -1.0, "margin_outside_drag": -1.0}  # fmt: skip
    given = evidence(scores, certificates=pd.DataFrame([row]))
    assert verdict("feasibility_paper", given) == expected
    assert verdict("feasibility_ours", given) == "inconclusive"


def curve_rows(curves: dict[str, np.ndarray]) -> pd.DataFrame:
    rows = [
        (TASK, "SafeMR", seed, 100 * (index + 1), metric, float(value) + 1e-4 * seed * index)
        for seed in range(3)
        for metric, values in curves.items()
        for index, value in enumerate(values)
    ]
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "step", "metric", "value"])


@pytest.mark.parametrize(("slow", "expected"), [(0.5, "confirmed"), (0.02, "refuted")])
def test_slowest_certificate_compares_settling_times(scores, slow, expected):
    time = np.linspace(0, 1, 60)
    curves = {name: np.exp(-time / slow) for name in ("sigma", "k", "n")}
    curves |= {"train_return": -np.exp(-time / 0.1), "multiplier_mean": -np.exp(-time / 0.15)}
    given = evidence(scores, progress=curve_rows(curves))
    assert verdict("slowest_certificate", given) == expected


@pytest.mark.parametrize(("growth", "expected"), [(0.0, "confirmed"), (9.0, "refuted")])
def test_bounded_losses(scores, growth, expected):
    time = np.linspace(0, 1, 60)
    curves = {"critic_loss": np.exp(growth * time), "policy_grad_norm": np.ones(60)}
    assert verdict("bounded", evidence(scores, progress=curve_rows(curves))) == expected


@pytest.mark.parametrize("name", ["bounded", "slowest_certificate"])
def test_what_is_said_of_curves_must_hold_on_every_task(scores, name):
    time = np.linspace(0, 1, 60)
    good = {"critic_loss": np.ones(60), "train_return": -np.exp(-time / 0.1),
            "multiplier_mean": -np.exp(-time / 0.15)}  # fmt: skip
    good |= {parameter: np.exp(-time / 0.5) for parameter in ("sigma", "k", "n")}
    bad = {**good, "critic_loss": np.exp(9 * time)}
    bad |= {parameter: np.exp(-time / 0.02) for parameter in ("sigma", "k", "n")}
    one, two = curve_rows(good), curve_rows(bad).assign(task=OTHER)
    for progress, tasks, expected in (
        (one, (TASK,), "confirmed"),
        (pd.concat([one, two]), (TASK, OTHER), "refuted"),
        (one, (TASK, OTHER), "inconclusive"),
    ):
        assert verdict(name, evidence(scores, progress=progress, tasks=tasks)) == expected


def test_the_claims_table_says_where_seeds_agree_exactly(scores):
    table = claims.claims_table(evidence(with_baselines(scores)))
    shown = dict(zip(table.data["claim"], table.display[claims.OURS], strict=True))
    assert shown["zero_violations"] == "1 in every seed"
    assert re.fullmatch(r"[\d.]+ \[[\d.]+, [\d.]+\]", shown[f"highest_return[{TASK}]"])


def test_a_claims_table_without_any_run_is_complete_and_inconclusive():
    nothing = evidence(score_rows().iloc[:0], tasks=paper.TASKS)
    table = claims.claims_table(nothing)
    assert set(table.data["verdict"]) == {"inconclusive"}
    assert table.data["reason"].str.startswith("runs missing: ").all()


def test_a_grid_without_a_task_of_the_paper_gets_no_verdict(scores):
    """Whatever its runs are called by themselves, they are of other tasks."""
    elsewhere = with_baselines(scores[scores["task"] == TASK]).assign(task="Pillars-8")
    row = {"task": "Pillars-8", "certificate": "SafeMR (seed 0)", "worst_margin": 0.5,
           "infeasible_share": 0.1, "margin_inside_aligned": 1.0, "margin_outside_aligned": 1.0,
           "margin_inside_drag": 1.0, "margin_outside_drag": 1.0}  # fmt: skip
    given = evidence(
        elsewhere,
        tasks=paper.TASKS,
        expected=elsewhere[["task", "variant", "seed"]].drop_duplicates(),
        certificates=pd.DataFrame([row]),
    )
    table = claims.claims_table(given)
    assert set(table.data["verdict"]) == {"not run"}
    assert table.data["reason"].str.startswith("not in this configuration: ").all()
    assert table.data["estimate"].isna().all()


def test_a_grid_with_one_task_of_the_paper_is_judged_on_it(scores):
    ours = with_baselines(scores[scores["task"] == TASK])
    given = evidence(ours, tasks=paper.TASKS, expected=ours[["task", "variant", "seed"]])
    table = claims.claims_table(given).data.set_index("claim")["verdict"]
    assert table[f"highest_return[{TASK}]"] == "confirmed"
    assert table[f"highest_return[{OTHER}]"] == "not run"
    assert table["zero_violations"] == "inconclusive", "three of its tasks are missing"
    assert table["conservativeness"] == table["sensitivity_cost"] == "not run"


def test_two_seeds_confirm_nothing(scores):
    two = with_baselines(scores[(scores["seed"] < 2) & (scores["task"] == TASK)])
    verdicts = claims.claims_table(evidence(two)).data.set_index("claim")["verdict"]
    assert "confirmed" not in set(verdicts)
    assert verdicts["zero_violations"] == verdicts["unsafe[CPO]"] == "inconclusive"
    assert verdicts["safe_but_lower[JointSIS]"] == "inconclusive"
    unsafe = two["variant"].isin([*paper.BASELINES]) & (two["metric"] == "eval_cost_indicator")
    two.loc[unsafe, "value"] = 9.0
    assert verdict(f"highest_return[{TASK}]", evidence(two)) == "inconclusive"
    one = (two["variant"] == "SafeMR") & (two["metric"] == "eval_zero_violation_share")
    two.loc[one & (two["seed"] == 0), "value"] = 0.9
    assert verdict("zero_violations", evidence(two)) == "refuted", "one violation is enough"


def test_intervals_in_the_reasons_keep_the_bounds_of_what_they_are_of(scores):
    clean = (scores["variant"] == "SafeMR") & (scores["metric"] == "eval_zero_violation_share")
    scores.loc[clean & (scores["seed"] == 0), "value"] = 0.9
    finding = claims.zero_violations(evidence(scores))
    assert finding.estimate.high == 1.0
    cost = (scores["variant"] == "CPO") & (scores["metric"] == "eval_cost_indicator")
    scores.loc[cost & (scores["seed"] > 0), "value"] = 0.0
    assert claims.unsafe_everywhere("CPO", evidence(scores)).estimate.low == 0.0


def test_every_claim_has_its_rule_in_the_documentation():
    text = (Path(__file__).parents[1] / "docs" / "claims.md").read_text(encoding="utf-8")
    documented = re.findall(r"^\| `([a-z_]+)", text, flags=re.MULTILINE)
    judged = list(dict.fromkeys(claim.name.split("[")[0] for claim in claims.claims()))
    assert documented == judged
