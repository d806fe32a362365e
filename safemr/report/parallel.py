"""The table of runs that several processes made (`safemr.parallel`), beside those of one."""

from __future__ import annotations

import pandas as pd

from safemr.report import statistics
from safemr.report.absence import missing_notes
from safemr.report.statistics import Estimate
from safemr.report.tables import ABSENT, FEW, Table, entries, plus_minus

AGES = ("gradient_age", "policy_age")


def table(
    scores: pd.DataFrame,
    progress: pd.DataFrame,
    runs: pd.DataFrame,
    *,
    missing: pd.DataFrame | None = None,
) -> Table:
    """What several processes change: returns, violations, ages of gradients, processor time.

    scores: `statistics.final_scores`. progress: the log in long format (task, variant, seed, step,
    metric, value). runs: the runs table (task, variant, seed, cpu_s, wall_s).
    """
    logged = progress[progress["metric"].isin([*AGES, *(f"{name}_max" for name in AGES)])]
    last = statistics.last_values(progress, ["lost_tasks", "workers_cpu_s"])
    rows = []
    for task, variant in entries(runs, None):
        ours = runs[(runs["task"] == task) & (runs["variant"] == variant)]
        rows_of = logged[(logged["task"] == task) & (logged["variant"] == variant)]
        by_metric = rows_of.groupby("metric")["value"]
        means, highest = by_metric.mean(), by_metric.max()
        returned, violating, clean = (
            statistics.score_interval(scores, task, variant, metric)
            for metric in ("eval_return", "eval_cost_indicator", "eval_zero_violation_share")
        )
        workers, lost = (
            statistics.scores_of(last, task, variant, metric)
            for metric in ("workers_cpu_s", "lost_tasks")
        )
        row = {
            **{"task": task, "variant": variant, "runs": len(ours)},
            **_interval("return", returned),
            **_interval("violating_steps", violating),
            "clean_episodes": clean.mean,
            **{name: means.get(name, float("nan")) for name in AGES},
            **{f"{name}_max": highest.get(f"{name}_max", float("nan")) for name in AGES},
            "lost_tasks": lost.sum() if len(lost) else float("nan"),
            "driver_cpu_s": ours["cpu_s"].mean(),
            "workers_cpu_s": workers.mean() if len(workers) else float("nan"),
            "wall_s": ours["wall_s"].mean(),
        }
        rows.append(row)
    data = pd.DataFrame(rows)
    display = pd.DataFrame(
        [
            [
                *(row["task"], row["variant"], str(row["runs"])),
                plus_minus(row["return"], row["return_low"], row["return_high"], 2),
                plus_minus(
                    row["violating_steps"],
                    row["violating_steps_low"],
                    row["violating_steps_high"],
                    2,
                ),
                _shown(100 * row["clean_episodes"], "{:.0f}%"),
                *(
                    _shown(row[name], "{:.1f}")
                    + _shown(row[f"{name}_max"], " (at most {:.0f})", "")
                    for name in AGES
                ),
                *(
                    _shown(row[name], "{:.0f}")
                    for name in ("lost_tasks", "driver_cpu_s", "workers_cpu_s", "wall_s")
                ),
            ]
            for row in rows
        ],
        columns=[
            *("task", "algorithm", "runs", "return", "violating steps", "clean episodes"),
            *("age of gradients", "age of the acting policy", "lost tasks"),
            *("CPU seconds of the program", "of its workers", "wall seconds"),
        ],
    )
    caption = (
        "One process and several: final evaluations, ages in gradient steps, and seconds a run. "
        f"The program is the one process, or the driver. {FEW}"
    )
    return Table("parallel", caption, data, display, [*missing_notes(missing, None, None)])


def _interval(name: str, estimate: Estimate) -> dict[str, float]:
    return {name: estimate.mean, f"{name}_low": estimate.low, f"{name}_high": estimate.high}


def _shown(value: float, form: str, absent: str = ABSENT) -> str:
    return absent if pd.isna(value) else form.format(value)
