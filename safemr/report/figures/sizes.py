"""Return and violations of final policies against the size of their certificate's unsafe set."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from safemr.report.figures import style


def draw(points: pd.DataFrame, column: str, ax: Axes, oracle: float) -> Axes:
    """A marker a run at its certificate's area, hollow where that is not feasible.

    points: variant, area, feasible and ``column``; oracle: the area of the least feasible one.
    """
    ax.axvline(oracle, color=style.INK, lw=0.7, ls=(0, (3, 2)), zorder=1)
    for variant in style.ordered(points["variant"].unique()):
        runs, tint = points[points["variant"] == variant], style.colour(variant)
        look: dict[str, Any] = {"color": tint, "marker": style.marker(variant), "ls": "none"}
        for feasible, chosen in runs.groupby("feasible"):
            fill = {"mec": "white", "mew": 0.4} if feasible else {"mfc": "none", "mew": 1.0}
            ax.plot(chosen["area"], chosen[column], ms=4.5, zorder=3, **look, **fill)
    ax.set_xlim(left=-0.03 * max(points["area"].max(), oracle))
    return ax


@style.styled
def against_size(
    points: pd.DataFrame, tasks: Sequence[str], oracles: Mapping[str, float]
) -> Figure:
    """Two rows of panels, one column a task: return, and violating steps an episode.

    points: `safemr.report.sizes.merged`; oracles: task -> area of its oracle.
    """
    variants = style.ordered(points["variant"].unique())
    columns = style.legend_columns([*variants, "oracle", "not feasible"])
    rows = math.ceil((len(variants) + 2) / columns)  # of the legend
    figure = style.new_figure(style.text_width(len(tasks)), 3.2 + 0.2 * rows)
    axes = figure.subplots(2, len(tasks), squeeze=False, sharex="col")
    for column, task in enumerate(tasks):
        chosen = points[points["task"] == task]
        upper, lower = axes[:, column]
        draw(chosen, "return", upper, oracles[task])
        draw(chosen, "violating", lower, oracles[task])
        lower.set_yscale("symlog", linthresh=0.1)
        lower.set_ylim(-0.02, max(2.0 * chosen["violating"].max(), 0.2))
        lower.yaxis.set_major_formatter("{x:g}")
        upper.set_title(task)
        lower.set_xlabel("unsafe area (m$^2$)")
    axes[0, 0].set_ylabel("return (per episode)")
    axes[1, 0].set_ylabel("violating steps an episode\n(linear to 0.1, then log)")
    handles = style.marks(variants)
    handles.append(Line2D([], [], color=style.INK, lw=0.7, ls=(0, (3, 2)), label="oracle"))
    handles.append(
        Line2D([], [], color=style.INK, marker="o", mfc="none", ls="none", ms=4,
               label="not feasible")
    )  # fmt: skip
    style.legend_below(figure, handles, columns)
    return figure
