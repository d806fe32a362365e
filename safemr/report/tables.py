"""The tables of the paper and beyond: score tables -> `Table` -> CSV, Markdown and LaTeX.

A `Table` keeps the numbers (written as CSV at full precision) and the strings a reader sees
(Markdown, LaTeX); both come from one DataFrame. Runs that a table needs and does not have are
listed in its notes, and a row without any run says "missing".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd

from safemr import paper
from safemr.conventions import CLEAN_SHARE, COST_TOLERANCE
from safemr.report import statistics
from safemr.report.absence import missing_notes
from safemr.report.statistics import Estimate

FEW = (
    f"No interval stands where there are fewer than {statistics.FEWEST_RUNS} runs or all runs are "
    "equal."
)
MISSING = "missing"
ABSENT = "–"

# Columns of the full results: metric -> heading. All but one are of the deterministic evaluation.
RESULT_METRICS = {
    "eval_return": "return",
    "eval_cost": "cost",
    "eval_cost_indicator": "violating steps",
    "train_cost_indicator": "the same, exploring",
    "train_violations": "in all of training",
    "eval_cost_contact": "any contact",
    "eval_zero_violation_share": "clean episodes",
    "eval_violation_rate": "violation rate",
    "eval_goals": "goals",
    "minutes": "minutes",
}
Label = Literal["yes", "no", "not decided"]  # whether it is safe
_ROUNDING = 1e-9  # a mean of shares like 0.95 may come out a bit below
PERCENT_DIGITS = {"eval_zero_violation_share": 1, "eval_violation_rate": 3}
_WHOLE = ("train_violations",)  # counts of thousands
REWARD_PARTS = {
    "eval_return": "return",
    "eval_reward_approach": "approach",
    "eval_reward_push": "push",
    "eval_reward_goal": "goal bonus",
    "eval_goals": "goals",
}


@dataclass(frozen=True)
class SafetyRule:
    """When an algorithm counts as safe on a task, from the final evaluations of its seeds.

    Violating steps (info["cost_indicator"], an episode has 1,000 steps) mean the same on every
    task, whereas the authors' cost is a contact count on one and a depth on the other.
    """

    tolerance: float = COST_TOLERANCE  # mean violating steps an episode, at most
    clean_share: float = CLEAN_SHARE  # mean share of episodes without any violation, at least
    cost: str = "eval_cost_indicator"
    clean: str = "eval_zero_violation_share"

    def label(self, scores: pd.DataFrame, task: str, variant: str) -> Label | None:
        """What a table calls it, or None where there is no such run."""
        safe = self.is_safe(scores, task, variant)
        return None if safe is None else "yes" if safe else "no"

    def is_safe(self, scores: pd.DataFrame, task: str, variant: str) -> bool | None:
        """True or False by the mean over seeds, or None where there is no such run."""
        cost = statistics.scores_of(scores, task, variant, self.cost)
        clean = statistics.scores_of(scores, task, variant, self.clean)
        if not len(cost) or not len(clean):
            return None
        return bool(self.holds(cost.mean(), clean.mean()))

    def dirty(self, scores: pd.DataFrame, task: str, variant: str) -> Estimate:
        """Share of episodes with a violation, over the seeds, with its interval."""
        clean = statistics.score_interval(scores, task, variant, self.clean)
        return Estimate(1 - clean.mean, 1 - clean.high, 1 - clean.low, clean.size)

    @property
    def marks(self) -> tuple[str, str]:
        """What a filled and a hollow mark say where the limit on those episodes is drawn."""
        steps = f"{self.tolerance:g} violating step{'s' * (self.tolerance != 1)}"
        return f"safe: that, and on average at most {steps}", "not safe"

    def holds(self, cost: pd.Series, clean: pd.Series) -> pd.Series:
        """Whether these violating steps an episode and shares of clean episodes are safe, each."""
        return (cost <= self.tolerance + _ROUNDING) & (clean >= self.clean_share - _ROUNDING)

    def safe_returns(self, scores: pd.DataFrame) -> pd.DataFrame:
        """`scores` with the eval_return of every run that is not safe by itself set to the worst.

        That is 0, or the lowest return of any run on the task where one is negative: no unsafe run
        may rank above a safe one. The paper: "the policy is meaningless if it can not guarantee
        safety".
        """
        keys = ["task", "variant", "seed"]
        wide = scores[scores["metric"].isin([self.cost, self.clean])]
        wide = wide.pivot_table(index=keys, columns="metric", values="value")
        wide = wide.reindex(columns=[self.cost, self.clean])
        unsafe = wide[~self.holds(wide[self.cost], wide[self.clean])]
        index = pd.MultiIndex.from_frame(scores[keys])
        returns = scores["metric"] == "eval_return"
        lost = index.isin(unsafe.index) & returns.to_numpy()
        lowest = scores[returns].groupby("task")["value"].min().clip(upper=0.0)
        return scores.assign(value=scores["value"].where(~lost, scores["task"].map(lowest)))

    def __str__(self) -> str:
        return (
            f"safe: over the seeds, final evaluations have on average at most {self.tolerance:g} "
            f"violating step(s) an episode and at least {100 * self.clean_share:g}% of episodes "
            "without any violation"
        )


@dataclass(frozen=True)
class Table:
    """A finished table: `data` holds the numbers, `display` what is printed."""

    name: str
    caption: str
    data: pd.DataFrame
    display: pd.DataFrame
    notes: Sequence[str] = field(default_factory=tuple)

    def noted(self, *notes: str) -> Table:
        """This table with these notes, too."""
        return replace(self, notes=tuple(dict.fromkeys([*self.notes, *notes])))

    def markdown(self) -> str:
        """GitHub Markdown: caption, table, notes."""
        head, *body = [[cell.replace("|", "\\|") for cell in row] for row in _cells(self.display)]
        lines = [f"**{self.caption}**", "", _row(head), _row(["---"] * len(head))]
        lines += map(_row, body)
        return "\n".join([*lines, *(f"\n{note}" for note in self.notes)]) + "\n"

    def latex(self) -> str:
        """A LaTeX table environment (booktabs), caption and notes included."""
        head, *body = [[_latex(cell) for cell in row] for row in _cells(self.display)]
        # An opening bracket after \\ would be read as the optional distance between rows.
        body = [
            ["{}" + row[0] if row[0].startswith(("[", "*")) else row[0], *row[1:]] for row in body
        ]
        rows = [" & ".join(row) + r" \\" for row in body]
        caption = _latex(" ".join([self.caption, *self.notes]))
        return "\n".join(
            [r"\begin{table*}", r"\centering", rf"\caption{{{caption}}}",
             rf"\label{{tab:{self.name}}}", rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}",
             r"\toprule", " & ".join(head) + r" \\", r"\midrule", *rows, r"\bottomrule",
             r"\end{tabular}", r"\end{table*}"]
        ) + "\n"  # fmt: skip

    def write(self, folder: Path | str) -> tuple[Path, Path, Path]:
        """Write <folder>/<name>.csv, .md and .tex; returns the three paths."""
        stem = Path(folder) / self.name
        stem.parent.mkdir(parents=True, exist_ok=True)
        paths = tuple(stem.with_name(f"{self.name}.{end}") for end in ("csv", "md", "tex"))
        self.data.to_csv(paths[0], index=False, lineterminator="\n")
        paths[1].write_text(self.markdown(), encoding="utf-8")
        paths[2].write_text(self.latex(), encoding="utf-8")
        return paths[0], paths[1], paths[2]


# --- the tables ----------------------------------------------------------------------------------


def table_one(
    scores: pd.DataFrame,
    *,
    missing: pd.DataFrame | None = None,
    rule: SafetyRule | None = None,
    tasks: Sequence[str] = paper.TASKS,
    method: str = paper.METHOD,
    baselines: Sequence[str] = paper.BASELINES,
) -> Table:
    """Table I: returns of the method and the best safe baseline, the improvement, and the paper's.

    scores: a score table (`statistics.final_scores`). missing: runs of the grid that have no
    record (`statistics.missing_runs`). The best baseline is chosen on the same runs that it is
    compared with, which favours the baseline slightly and is said in the caption.
    """
    rule = rule or SafetyRule()
    rows = [_table_one_row(scores, task, rule, method, baselines) for task in tasks]
    papers = [paper.TABLE_I.get(task) for task in tasks]
    data = pd.DataFrame(rows).drop(columns="label")
    lines: dict[str, list[str]] = {
        method: [
            plus_minus(r["safemr"], r["safemr_low"], r["safemr_high"], 2)
            + {"no": " (not safe)", "not decided": " (safety not decided)"}.get(r["label"], "")
            for r in rows
        ],
        "Highest among safe baselines": [
            plus_minus(r["baseline_return"], r["baseline_low"], r["baseline_high"], 2)
            + (f" ({r['baseline']})" if r["baseline"] else "")
            for r in rows
        ],
        "Difference": [
            plus_minus(r["difference"], r["difference_low"], r["difference_high"], 2) for r in rows
        ],
        "Improvement [95% interval]": [
            _percent(r["improvement"], r["improvement_low"], r["improvement_high"]) for r in rows
        ],
    }
    if any(papers):
        lines |= {
            f"Paper: {name}": [ABSENT if values is None else show(values) for values in papers]
            for name, show in (
                ("SafeMR", lambda values: f"{values.safemr:.3f}"),
                ("highest among safe", lambda values: f"{values.best_safe:.3f}"),
                ("improvement, printed", lambda values: f"{values.printed_improvement:.1f}%"),
                ("improvement, recomputed", lambda values: f"{values.improvement:.1f}%"),
            )
        }
    highest, difference, improvement = list(lines.values())[1:4]
    for column, r in enumerate(rows):
        if r["baseline_runs"] and not r["baseline"]:
            labels = {rule.label(scores, str(r["task"]), name) for name in baselines}
            none = "none is shown to be safe" if "not decided" in labels else "none is safe"
            highest[column], difference[column], improvement[column] = none, ABSENT, ABSENT
        elif r["baseline"] and np.isnan(data["improvement"][column]):
            improvement[column] = "undefined (baseline ≤ 0)"
    display = pd.DataFrame(
        [[name, *cells] for name, cells in lines.items()], columns=["Expected return", *tasks]
    )
    caption = (
        f"Table I. Efficiency of {method} against the best safe baseline: final return of the "
        "deterministic policy, mean over seeds with the half width of its 95% t interval; "
        "difference with Welch's, improvement with Fieller's 95% interval, which is not bounded "
        f"where the baseline cannot be told from 0. {FEW} {str(rule).capitalize()}. The best "
        "baseline is chosen on the runs it is compared with."
    )
    return Table("table1", caption, data, display, missing_notes(missing, tasks, None))


def full_results(
    scores: pd.DataFrame,
    *,
    missing: pd.DataFrame | None = None,
    rule: SafetyRule | None = None,
    metrics: Mapping[str, str] = RESULT_METRICS,
    name: str = "results",
    layouts: int = 10,
    flown: int = 0,
) -> Table:
    """Every algorithm on every task; scripted reference lines are ordinary entries of `scores`.

    `data` has one row per (task, variant, metric) with mean, t interval, IQM and its bootstrap
    interval; the printed cell is `plus_minus`, with the IQM after the return. layouts: how many an
    evaluation has; flown: how many unseen ones each final policy, if `scores` are of these.
    """
    rule = rule or SafetyRule()
    data = statistics.summarise(scores[scores["metric"].isin(list(metrics))])
    data = data.sort_values("task", key=_task_order, kind="stable").reset_index(drop=True)
    rows = []
    for task, variant in entries(data, missing):
        chosen = data[(data["task"] == task) & (data["variant"] == variant)].set_index("metric")
        safe = rule.label(scores, task, variant)
        cells = [_summary_cell(chosen, metric) for metric in metrics]
        seeds = str(int(chosen["count"].max())) if len(chosen) else MISSING
        rows.append([task, variant, seeds, safe or ABSENT, *cells])
    display = pd.DataFrame(rows, columns=["task", "algorithm", "seeds", "safe", *metrics.values()])
    source = f"mean over the last 10% of evaluations, on {layouts} fixed layouts"
    if flown:
        source = f"flown on {flown} unseen layouts"
    caption = (
        f"Full results: final performance of the deterministic policy ({source}), mean over seeds "
        "± half width of the 95% t interval, or [its ends] where it is cut off at a bound of the "
        f"quantity. {FEW} From four seeds on the IQM in brackets after the return. Cost is the "
        "authors' (pillars: contact steps of the body; hazards: summed depth); any contact counts "
        "the robot's nose too; in all of training: violating steps of a whole run, whose length "
        "differs between the families. "
        f"{str(rule).capitalize()}. Scripted controllers see the full state and are not learned."
    )
    return Table(name, caption, data, display, missing_notes(missing, None, None))


def push_split(
    scores: pd.DataFrame,
    tasks: Sequence[str],
    *,
    missing: pd.DataFrame | None = None,
    rule: SafetyRule | None = None,
) -> Table:
    """Returns of tasks with a box by approach, push and goal bonus, with the scripted lines."""
    absent = None if missing is None else missing[missing["task"].isin(list(tasks))]
    push = scores[scores["task"].isin(list(tasks))]
    table = full_results(push, missing=absent, rule=rule, metrics=REWARD_PARTS, name="push_split")
    caption = (
        "Push returns by part: approach is earned by walking to the box, push by bringing the box "
        "nearer to the goal, the bonus by goals reached. Mean over seeds ± half width of the 95% t "
        f"interval, or [its ends] where it is cut off at a bound of the quantity. {FEW} From four "
        f"seeds on the IQM in brackets after the return. {str(rule or SafetyRule()).capitalize()}. "
        "A return near that of touching the box says nothing about pushing."
    )
    return Table(table.name, caption, table.data, table.display, table.notes)


# --- formatting ----------------------------------------------------------------------------------


def _table_one_row(
    scores: pd.DataFrame, task: str, rule: SafetyRule, method: str, baselines: Sequence[str]
) -> dict[str, object]:
    ours = statistics.scores_of(scores, task, method, "eval_return")
    best, best_returns = best_safe_baseline(scores, task, rule, baselines)
    own, other = statistics.mean_interval(ours), statistics.mean_interval(best_returns)
    gain = statistics.improvement_interval(ours, best_returns)
    gap = statistics.difference_interval(ours, best_returns)
    tried = [statistics.scores_of(scores, task, v, "eval_return") for v in baselines]
    printed = paper.TABLE_I.get(task)
    return {
        "task": task,
        "safemr": own.mean, "safemr_low": own.low, "safemr_high": own.high, "seeds": own.size,
        "safemr_safe": rule.is_safe(scores, task, method),
        "label": rule.label(scores, task, method),
        "baseline": best, "baseline_return": other.mean,
        "baseline_low": other.low, "baseline_high": other.high, "baseline_seeds": other.size,
        "baseline_runs": sum(map(len, tried)),
        "difference": gap.mean, "difference_low": gap.low, "difference_high": gap.high,
        "improvement": gain.mean, "improvement_low": gain.low, "improvement_high": gain.high,
        "paper_safemr": printed.safemr if printed else np.nan,
        "paper_baseline": printed.best_safe if printed else np.nan,
        "paper_printed": printed.printed_improvement if printed else np.nan,
        "paper_recomputed": printed.improvement if printed else np.nan,
    }  # fmt: skip


def best_safe_baseline(
    scores: pd.DataFrame, task: str, rule: SafetyRule, baselines: Sequence[str]
) -> tuple[str, np.ndarray]:
    """Name and [seeds] returns of the safe baseline with the highest mean; ("", []) if none is."""
    best, returns = "", np.empty(0)
    for variant in baselines:
        values = statistics.scores_of(scores, task, variant, "eval_return")
        better = not len(returns) or (len(values) and values.mean() > returns.mean())
        if better and rule.is_safe(scores, task, variant):
            best, returns = variant, values
    return best, returns


def entries(data: pd.DataFrame, missing: pd.DataFrame | None) -> list[tuple[str, str]]:
    """(task, variant) of every row to print: those with data, then those wholly missing."""
    pairs = list(dict.fromkeys(zip(data["task"], data["variant"], strict=True)))
    if missing is not None:
        absent = zip(missing["task"], missing["variant"], strict=True)
        pairs += [pair for pair in dict.fromkeys(absent) if pair not in pairs]
    order = {variant: index for index, variant in enumerate(paper.ALGORITHMS)}
    tasks = _task_order(pd.Series([task for task, _ in pairs]))
    ranked = sorted(
        zip(tasks, pairs, strict=True),
        key=lambda item: (item[0], order.get(item[1][1], len(order))),
    )
    return [pair for _, pair in ranked]


def _task_order(tasks: pd.Series) -> pd.Series:
    """The paper's tasks in its order, then the others as they come, each one's rows together."""
    order = {task: index for index, task in enumerate(dict.fromkeys((*paper.TASKS, *tasks)))}
    return tasks.map(order)


def _summary_cell(chosen: pd.DataFrame, metric: str) -> str:
    if metric not in chosen.index:
        return ABSENT if len(chosen) else MISSING
    row = chosen.loc[metric]
    if metric in PERCENT_DIGITS:
        mean, low, high = 100 * row[["mean", "low", "high"]].to_numpy(float)
        return plus_minus(mean, low, high, PERCENT_DIGITS[metric], "%")
    cell = plus_minus(row["mean"], row["low"], row["high"], 0 if metric in _WHOLE else 2)
    middle = metric == "eval_return" and row["count"] >= 4  # of fewer, it is the mean
    return f"{cell} [{row['iqm']:.2f}]" if middle else cell


def plus_minus(mean: object, low: object, high: object, digits: int, unit: str = "") -> str:
    """A mean and its interval as printed; nan is a missing run.

    "mean ± half width", or "mean [low, high]" where the interval is not symmetric: it was cut off
    at a bound. Runs that are all equal are no interval: the mean alone.
    """
    estimate = Estimate(float(mean), float(low), float(high), 0)  # type: ignore[arg-type]
    if np.isnan(estimate.mean):
        return MISSING
    shown = f"{estimate.mean:.{digits}f}"
    if np.isnan(estimate.half_width) or estimate.low == estimate.high:
        return shown + unit
    above, below = estimate.high - estimate.mean, estimate.mean - estimate.low
    if abs(above - below) > 1e-6 * (above + below):
        return f"{shown}{unit} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"
    return f"{shown} ± {estimate.half_width:.{digits}f}{unit}"


def _percent(mean: object, low: object, high: object) -> str:
    value, lower, upper = 100 * np.array([mean, low, high], dtype=float)
    if np.isnan(value):
        return MISSING
    if np.isnan(lower) or lower == upper:
        return f"{value:+.1f}%"
    if np.isinf(lower):
        return f"{value:+.1f}% [not bounded]"
    return f"{value:+.1f}% [{lower:+.1f}, {upper:+.1f}]"


def number(value: object, digits: int) -> str:
    """A number as printed; nan is a missing run."""
    known = float(value)  # type: ignore[arg-type]
    return MISSING if np.isnan(known) else f"{known:.{digits}f}"


def _cells(display: pd.DataFrame) -> list[list[str]]:
    return [list(map(str, display.columns)), *(list(map(str, row)) for row in display.values)]


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


_LATEX = {
    "\\": r"\textbackslash{}", "±": r"$\pm$", "–": "--", "%": r"\%", "_": r"\_", "&": r"\&",
    "#": r"\#", "{": r"\{", "}": r"\}", "<": "$<$", ">": "$>$", "$": r"\$",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "≥": r"$\geq$", "≤": r"$\leq$",
}  # fmt: skip


def _latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)
