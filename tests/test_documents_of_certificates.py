"""What documents say of certificates by their size and of the forms of their loss."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import yaml
from documents import PAIR, ROOT, cells, column, text_of

from safemr.report import statistics
from safemr.report.sizes import merged


def test_the_trials_of_the_forms_and_what_the_rule_chooses() -> None:
    page = (ROOT / "docs/tuning.md").read_text()
    flown = pd.read_csv(ROOT / "results/forms_tuning/tables/unseen_layouts.csv")
    flown = flown.set_index(["task", "variant"])
    goal, push = "Pillars-0.15-Goal", "Hazards-0.30-Push"
    forms = [(name, form) for name in PAIR for form in ("", "-literal", "-released")]
    travels, chosen = ("0.1", "0.33", "1", "3.3"), {}

    def trial(task: str, name: str, form: str, travel: str) -> pd.Series | None:
        plain = not form and travel == "0.33"  # the second pilot's
        key = (task, f"{name}{form}" + f"-{travel}" * (not plain))
        return flown.loc[key] if key in flown.index else None

    for name, form in forms:
        for travel in travels:
            found = [trial(task, name, form, travel) for task in (goal, push)]
            if all(run is not None and run["violating_episodes"] <= 1 for run in found):
                chosen[name, form] = travel
    grid = yaml.safe_load((ROOT / "config/forms.yaml").read_text())["algorithms"]
    for (name, form), travel in chosen.items():
        entry = grid[f"{name}{form}" if (name, form) != ("JointSIS", "") else "JointSIS-floored"]
        assert str(entry.get("certificate_travel", 0.33)) == travel
    assert len(chosen) == len(grid)
    for travel in travels:
        row = [travel]
        for name, form in forms:
            run = trial(goal, name, form, travel)
            text = "–" if run is None else f"{run['return']:.1f} ({run['violating_episodes']})"
            row.append(f"**{text}**" if chosen[name, form] == travel else text)
        assert f"| {' | '.join(row)} |" in page
    returns = [trial(push, *key, travel) for key, travel in chosen.items()]
    assert not any(run["violating_episodes"] for run in returns)
    said = "{:.1f}, {:.1f}, {:.1f}, {:.1f}, {:.1f} and {:.1f}"
    assert said.format(*(run["return"] for run in returns)) in text_of(page)
    other = trial(push, "SafeMR", "", "1")
    assert (round(other["return"], 1), other["violating_episodes"]) == (11.2, 2)


def test_what_decides_on_goal_is_told_as_flown() -> None:
    tables = ROOT / "results/forms/tables"
    answers = pd.read_csv(tables / "regularizer.csv").set_index("task")
    flown = pd.read_csv(tables / "unseen_layouts.csv").set_index(["task", "variant"])
    pairs = pd.read_csv(tables / "unseen_differences.csv").set_index(["task", "variant", "other"])
    said, goal = text_of((ROOT / "docs/results.md").read_text()), list(answers.index[:2])
    assert "On Goal it is the size" in said
    assert answers.loc[goal, "answer"].tolist() == ["the size"] * 2
    assert answers.loc[goal[0], "added_high"] < 0  # a little less with [a, b]
    assert answers.loc[goal[1], "added_low"] < 0 < answers.loc[goal[1], "added_high"]
    gains, dirty = {}, {}
    for name in ("JointSIS-floored", "JointSIS-literal"):
        for task in goal:
            gap = pairs.loc[task, name, "SafeMR"]
            assert gap["high"] > 0 < gap["difference"]  # as much as SafeMR, or more
            text = f"{gap['difference']:.2f} [{gap['low']:.2f}, {gap['high']:.2f}]"
            gains.setdefault(name, []).append(text)
            run = flown.loc[task, name]
            assert run["episodes"] == 500
            dirty.setdefault(name, []).append(run["violating_episodes"])
    floored, literal = gains.values()
    assert f"{floored[0]} more on {goal[0]} and {floored[1]} on {goal[1]}" in said
    assert f"{literal[0]} and {literal[1]} more" in said
    of, last = dirty.values()
    assert f"with {of[0]} and {of[1]} of 500 episodes with a violation (SafeMR: 0 and 2)," in said
    assert f"more, with {last[0]} and {last[1]} (" in said
    assert [flown.loc[task, "SafeMR"]["violating_episodes"] for task in goal] == [0, 2]
    printed = (tables / "unseen_layouts.md").read_text()
    names = [name for task, name in flown.index if task == goal[0]]
    labels = {name: [cells(printed, task, name)[1] for task in goal] for name in names}
    assert {first for first, _ in labels.values()} == {"yes"}
    open_ones = {name for name, (_, second) in labels.items() if second == "not decided"}
    assert open_ones == {"JointSIS-floored", "JointSIS-literal", "SafeMR-literal"}
    sizes = pd.read_csv(tables / "sizes.csv").set_index(["task", "certificate"])
    feasible = {name for name in names if sizes.loc[(goal[1], name), "feasible"] == 5}
    assert feasible == open_ones
    first = " and ".join(
        "{:.2f} [{:.2f}, {:.2f}]".format(*a_point_a_run(task)[:3]) for task in goal
    )
    assert f"with each run as a point, gives the same answers: {first}" in said


def test_the_front_page_and_push_are_told_as_flown() -> None:
    tables = ROOT / "results/forms/tables"
    answers = pd.read_csv(tables / "regularizer.csv").set_index("task")
    pairs = pd.read_csv(tables / "unseen_differences.csv").set_index(["task", "variant", "other"])
    small, large, first_push, push = answers.index
    front, said = (text_of((ROOT / name).read_text()) for name in ("README.md", "docs/results.md"))
    row = answers.loc[small]
    ends = f"[{-row['added_high']:.2f}, {-row['added_low']:.2f}]"
    assert f"return {-row['added']:.2f} {ends} less on one task and are not told apart on" in front
    for task in (small, large):  # JointSIS with ten times the travel, and with the literal loss
        floored, literal = (pairs.loc[task, f"JointSIS-{form}", "SafeMR"]
                            for form in ("floored", "literal"))  # fmt: skip
        assert floored["low"] < 0 < floored["high"]
        assert literal["low"] > 0
    row = answers.loc[large]
    assert f"where {row['added_high']:.2f} more, two fifths of what is to be explained" in said
    assert row["added_high"] / row["difference"] == pytest.approx(0.4, abs=0.02)
    row = answers.loc[push]
    assert "On Push it is not decided" in front
    assert "On Push it is not decided" in said
    assert row["answer"] == "not decided"
    text = "SafeMR's {:.2f} over JointSIS is told apart by little, what [a, b] add at equal size, "
    added = f"{row['added']:.2f} [{row['added_low']:.2f}, {row['added_high']:.2f}]"
    assert text.format(row["difference"]) + added in said
    assert answers.loc[first_push, "difference_low"] < 0
    missing = sum(answers["answer"] == "missing")
    assert missing == 1, "19 runs on Hazards-0.15-Push are to come: their answer belongs here"
    printed = (tables / "unseen_layouts.md").read_text()
    others = [name for task, name, other in pairs.index if (task, other) == (push, "SafeMR")]
    assert len(others) == 5
    for name in others:
        assert cells(printed, push, name)[1] == "yes"
        assert pairs.loc[push, name, "SafeMR"]["low"] < 0 < pairs.loc[push, name, "SafeMR"]["high"]


def a_point_a_run(task: str) -> statistics.Estimate:
    """What the regularizer adds at equal size, by the first version of the rule."""
    points = []
    for root in (ROOT / "results/forms/summary", ROOT / "results/summary"):
        flights = pd.read_csv(root / f"unseen_layouts/{task}.csv")
        points.append(merged(pd.read_csv(root / "sizes.csv"), flights))
    runs = pd.concat(points).query("k > 0").drop_duplicates(["variant", "seed"])
    area = runs["area"].to_numpy()
    factors = np.column_stack([area, area**2, runs["regularized"].to_numpy(float)])
    return statistics.linear_effects(factors, runs["return"].to_numpy())[-1]


def test_the_two_certificates_beside_the_papers_are_told_as_flown() -> None:
    tables = ROOT / "results/tables"
    page = (ROOT / "docs/oracle.md").read_text()
    sizes = pd.read_csv(tables / "sizes.csv").set_index(["task", "certificate"])
    flown = pd.read_csv(tables / "unseen_layouts.csv").set_index(["task", "variant"])
    printed = (tables / "unseen_layouts.md").read_text()
    pairs = pd.read_csv(tables / "unseen_differences.csv").set_index(["task", "variant", "other"])
    for task in dict.fromkeys(sizes.index.get_level_values("task")):
        areas, gaps, dirty = [], [], []
        for name in ("SafeMR-guarded", "FAC-oracle"):
            gap = pairs.loc[(task, name, "SafeMR")]
            areas.append(f"{sizes.loc[(task, name), 'ratio']:.2f}")
            gaps.append(f"{gap['difference']:.2f} [{gap['low']:.2f}, {gap['high']:.2f}]")
            rate, label = flown.loc[(task, name)], cells(printed, task, name)[1]
            label = {"yes": "safe", "no": "not safe"}.get(label, label)
            dirty.append(f"{rate['violating_episodes']} of {rate['episodes']}, {label}")
        assert "| " + " | ".join([task, areas[0], *gaps, *dirty]) + " |" in page
        own = sizes.loc[(task, "SafeMR-guarded")]
        assert own["feasible"] == own["certificates"]
    told = []
    for name in ("SafeMR", "SafeMR-guarded", "FAC-oracle"):
        of = flown.xs(name, level="variant")[["violating_episodes", "episodes"]].sum()
        told.append((of["violating_episodes"], f"{of['episodes']:,}"))
    (two, all_of), (guarded, four), (least, _) = told
    assert f"violate in {['no', 'one', 'two'][two]} of {all_of} episodes" in text_of(page)
    assert f"in {guarded} of {four} and of FAC-oracle in {least} of {four}," in text_of(page)


def test_where_the_guarded_descent_rests_is_told_as_recorded() -> None:
    said = text_of((ROOT / "docs/oracle.md").read_text())
    sizes = pd.read_csv(ROOT / "results/tables/sizes.csv").set_index(["task", "certificate"])[
        "area"
    ]
    ratios, spread, moved = [], {}, []
    for task in dict.fromkeys(sizes.index.get_level_values("task")):
        ratios.append(sizes[task, "SafeMR-guarded"] / sizes[task, "SafeMR"])
        ends = []
        for path in sorted(ROOT.glob(f"results/runs/{task}/SafeMR-guarded/*/progress.csv")):
            late = column(path, "step") >= 0.6 * column(path, "step")[-1]
            zeta = np.stack([column(path, name)[late] for name in ("sigma", "k", "n")], axis=1)
            moved.append(np.abs(zeta / zeta[-1] - 1).max())
            ends.append(zeta[-1])
        spread[task] = (np.ptp(ends, axis=0) / np.min(ends, axis=0))[1:]
    assert f"with {min(ratios):.2f} to {max(ratios):.2f} of SafeMR's unsafe area" in said
    del spread["Pillars-0.30-Goal"]
    k, n = 100 * np.max(list(spread.values()), axis=0)
    assert f"end within {np.ceil(k):.0f} and {np.ceil(n):.0f}% of each other" in said
    assert f"no parameter moves by more than {np.ceil(100 * max(moved)):.0f}%" in said
