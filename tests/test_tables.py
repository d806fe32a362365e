"""Tables and claims: numbers on a small fixed record set, missing runs, and the rules' verdicts."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from safemr import claims, reference, sensitivity, statistics, tables
from safemr.evidence import Evidence

TASK, OTHER = "Pillars-0.15-Goal", "Hazards-0.15-Push"
RETURNS = {
    (TASK, "SafeMR"): [19.5, 19.6, 18.8],
    (TASK, "JointSIS"): [17.3, 15.9, 16.8],
    (TASK, "FAC-phih"): [15.8, 16.0, 15.1],
    (TASK, "FAC-phi0"): [24.0, 23.5, 24.4],
    (TASK, "CPO"): [21.0, 22.0, 20.5],
    (OTHER, "SafeMR"): [1.7, 1.8, 1.6],
    (OTHER, "JointSIS"): [1.75, 1.7, 1.68],
}
UNSAFE_STEPS = {"FAC-phi0": [3.0, 3.2, 2.9], "CPO": [30.0, 25.0, 40.0]}


def score_rows() -> pd.DataFrame:
    rows = []
    for (task, variant), returns in RETURNS.items():
        steps = UNSAFE_STEPS.get(variant, [0.0, 0.0, 0.0])
        for seed, (value, cost) in enumerate(zip(returns, steps, strict=True)):
            for metric, score in (
                ("eval_return", value),
                ("eval_cost", cost),
                ("eval_cost_indicator", cost),
                ("eval_zero_violation_share", 1.0 if cost == 0 else 0.4),
            ):
                rows.append((task, variant, seed, metric, score))
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"])


@pytest.fixture
def scores() -> pd.DataFrame:
    return score_rows()


def expected_runs(seeds: int = 3) -> pd.DataFrame:
    rows = [(task, variant, seed) for task, variant in RETURNS for seed in range(seeds)]
    return pd.DataFrame(rows, columns=["task", "variant", "seed"])


def cells(table: tables.Table) -> list[list[str]]:
    lines = [line for line in table.markdown().splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_compute_adds_up_the_processor_time():
    runs = pd.DataFrame(
        {"task": TASK, "variant": ["SafeMR", "SafeMR", "CPO"], "seed": [0, 1, 0],
         "steps": [400_000, 400_000, 2_000_000], "cpu_s": [100.0, 140.0, 400.0],
         "wall_s": [110.0, 300.0, 420.0], "peak_rss_mb": [500.0, 510.0, 400.0], "cpu": "a"}
    )  # fmt: skip
    table = tables.compute(runs)
    header, _, *rows = cells(table)
    assert [dict(zip(header, row, strict=True))["core-minutes a run"] for row in rows] == [
        "2.0",
        "6.7",
    ]
    assert rows[0][2:] == ["2", "400,000", "2.0", "3,333", "510"]
    assert table.data["core_hours"].sum() == pytest.approx(640 / 3600)
    assert "0.2 core-hours" in table.caption


# --- tables --------------------------------------------------------------------------------------


def test_table_one_names_the_best_safe_baseline_and_the_papers_arithmetic(scores):
    table = tables.table_one(scores, tasks=[TASK, OTHER])
    row = table.data.set_index("task").loc[TASK]
    assert row["baseline"] == "JointSIS"  # FAC-phi0 and CPO return more, but are not safe
    assert row["safemr"] == pytest.approx(np.mean(RETURNS[TASK, "SafeMR"]))
    assert row["improvement"] == pytest.approx(57.9 / 50.0 - 1)
    assert row["improvement_low"] < row["improvement"] < row["improvement_high"]
    assert row["paper_printed"] == 10.2
    assert row["paper_recomputed"] == pytest.approx(100 * (10.034 - 9.286) / 9.286)
    half = stats.t.ppf(0.975, 2) * np.std(RETURNS[TASK, "SafeMR"], ddof=1) / np.sqrt(3)
    assert cells(table)[2][1] == f"{57.9 / 3:.2f} ± {half:.2f}"
    assert "(JointSIS)" in cells(table)[3][1]
    assert "at most 1 violating step" in table.caption


def test_only_the_first_printed_improvement_of_the_paper_is_wrong():
    wrong = [t for t, r in reference.TABLE_I.items()
             if abs(r.printed_improvement - r.improvement) > 0.06]  # fmt: skip
    assert wrong == ["Pillars-0.15-Goal"]


@pytest.mark.parametrize("ending", ["csv", "md", "tex"])
def test_written_forms_hold_the_same_numbers(scores, tmp_path, ending):
    paths = {path.suffix[1:]: path for path in tables.full_results(scores).write(tmp_path)}
    text = paths[ending].read_text(encoding="utf-8")
    iqm = statistics.interquartile_mean(np.array(RETURNS[TASK, "SafeMR"]))
    if ending == "csv":
        data = pd.read_csv(paths["csv"]).set_index(["task", "variant", "metric"])
        assert data.loc[(TASK, "SafeMR", "eval_return"), "iqm"] == pytest.approx(iqm, rel=1e-15)
    else:
        mean = statistics.mean_interval(np.array(RETURNS[TASK, "SafeMR"])).mean
        assert f"{mean:.2f} " in text
        assert "[" not in text, "the IQM of three seeds is their mean"
        assert ("$\\pm$" in text) == (ending == "tex")


def test_full_results_say_who_is_safe_and_order_the_algorithms(scores):
    rows = cells(tables.full_results(scores))[2:]
    verdicts = {(row[0], row[1]): row[3] for row in rows}
    assert verdicts[TASK, "SafeMR"] == "yes"
    assert verdicts[TASK, "CPO"] == "no"
    first = [row[1] for row in rows if row[0] == TASK]
    assert first == ["SafeMR", "JointSIS", "CPO", "FAC-phi0", "FAC-phih"]


def test_missing_runs_get_a_row_and_a_note_instead_of_a_gap(scores):
    expected = pd.concat(
        [expected_runs(4), pd.DataFrame([(OTHER, "PPO-L", 0)], columns=["task", "variant", "seed"])]
    )
    missing = statistics.missing_runs(expected, scores)
    table = tables.full_results(scores, missing=missing)
    row = next(row for row in cells(table) if row[:2] == [OTHER, "PPO-L"])
    assert row[2] == tables.MISSING
    assert row[4] == tables.MISSING
    assert "SafeMR on Pillars-0.15-Goal (seed 3)" in table.notes[0]
    assert "PPO-L on Hazards-0.15-Push (seed 0)" in table.notes[0]
    assert "Runs missing" in table.latex()


def test_no_run_at_all_still_makes_every_table(scores):
    nothing = scores.iloc[:0]
    missing = expected_runs()
    for table in (
        tables.table_one(nothing, missing=missing),
        tables.full_results(nothing, missing=missing),
        tables.push_split(nothing, missing=missing),
        sensitivity.table_two(nothing, {"SafeMR": reference.HEADLINE}, missing=missing),
        sensitivity.weight_map(nothing, nothing, {"SafeMR": reference.HEADLINE}, missing=missing),
    ):
        assert "Runs missing" in table.markdown()


def test_table_two_stands_beside_the_papers_parameters():
    final = pd.DataFrame(
        [(TASK, "SafeMR", seed, name, value + 0.01 * seed)
         for seed in (0, 1) for name, value in (("sigma", 0.2), ("k", 0.9), ("n", 2.0))],
        columns=["task", "variant", "seed", "metric", "value"],
    )  # fmt: skip
    table = sensitivity.table_two(final, {"SafeMR": (0.35, 0.15)})
    rows = {row[1]: row[2:] for row in cells(table)[2:]}
    assert rows["mean"] == ["0.205", "0.905", "2.005"]
    assert rows["paper"] == ["0.201", "0.835", "2.084"]
    assert rows["1"][0] == "0.210"


def test_weight_map_measures_each_point_against_the_method_without_weights(scores):
    learned = pd.DataFrame(
        [(TASK, "SafeMR", seed, name, value)
         for seed in (0, 1, 2) for name, value in (("sigma", 0.2), ("k", 0.9), ("n", 2.0))],
        columns=["task", "variant", "seed", "metric", "value"],
    )  # fmt: skip
    table = sensitivity.weight_map(
        scores, learned, {"SafeMR": (0.35, 0.15), "absent": (0.35, 0.05)}
    )
    absent, found = cells(table)[2:]
    gap = statistics.difference_interval(
        np.array(RETURNS[TASK, "SafeMR"]), np.array(RETURNS[TASK, "JointSIS"])
    )
    assert absent[:5] == ["[0.35, 0.05]", "0", "missing", "missing", "missing"]
    assert found[:2] == ["[0.35, 0.15]", "3"]
    assert found[3] == f"{gap.mean:.2f} ± {gap.half_width:.2f}"
    assert found[4:] == ["0.00", "100.0%", "0.200", "0.900", "2.000"]
    row = table.data.set_index("variant").loc["SafeMR"]
    assert (row["gain_low"], row["gain_high"]) == (gap.low, gap.high)


def test_push_returns_are_split_into_their_parts():
    rows = [(OTHER, name, seed, metric, value)
            for name, parts in (("SafeMR", (1.5, 0.2)), ("scripted: pushes the box", (1.5, 2.4)))
            for seed in (0, 1)
            for metric, value in zip(("eval_reward_approach", "eval_reward_push"), parts,
                                     strict=True)]  # fmt: skip
    split = tables.push_split(
        pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"])
    )
    found = {row[1]: row[5:7] for row in cells(split)[2:]}
    assert found["SafeMR"] == ["1.50 ± 0.00", "0.20 ± 0.00"]
    assert found["scripted: pushes the box"][1] == "2.40 ± 0.00"


def test_the_iqm_is_shown_where_it_is_not_the_mean(scores):
    ours = scores[(scores["variant"] == "SafeMR") & (scores["task"] == TASK)]
    more = ours[ours["seed"] == 0].assign(seed=3)
    table = tables.full_results(pd.concat([scores, more]))
    (cell,) = [row[4] for row in cells(table)[2:] if row[:2] == [TASK, "SafeMR"]]
    assert cell.endswith("[19.50]")  # of 18.8, 19.5, 19.5, 19.6 the middle two


def test_a_share_at_the_limit_is_safe_whatever_its_rounding(scores):
    ours = (scores["variant"] == "SafeMR") & (scores["metric"] == "eval_zero_violation_share")
    scores.loc[ours, "value"] = 0.95
    assert np.mean([0.95] * 3) < 0.95
    assert tables.SafetyRule().is_safe(scores, TASK, "SafeMR")


def test_table_one_tells_no_safe_baseline_from_missing_runs(scores):
    names = ("JointSIS", "FAC-phih")
    unsafe = scores["variant"].isin(names) & (scores["metric"] == "eval_cost_indicator")
    scores.loc[unsafe, "value"] = 9.0
    rows = {row[0]: row[1] for row in cells(tables.table_one(scores, tasks=[TASK]))[2:]}
    assert rows["Highest among safe baselines"] == "none is safe"
    assert rows["Improvement [95% interval]"] == rows["Difference"] == tables.ABSENT
    nothing = tables.table_one(scores[scores["variant"] == "SafeMR"], tasks=[TASK])
    assert cells(nothing)[3][1] == "missing"


def test_an_improvement_over_a_negative_return_is_undefined_and_the_difference_is_not(scores):
    safe = (scores["task"] == OTHER) & (scores["variant"] == "JointSIS")
    scores.loc[safe & (scores["metric"] == "eval_return"), "value"] = [-0.4, -0.5, -0.2]
    rows = {row[0]: row[1] for row in cells(tables.table_one(scores, tasks=[OTHER]))[2:]}
    assert rows["Improvement [95% interval]"] == "undefined (baseline ≤ 0)"
    assert rows["Difference"].startswith("2.07 ± ")


def test_latex_does_not_read_a_bracket_as_the_distance_of_rows():
    frame = pd.DataFrame({"[a, b]": ["[0.35, 0.15]"], "x": ["[1]"]})
    assert "{}[0.35, 0.15] & [1]" in tables.Table("t", "c", frame, frame).latex()


def test_no_unsafe_run_ranks_above_a_safe_one_where_returns_are_negative(scores):
    on_task = scores["task"] == TASK
    returns = on_task & (scores["metric"] == "eval_return")
    scores.loc[returns, "value"] -= 30
    gated = tables.SafetyRule().safe_returns(scores)
    lowest = scores.loc[returns, "value"].min()
    assert statistics.scores_of(gated, TASK, "CPO", "eval_return").tolist() == [lowest] * 3


def test_safe_returns_count_unsafe_runs_as_zero(scores):
    gated = tables.SafetyRule().safe_returns(scores)
    assert statistics.scores_of(gated, TASK, "CPO", "eval_return").tolist() == [0, 0, 0]
    kept = statistics.scores_of(gated, TASK, "SafeMR", "eval_return").tolist()
    assert kept == RETURNS[TASK, "SafeMR"]


def test_latex_escapes_what_latex_would_read_as_commands():
    frame = pd.DataFrame({"a_b": ["50% & $x"]})
    text = tables.Table("t", "caption #1", frame, frame).latex()
    assert r"a\_b" in text
    assert r"50\% \& \$x" in text
    assert r"caption \#1" in text


# --- claims --------------------------------------------------------------------------------------


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


def test_an_unsafe_method_cannot_have_the_highest_safe_return(scores):
    scores = with_baselines(scores)
    ours = (scores["variant"] == "SafeMR") & (scores["metric"] == "eval_cost_indicator")
    scores.loc[ours, "value"] = 5.0
    assert verdict(f"highest_return[{TASK}]", evidence(scores)) == "refuted"


@pytest.mark.parametrize(
    ("shares", "expected"),
    [([1.0, 1.0, 1.0], "confirmed"), ([1.0, 1.0, 0.98], "inconclusive"),
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
    row = {"certificate": "paper [0.35, 0.15]", "worst_margin": worst, "infeasible_share": 0.0,
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
    shown = dict(zip(table.data["claim"], table.display["ours [95% interval]"], strict=True))
    assert shown["zero_violations"] == "1 in every seed"
    assert re.fullmatch(r"[\d.]+ \[[\d.]+, [\d.]+\]", shown[f"highest_return[{TASK}]"])


def test_a_claims_table_without_any_run_is_complete_and_inconclusive():
    nothing = evidence(score_rows().iloc[:0], tasks=reference.TASKS)
    table = claims.claims_table(nothing)
    assert set(table.data["verdict"]) == {"inconclusive"}
    assert table.data["reason"].str.startswith("runs missing: ").all()


def test_every_claim_has_its_rule_in_the_documentation():
    text = (Path(__file__).parents[1] / "docs" / "claims.md").read_text(encoding="utf-8")
    documented = re.findall(r"^\| `([a-z_]+)", text, flags=re.MULTILINE)
    judged = list(dict.fromkeys(claim.name.split("[")[0] for claim in claims.claims()))
    assert documented == judged
