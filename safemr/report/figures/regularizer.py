"""Return against the size of the unsafe set, a mark a certificate: do [a, b] add to it?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from safemr.report import regularizer, statistics
from safemr.report.figures import style
from safemr.report.figures.finding import name_marks
from safemr.report.tables import Table

# By whether [a, b] are in the loss: colour, marker, words.
LOOKS = {
    True: (style.colour("SafeMR"), "o", "with [a, b] in the loss"),
    False: (style.colour("JointSIS"), "s", "without"),
}


def draw(points: pd.DataFrame, ax: Axes, *, fit: bool) -> pd.DataFrame:
    """A mark a certificate at its runs' mean area, with the interval of their returns, and with
    ``fit`` the curves of `regularizer.curves`.

    points: runs on one task, as `regularizer.at_equal_size` takes them. Returns the marks.
    """
    rows = []
    for variant in style.ordered(points["variant"].unique()):
        runs = points[points["variant"] == variant]
        found = statistics.mean_interval(runs["return"].to_numpy(float))
        made = bool(runs["regularized"].iloc[0])
        rows.append((variant, made, float(runs["area"].mean()), *found[:3]))
    names = ["variant", "regularized", "area", "return", "return_low", "return_high"]
    marks = pd.DataFrame(rows, columns=names)
    for made, part in marks.groupby("regularized"):
        tint, marker, _ = LOOKS[bool(made)]
        area = part["area"]
        look: dict[str, Any] = {"color": tint, "marker": marker, "ls": "none", "ms": 5}
        ax.vlines(area, part["return_low"], part["return_high"], color=tint, lw=0.9, zorder=2)
        ax.plot(area, part["return"], mec="white", mew=0.5, zorder=3, **look)
    if fit:
        areas = np.linspace(marks["area"].min(), marks["area"].max(), 60)
        for made, values in zip((False, True), regularizer.curves(points, areas), strict=True):
            ax.plot(areas, values, color=LOOKS[made][0], lw=1.2, zorder=1)
    ax.margins(x=0.1, y=0.16)
    return marks


@style.styled
def at_equal_size(points: pd.DataFrame, tasks: Sequence[str], table: Table) -> Figure:
    """One panel a task, all certificates with a speed term, named.

    points: `safemr.report.sizes.merged`; table: `regularizer.table` of them.
    """
    said, fitted = regularizer.in_words(table), regularizer.fitted(table)
    columns = min(len(tasks), 2)
    rows = -(-len(tasks) // columns)
    width = style.TEXT_WIDTH if columns > 1 else style.COLUMN_WIDTH
    figure = style.new_figure(width, 0.5 + 2.5 * rows)
    axes = figure.subplots(rows, columns, squeeze=False)
    panels = []
    for ax, task in zip(axes.flat, tasks, strict=False):
        chosen = points[(points["task"] == task) & (points["k"] > 0)]
        ax.set_title("\n".join(filter(None, [task, said[task]])), linespacing=1.3)
        ax.set_xlabel("unsafe area (m$^2$)")
        if chosen.empty:
            style.note(ax, "no record: all runs")
            continue
        panels.append((ax, draw(chosen, ax, fit=task in fitted)))
    for ax in axes.flat[len(tasks) :]:
        ax.remove()
    for ax in axes[:, 0]:
        ax.set_ylabel("return (per episode)")
    handles = [
        Line2D([], [], color=tint, marker=marker, ls="none", ms=5, label=words)
        for tint, marker, words in LOOKS.values()
    ]
    grey: dict[str, Any] = {"color": "0.3", "lw": 1.0}
    handles += [
        Line2D([], [], marker="|", ls="none", ms=9, mew=1.0, color="0.3",
               label="95% interval over seeds"),
    ]  # fmt: skip
    if fitted:
        handles.append(Line2D([], [], **grey, label="least squares: area, its square, [a, b]"))
    style.legend_below(figure, handles, 4 if columns > 1 else 1)
    figure.draw_without_rendering()
    for ax, marks in panels:
        name_marks(marks, ax, x="area")
    return figure
