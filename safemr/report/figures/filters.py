"""Final policies with and without the filters of certificates: what each keeps and prevents."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from safemr.report.figures import style

UNFILTERED = "no filter"
_LOOKS = {  # of filters that nobody learns
    UNFILTERED: ("#000000", "|", UNFILTERED),
    "phi_0": ("#555555", "P", r"$\phi_0$"),
    "phi_h": ("#E69F00", "X", r"$\phi_h$"),
}


def look(name: str) -> tuple[str, str, str]:
    """Colour, marker and printed name of a filter; a learned one looks as its variant."""
    return _LOOKS.get(name) or (style.colour(name), style.marker(name), style.label(name))


def draw(
    points: pd.DataFrame, column: str, ax: Axes, policies: Sequence[str], filters: Sequence[str]
) -> Axes:
    """A row a policy, in it the filters one below the other: each run small, their mean large.

    points: variant, filter, seed and ``column``.
    """
    step = 0.8 / max(len(filters), 1)
    for place, name in enumerate(filters):
        tint, marker, _ = look(name)
        for row, policy in enumerate(policies):
            chosen = points[(points["variant"] == policy) & (points["filter"] == name)][column]
            if not len(chosen):
                continue
            height = row + step * (place - (len(filters) - 1) / 2)
            looks = {"color": tint, "marker": marker, "ls": "none", "mew": 1.2 * (marker == "|")}
            ax.plot(chosen, np.full(len(chosen), height), ms=2.5, alpha=0.6, **looks)
            ax.plot(chosen.mean(), height, ms=6 if marker == "|" else 4.5, zorder=3, **looks)
    for row in range(1, len(policies)):
        ax.axhline(row - 0.5, color="0.8", lw=0.5)
    ax.set_yticks(range(len(policies)), [style.label(policy) for policy in policies])
    ax.set_ylim(len(policies) - 0.5, -0.5)
    ax.grid(False, axis="y")
    ax.tick_params(axis="y", length=0)
    return ax


@style.styled
def behind_filters(flown: pd.DataFrame) -> Figure:
    """Return and share of episodes with a violation, one row of panels a task.

    flown: `safemr.measure.filters.measured_scores`, or what was read of its CSV.
    """
    wide = (
        flown.assign(filter=flown["filter"].fillna("").replace("", UNFILTERED))
        .pivot_table(index=["task", "variant", "filter", "seed"], columns="metric", values="value")
        .reset_index()
    )
    wide["dirty"] = 100 * (1 - wide["zero_violation_share"])
    tasks = list(dict.fromkeys(flown["task"]))
    policies = style.ordered(wide["variant"].unique())
    filters = list(dict.fromkeys(flown["filter"].fillna("").replace("", UNFILTERED)))
    height = 0.45 + len(tasks) * (0.35 + 0.085 * len(policies) * (len(filters) + 1))
    figure = style.new_figure(style.TEXT_WIDTH, height)
    axes = figure.subplots(len(tasks), 2, squeeze=False, sharey="row")
    for (left, right), task in zip(axes, tasks, strict=True):
        chosen = wide[wide["task"] == task]
        draw(chosen, "return", left, policies, filters)
        draw(chosen, "dirty", right, policies, filters)
        left.set_title(task)
        most = max(float(chosen["dirty"].max()), 5.0)
        right.set_xlim(-0.03 * most, 1.06 * most)
    axes[-1, 0].set_xlabel("return")
    axes[-1, 1].set_xlabel("episodes with a violation (%)")
    handles = []
    for name in filters:
        tint, marker, text = look(name)
        handles.append(
            Line2D([], [], color=tint, marker=marker, ls="none", ms=4.5,
                   mew=1.2 * (marker == "|"), label=text)
        )  # fmt: skip
    columns = style.legend_columns(filters)
    style.legend_below(figure, handles, columns)
    return figure
