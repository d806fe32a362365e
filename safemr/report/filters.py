"""Final policies with and without the safety filter of a certificate, as a table."""

from __future__ import annotations

import numpy as np
import pandas as pd

from safemr.report import statistics
from safemr.report.tables import ABSENT, FEW, Table, plus_minus

NONE = "none"  # a filter in a table


def table(flown: pd.DataFrame, *, episodes: int) -> Table:
    """A row a task, policy and filter: return, violations, interventions, time.

    flown: `safemr.measure.filters.measured_scores`, or what was read of its CSV.
    """
    flown = flown.assign(filter=flown["filter"].fillna(""))
    rows = []
    for (task, variant, name), part in flown.groupby(["task", "variant", "filter"], sort=False):
        wide = part.pivot_table(index="seed", columns="metric", values="value")
        returned = statistics.mean_interval(wide["return"].to_numpy())
        violating = statistics.mean_interval(wide["cost_indicator"].to_numpy())
        dirty = round(float((episodes * (1 - wide["zero_violation_share"])).sum()))
        weights = wide["intervened"] / max(float(wide["intervened"].sum()), 1e-12)
        rows.append(
            {
                "task": task, "policy": variant, "filter": name or NONE, "seeds": len(wide),
                "return": returned.mean, "return_low": returned.low, "return_high": returned.high,
                "violating_steps": violating.mean,
                "steps_low": violating.low, "steps_high": violating.high,
                "violating_episodes": dirty, "episodes": episodes * len(wide),
                "intervened": wide["intervened"].mean() if name else np.nan,
                "distance": (weights * wide["distance"]).sum() if name else np.nan,
                "infeasible": wide["infeasible"].mean() if name else np.nan,
                "microseconds": wide["microseconds"].mean() if name else np.nan,
            }
        )  # fmt: skip
    data = pd.DataFrame(rows)

    def cell(value: float, form: str) -> str:
        return ABSENT if pd.isna(value) else format(value, form)

    display = pd.DataFrame(
        [
            [
                row["task"], row["policy"], row["filter"], str(row["seeds"]),
                plus_minus(row["return"], row["return_low"], row["return_high"], 2),
                plus_minus(row["violating_steps"], row["steps_low"], row["steps_high"], 2),
                f"{row['violating_episodes']} of {row['episodes']}",
                cell(row["intervened"], ".1%"), cell(row["distance"], ".2f"),
                cell(row["infeasible"], ".2%"), cell(row["microseconds"], ".0f"),
            ]
            for row in rows
        ],
        columns=["task", "policy", "filter", "seeds", "return", "violating steps",
                 "episodes with a violation", "interventions", "their size",
                 "without a safe action", "µs a step"],
    )  # fmt: skip
    caption = (
        f"Final policies on {episodes} layouts that no run was evaluated on, the same for all, "
        "without and behind the safety filter of a certificate, a learned one being that of the "
        f"run with the policy's seed: mean over seeds ± half width of the 95% t interval. {FEW} "
        "Interventions: share of the decisions in which not the policy's action was taken; their "
        "size: mean distance of the two, a component's useful range being 2; without a safe "
        "action: share of the decisions in which no candidate kept the constraint; µs a step: "
        "processor time that the filter takes for a control step of one of the worlds, which are "
        "stepped together, on the machine that measured it."
    )
    return Table("filters", caption, data, display)
