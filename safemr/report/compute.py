"""The table of what the runs cost."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safemr.report.absence import missing_notes
from safemr.report.tables import ABSENT, Table, entries


def table(
    runs: pd.DataFrame, *, missing: pd.DataFrame | None = None, workers: bool = False
) -> Table:
    """What the runs cost: processor time, speed and memory of each variant on each task.

    runs: the runs table (task, variant, seed, steps, cpu_s, wall_s, peak_rss_mb, cpu). Records from
    outside need not say what they cost: means are over the runs that do, and a note counts the
    others. workers: some runs were made by several processes, which a note says.
    """
    rows, silent = [], []
    for task, variant in entries(runs, None):
        chosen = runs[(runs["task"] == task) & (runs["variant"] == variant)]
        timed = chosen[chosen["cpu_s"] > 0]
        core_s = float(timed["cpu_s"].sum()) if len(timed) else float("nan")
        rows.append(
            {
                "task": task,
                "variant": variant,
                "runs": len(chosen),
                "steps": int(chosen["steps"].iloc[0]),
                "core_minutes": core_s / 60 / max(len(timed), 1),
                "steps_per_core_s": timed["steps"].sum() / core_s,
                "peak_mb": float(chosen["peak_rss_mb"].max()),
                "core_hours": core_s / 3600,
            }
        )
        if len(timed) < len(chosen):
            silent.append(f"{variant} on {task} ({len(chosen) - len(timed)} of {len(chosen)})")
    data = pd.DataFrame(rows)

    def shown(name: str, form: str) -> list[str]:
        return [ABSENT if np.isnan(value) else form.format(value) for value in data[name]]

    display = pd.DataFrame(
        {
            "task": data["task"],
            "algorithm": data["variant"],
            "runs": data["runs"],
            "steps a run": data["steps"].map("{:,}".format),
            "core-minutes a run": shown("core_minutes", "{:.1f}"),
            "steps a core-second": shown("steps_per_core_s", "{:,.0f}"),
            "peak MB": shown("peak_mb", "{:.0f}"),
        }
    )
    hours, processors = data["core_hours"].sum(), ", ".join(sorted(set(runs["cpu"].dropna())))
    caption = (
        f"Compute of the {len(runs)} recorded runs: {hours:.1f} core-hours in all, one thread a "
        f"run, evaluations included ({processors or 'no record names its processor'})."
    )
    notes = [*missing_notes(missing, None, None)]
    if silent:
        notes.append(f"Records that do not say their processor time: {'; '.join(silent)}.")
    if workers:
        notes.append(
            "Of a run by several processes this is the driver's time and memory; its workers' time "
            "is in the table of one process and several."
        )
    return Table("compute", caption, data, display, notes)
