"""Tables: numbers on a small fixed score table, and what they say of missing runs."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from sample_scores import OTHER, RETURNS, TASK, expected_runs, score_rows
from scipy import stats

from safemr import paper
from safemr.report import (
    absence,
    compute,
    differences,
    parallel,
    second_protocol,
    sensitivity,
    statistics,
    tables,
)


@pytest.fixture
def scores() -> pd.DataFrame:
    return score_rows()


def cells(table: tables.Table) -> list[list[str]]:
    lines = [line for line in table.markdown().splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_compute_adds_up_the_processor_time():
    runs = pd.DataFrame(
        {"task": TASK, "variant": ["SafeMR", "SafeMR", "CPO"], "seed": [0, 1, 0],
         "steps": [400_000, 400_000, 2_000_000], "cpu_s": [100.0, 140.0, 400.0],
         "wall_s": [110.0, 300.0, 420.0], "peak_rss_mb": [500.0, 510.0, 400.0], "cpu": "a"}
    )  # fmt: skip
    table = compute.table(runs)
    header, _, *rows = cells(table)
    assert [dict(zip(header, row, strict=True))["core-minutes a run"] for row in rows] == [
        "2.0",
        "6.7",
    ]
    assert rows[0][2:] == ["2", "400,000", "2.0", "3,333", "510"]
    assert table.data["core_hours"].sum() == pytest.approx(640 / 3600)
    assert "0.2 core-hours" in table.caption


def test_several_processes_beside_one():
    """Ages and workers' seconds of the one that has workers; neither of the other."""
    keys = {"task": TASK, "variant": "SafeMR-2-2-2", "seed": 0}
    ages = {
        **{"gradient_age": (1.0, 2.0), "gradient_age_max": (3.0, 5.0)},
        **{"policy_age": (4.0, 6.0), "policy_age_max": (9.0, 8.0)},
        **{"lost_tasks": (0.0, 1.0), "workers_cpu_s": (50.0, 90.0)},
    }
    progress = pd.DataFrame(
        [
            {**keys, "step": step, "metric": metric, "value": value}
            for metric, values in ages.items()
            for step, value in zip((100, 200), values, strict=True)
        ]
    )
    runs = pd.DataFrame(
        {"task": TASK, "variant": ["SafeMR", "SafeMR-2-2-2"], "seed": [0, 0], "steps": 200,
         "cpu_s": [20.0, 30.0], "wall_s": [21.0, 80.0], "peak_rss_mb": 500.0, "cpu": "a"}
    )  # fmt: skip
    scores = pd.DataFrame(
        [
            {**keys, "metric": metric, "value": value}
            for metric, value in (
                *(("eval_return", 9.0), ("eval_cost_indicator", 0.5)),
                ("eval_zero_violation_share", 0.75),
            )
        ]
    )
    (alone, several) = cells(parallel.table(scores, progress, runs))[2:]
    assert alone[3:] == ["missing", "missing", "–", "–", "–", "–", "20", "–", "21"]
    expected = ["9.00", "0.50", "75%", "1.5 (at most 5)", "5.0 (at most 9)", "1", "30", "90", "80"]
    assert several[3:] == expected
    (note,) = compute.table(runs, workers=True).notes
    assert "the driver's time" in note
    assert not compute.table(runs).notes


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


def test_a_baseline_that_is_added_counts_in_table_one(scores):
    better = scores[(scores["variant"] == "JointSIS") & (scores["task"] == TASK)].copy()
    better.loc[better["metric"] == "eval_return", "value"] += 10
    table = tables.table_one(
        pd.concat([scores, better.assign(variant="Mine")]), tasks=[TASK],
        baselines=["JointSIS", "Mine"],
    )  # fmt: skip
    assert table.data["baseline"].tolist() == ["Mine"]
    assert table.data["difference"][0] < 0


def test_differences_compare_every_two_algorithms_of_a_task_once(scores):
    table = differences.differences(scores)
    pairs = table.data.set_index(["task", "variant", "other"])
    assert len(pairs) == 5 * 4 // 2 + 1
    gap = pairs.loc[(TASK, "JointSIS", "SafeMR")]
    welch = stats.ttest_ind(RETURNS[TASK, "JointSIS"], RETURNS[TASK, "SafeMR"], equal_var=False)
    assert gap["low"] == pytest.approx(welch.confidence_interval().low)
    assert gap["high"] == pytest.approx(welch.confidence_interval().high)
    header, _, *rows = cells(table)
    shown = {row[1]: dict(zip(header, row, strict=True)) for row in rows if row[0] == TASK}
    half = gap["high"] - gap["difference"]
    assert shown["JointSIS"]["SafeMR"] == f"{gap['difference']:.2f} ± {half:.2f} †"
    assert "SafeMR" not in shown  # every pair once
    assert shown["FAC-phi0"]["CPO"] != ""
    assert shown["CPO"]["CPO"] == ""
    (hazards,) = [row for row in rows if row[:2] == [OTHER, "JointSIS"]]
    assert "†" not in hazards[2]


def test_only_the_first_printed_improvement_of_the_paper_is_wrong():
    wrong = [t for t, r in paper.TABLE_I.items()
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
        (row,) = [line for line in text.splitlines() if "SafeMR" in line and TASK in line]
        assert "[" not in row, "the IQM of three seeds is their mean"
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


def test_runs_that_were_recorded_and_not_flown_are_named(scores):
    """A record's policy is optional; without it, a table of flights lacks the run."""
    expected = expected_runs(4)
    flown = scores[scores["seed"] != 1]
    (note,) = absence.unflown_notes(expected, scores, flown)
    assert "SafeMR on Pillars-0.15-Goal (seed 1)" in note
    assert "seed 3" not in note  # which is not recorded: that is another note's business
    assert absence.unflown_notes(expected, scores, scores) == ()
    table = tables.full_results(flown, missing=None).noted(note)
    assert table.markdown().endswith(f"{note}\n")


def test_no_run_at_all_still_makes_every_table(scores):
    nothing = scores.iloc[:0]
    missing = expected_runs()
    for table in (
        tables.table_one(nothing, missing=missing),
        tables.full_results(nothing, missing=missing),
        tables.push_split(nothing, [OTHER], missing=missing),
        differences.differences(nothing, missing=missing),
        sensitivity.table_two(nothing, {"SafeMR": paper.HEADLINE}, missing=missing),
        sensitivity.weight_map(nothing, nothing, {"SafeMR": paper.HEADLINE}, missing=missing),
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


def test_weight_map_tells_what_the_weights_do_over_all_points():
    points = {f"SafeMR[{a},{b}]": (a, b) for a in (0.1, 0.2, 0.4) for b in (0.1, 0.3)}
    rows = [(TASK, name, seed, "eval_return", 3 + 20 * a - 5 * b + 0.1 * (-1) ** seed)
            for name, (a, b) in points.items() for seed in (0, 1)]  # fmt: skip
    given = pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"])
    (note,) = sensitivity.weight_map(given, given.iloc[:0], points).notes
    assert "over the 12 runs: 0.1 more of a changes the return by +2.00 ±" in note
    assert "0.1 more of b by -0.50 ±" in note


def test_push_returns_are_split_into_their_parts():
    rows = [(OTHER, name, seed, metric, value)
            for name, parts in (("SafeMR", (1.5, 0.2)), ("scripted: pushes the box", (1.5, 2.4)))
            for seed in (0, 1, 2)
            for metric, value in zip(("eval_reward_approach", "eval_reward_push"), parts,
                                     strict=True)]  # fmt: skip
    scores = pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"])
    named = scores.assign(task="Doors-Reach")  # whatever it is called
    split = tables.push_split(pd.concat([scores, named]), ["Doors-Reach"])
    assert {row[0] for row in cells(split)[2:]} == {"Doors-Reach"}
    found = {row[1]: row[5:7] for row in cells(split)[2:]}
    assert found["SafeMR"] == ["1.50", "0.20"], "equal seeds are no interval"
    assert found["scripted: pushes the box"][1] == "2.40"


@pytest.mark.parametrize("protocol", [1, 2])
def test_the_split_says_safe_as_the_full_results_do(protocol):
    """Three seeds without a violation are safe by the first protocol, undecided by the second."""
    metrics = {"eval_return": 7.0, "eval_cost_indicator": 0.0, "eval_zero_violation_share": 1.0,
               "eval_episodes": 100.0, "eval_reward_push": 4.0}  # fmt: skip
    rows = [(OTHER, "SafeMR", seed, *pair) for seed in range(3) for pair in metrics.items()]
    scores = pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"])
    rule = second_protocol.rule_of(protocol, 1.0, 0.95)
    split = tables.push_split(scores, [OTHER], rule=rule)
    whole = tables.full_results(scores, rule=rule)
    said = ["yes", "not decided"][protocol - 1]
    assert split.display["safe"].tolist() == whole.display["safe"].tolist() == [said]
    assert ("second protocol" in split.caption) == (protocol == 2)


def test_an_interval_is_printed_as_what_it_is():
    assert tables.plus_minus(1.0, 0.5, 1.5, 2) == "1.00 ± 0.50"
    assert tables.plus_minus(98.0, 93.0, 103.0, 1, "%") == "98.0 ± 5.0%"
    assert tables.plus_minus(98.0, 93.0, 100.0, 1, "%") == "98.0% [93.0, 100.0]"
    assert tables.plus_minus(100.0, 100.0, 100.0, 1, "%") == "100.0%"
    assert tables.plus_minus(3.0, np.nan, np.nan, 2) == "3.00"
    assert tables.plus_minus(np.nan, np.nan, np.nan, 2) == tables.MISSING


def test_results_of_equal_and_of_two_seeds_have_no_interval(scores):
    table = tables.full_results(scores)
    shown = table.display.set_index(["task", "algorithm"])
    assert shown.loc[(TASK, "SafeMR"), "clean episodes"] == "100.0%"
    assert shown.loc[(TASK, "SafeMR"), "violating steps"] == "0.00"
    assert shown.loc[(TASK, "CPO"), "violating steps"].startswith("31.67 ± ")
    two = tables.full_results(scores[scores["seed"] < 2]).display
    assert not two.apply(lambda column: column.str.contains("±|\\[")).any(axis=None)
    assert set(two["seeds"]) == {"2"}


def test_nothing_of_the_paper_stands_beside_a_task_that_it_did_not_run(scores):
    other = scores[scores["task"] == TASK].assign(task="Pillars-8")
    both = tables.table_one(pd.concat([scores, other]), tasks=[TASK, "Pillars-8"]).display
    both = both.set_index("Expected return")
    assert both.loc["Paper: SafeMR"].tolist() == ["10.034", tables.ABSENT]
    assert both.loc["Paper: improvement, printed", "Pillars-8"] == tables.ABSENT
    alone = tables.table_one(other, tasks=["Pillars-8"]).display
    assert not alone["Expected return"].str.contains("Paper").any()
    learned = pd.DataFrame(
        [(task, "SafeMR", seed, name, 1.0 + seed)
         for task in (TASK, OTHER) for seed in range(3) for name in ("sigma", "k", "n")],
        columns=["task", "variant", "seed", "metric", "value"],
    )  # fmt: skip
    points = {"SafeMR": paper.HEADLINE}
    for task, papers in ((TASK, True), (OTHER, False)):
        table = sensitivity.table_two(learned, points, task=task)
        assert ("paper" in set(table.data["seed"])) == papers
        assert ("paper" in table.caption) == papers


def test_two_seeds_leave_out_the_half_width_rather_than_call_it_missing():
    learned = pd.DataFrame(
        [(TASK, "SafeMR", seed, name, 1.0 + seed)
         for seed in (0, 1) for name in ("sigma", "k", "n")],
        columns=["task", "variant", "seed", "metric", "value"],
    )  # fmt: skip
    table = sensitivity.table_two(learned, {"SafeMR": paper.HEADLINE})
    assert tables.MISSING not in table.markdown()
    assert set(table.data["seed"]) == {"0", "1", "mean", "paper"}


def test_rows_of_a_task_stay_together_whatever_it_is_called(scores):
    ours = scores[scores["task"] == TASK]
    mixed = pd.concat([ours.assign(task=name) for name in ("Doors-Reach", TASK, "Pillars-8")])
    found = [row[0] for row in cells(tables.full_results(mixed))[2:]]
    assert list(dict.fromkeys(found)) == [TASK, "Doors-Reach", "Pillars-8"]
    assert found == sorted(found, key=[TASK, "Doors-Reach", "Pillars-8"].index)


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
