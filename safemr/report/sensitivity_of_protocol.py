"""What the judgements would be on other windows, and what training itself violated: two tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from safemr.report import statistics
from safemr.report.tables import FEW, Table, entries, plus_minus

WINDOWS = (1, 2, 4, 8)  # last evaluations of a run that are averaged
KEYS = ["task", "variant", "seed"]


def windows(
    progress: pd.DataFrame,
    flown: pd.DataFrame,
    tasks: Sequence[str],
    method: str,
    baselines: Sequence[str],
) -> Table:
    """The method's return minus each baseline's, by what is taken for final performance.

    progress: tidy table, of whose evaluations the last 1, 2, 4, 8 are averaged. flown: score table
    of the final policies on unseen layouts. `data` has one row (task, variant, final).
    """
    evaluations = progress[progress["metric"] == "eval_return"].dropna(subset=["value"])
    evaluations = evaluations.sort_values("step")
    by_window: dict[str, pd.DataFrame] = {
        f"last {count}": evaluations.groupby(KEYS)["value"]
        .agg(lambda values, count=count: values.iloc[-count:].mean())
        .reset_index()
        .assign(metric="eval_return")
        for count in WINDOWS
    }
    by_window["flown"] = flown
    rows, lines = [], []
    for task in tasks:
        for variant in baselines:
            line = {"task": task, "minus": variant}
            for final, scores in by_window.items():
                pair = [
                    statistics.scores_of(scores, task, name, "eval_return")
                    for name in (method, variant)
                ]
                gap = statistics.difference_interval(*pair)
                rows.append([task, variant, final, *gap])
                line[final] = plus_minus(*gap[:3], 2)
            lines.append(line)
    data = pd.DataFrame(
        rows, columns=["task", "variant", "final", "difference", "low", "high", "count"]
    )
    caption = (
        f"{method}'s final return minus each baseline's, by what is taken for final performance: "
        "the mean over the last 1, 2, 4 or 8 evaluations of the curve, on the layouts that they "
        "repeat, and the final policy flown on unseen ones, which is what verdicts use. Mean over "
        f"seeds ± half width of Welch's 95% interval. {FEW}"
    )
    return Table("windows", caption, data, pd.DataFrame(lines))


def training_violations(progress: pd.DataFrame) -> Table:
    """Violating steps of training, of all algorithms until the same step and in whole runs.

    The same step is the shortest budget on the task. A row of the log has means over the episodes
    finished since the last; a count until a step within a row of the log takes its share. `data`
    has one row (task, variant).
    """
    wide = progress[progress["metric"].isin(["train_cost_indicator", "train_episodes"])]
    wide = wide.pivot_table(index=[*KEYS, "step"], columns="metric", values="value")
    wide = wide.reindex(columns=["train_cost_indicator", "train_episodes"]).dropna()
    steps = progress.groupby(KEYS)["step"].max()
    common = steps.groupby(level="task").min()
    count = (wide["train_cost_indicator"] * wide["train_episodes"]).rename("count")
    total = count.groupby(level=KEYS).cumsum().reset_index()
    rows = []
    for run, log in total.groupby(KEYS, sort=False):
        task, variant, seed = run
        at = np.interp(common[task], [0, *log["step"]], [0, *log["count"]])
        whole = float(log["count"].iloc[-1])
        rows.append([task, variant, seed, float(at), whole, int(steps[run])])
    runs = pd.DataFrame(rows, columns=[*KEYS, "at_common", "whole", "steps"])
    data_rows, lines = [], []
    for task, variant in entries(runs, None):
        chosen = runs[(runs["task"] == task) & (runs["variant"] == variant)]
        at, whole = (
            statistics.mean_interval(chosen[name].to_numpy(float), bounds=(0.0, np.inf))
            for name in ("at_common", "whole")
        )
        length = int(chosen["steps"].max())
        data_rows.append([task, variant, int(common[task]), *at[:3], length, *whole])
        lines.append(
            [task, variant, str(whole.size), f"{common[task]:,}", plus_minus(*at[:3], 0),
             f"{length:,}", plus_minus(*whole[:3], 0), f"{1000 * whole.mean / length:.2f}"]
        )  # fmt: skip
    data = pd.DataFrame(
        data_rows,
        columns=["task", "variant", "common_steps", "violations", "low", "high", "steps",
                 "whole_violations", "whole_low", "whole_high", "count"],
    )  # fmt: skip
    display = pd.DataFrame(
        lines,
        columns=["task", "algorithm", "seeds", "until step", "violating steps", "whole run",
                 "violating steps of it", "per 1,000 steps"],
    )  # fmt: skip
    caption = (
        "Violations while training: violating control steps of the exploring policy until the "
        "step at which the shorter family's runs end, and in whole runs. Mean over seeds ± half "
        f"width of the 95% t interval, or [its ends] where it is cut off at 0. {FEW}"
    )
    return Table("training_violations", caption, data, display)
