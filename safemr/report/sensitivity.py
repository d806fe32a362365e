"""Tables over the regularizer's weights [a, b]: the paper's Table II, and a map of many points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from safemr import paper
from safemr.report import statistics
from safemr.report.absence import missing_notes
from safemr.report.tables import MISSING, SafetyRule, Table, number, plus_minus


def table_two(
    final: pd.DataFrame,
    points: Mapping[str, tuple[float, float]],
    *,
    missing: pd.DataFrame | None = None,
    task: str = paper.SENSITIVITY_TASK,
    parameters: Sequence[str] = paper.Zeta._fields,
) -> Table:
    """Table II: learned [sigma, k, n] for each [a, b], per seed and mean.

    Beside the paper's, on the task that it names.
    final: score table with the last values of ``parameters`` (`statistics.last_values`), which are
    those of the energy's family. points: variant -> (a, b).
    """
    papers = task == paper.SENSITIVITY_TASK and tuple(parameters) == paper.Zeta._fields
    rows = []
    for variant, (a, b) in points.items():
        zeta = {name: _by_seed(final, task, variant, name) for name in parameters}
        for seed in sorted(set().union(*(values.index for values in zeta.values()))):
            rows.append([a, b, variant, str(seed), *(zeta[name][seed] for name in zeta)])
        means = [statistics.mean_interval(values.to_numpy(float)) for values in zeta.values()]
        rows.append([a, b, variant, "mean", *(m.mean for m in means)])
        if not any(np.isnan(m.half_width) for m in means):
            rows.append([a, b, variant, "half width", *(m.half_width for m in means)])
        if papers and (a, b) in paper.TABLE_II:
            rows.append([a, b, variant, "paper", *paper.TABLE_II[(a, b)]])
    data = pd.DataFrame(rows, columns=["a", "b", "variant", "seed", *parameters])
    display = pd.DataFrame(
        {
            "[a, b]": [f"[{a:g}, {b:g}]" for a, b in zip(data["a"], data["b"], strict=True)],
            "seed": data["seed"],
            **{name: [number(value, 3) for value in data[name]] for name in parameters},
        }
    )
    beside = ", and the paper's" if papers else ""
    caption = (
        f"{'Table II. ' * papers}Learned energy-function parameters on {task} for each [a, b]: "
        f"last value of each run, mean and half width of the 95% t interval over seeds{beside}."
    )
    return Table("table2", caption, data, display, missing_notes(missing, [task], list(points)))


def weight_map(
    scores: pd.DataFrame,
    learned: pd.DataFrame,
    points: Mapping[str, tuple[float, float]],
    *,
    missing: pd.DataFrame | None = None,
    rule: SafetyRule | None = None,
    task: str = paper.SENSITIVITY_TASK,
    method: str = paper.METHOD,
    baseline: str = paper.ABLATION,
    parameters: Sequence[str] = paper.Zeta._fields,
) -> Table:
    """Final performance and last zeta over a grid of [a, b]; one row of `data` a point.

    scores: `statistics.final_scores`. learned: score table with the last values of ``parameters``,
    those of the energy's family (`statistics.last_values`). points: variant -> (a, b). The
    difference of returns to `baseline`, which has no regularizer, is Welch's.
    """
    rule = rule or SafetyRule()
    base = statistics.scores_of(scores, task, baseline, "eval_return")
    rows, runs = [], []
    for variant, (a, b) in sorted(points.items(), key=lambda item: item[1]):
        returns = statistics.scores_of(scores, task, variant, "eval_return")
        runs += [(a, b, value) for value in returns]
        mean, gap = statistics.mean_interval(returns), statistics.difference_interval(returns, base)
        measured = [statistics.scores_of(scores, task, variant, m) for m in (rule.cost, rule.clean)]
        zeta = [statistics.scores_of(learned, task, variant, name) for name in parameters]
        means = [statistics.mean_interval(values).mean for values in (*measured, *zeta)]
        rows.append([a, b, variant, mean.size, mean.mean, mean.half_width, *gap[:3], *means])
    columns = ["a", "b", "variant", "seeds", "return", "half_width", "gain", "gain_low"]
    columns += ["gain_high", "violating_steps", "clean_share", *parameters]
    data = pd.DataFrame(rows, columns=columns)
    display = pd.DataFrame(
        [
            [
                f"[{row['a']:g}, {row['b']:g}]",
                f"{row['seeds']}",
                plus_minus(row["return"], row["return"] - row["half_width"],
                            row["return"] + row["half_width"], 2),
                plus_minus(row["gain"], row["gain_low"], row["gain_high"], 2),
                number(row["violating_steps"], 2),
                MISSING if np.isnan(row["clean_share"]) else f"{row['clean_share']:.1%}",
                *(number(row[name], 3) for name in parameters),
            ]
            for _, row in data.iterrows()
        ],
        columns=["[a, b]", "seeds", "return", f"minus {baseline}", "violating steps",
                 "clean episodes", *parameters],
    )  # fmt: skip
    caption = (
        f"{method} over weights [a, b] on {task}: final return and its difference to {baseline}'s, "
        "mean over seeds ± half width of the 95% interval; violating steps, clean episodes and the "
        f"last {', '.join(parameters)}, means over seeds. The intervals are not corrected for the "
        "number of points."
    )
    notes = [*_trend(np.array(runs).reshape(-1, 3)), *missing_notes(missing, [task], list(points))]
    return Table("weight_map", caption, data, display, notes)


def _trend(runs: np.ndarray) -> list[str]:
    """What a and b do to the return over all points; runs [n, 3]: a, b, return."""
    runs = runs[np.isfinite(runs[:, 2])]
    a, b = statistics.linear_effects(runs[:, :2] / 0.1, runs[:, 2])
    if np.isnan(a.mean):
        return []
    shown = [f"{slope.mean:+.2f} ± {slope.half_width:.2f}" for slope in (a, b)]
    return [
        f"Least squares over the {len(runs)} runs: 0.1 more of a changes the return by {shown[0]}, "
        f"0.1 more of b by {shown[1]} (95% t intervals, runs treated as independent)."
    ]


def _by_seed(scores: pd.DataFrame, task: str, variant: str, metric: str) -> pd.Series:
    chosen = scores[
        (scores["task"] == task) & (scores["variant"] == variant) & (scores["metric"] == metric)
    ]
    return chosen.set_index("seed")["value"]
