"""The finding in one picture: what the final policies return, and how often they violate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke
from matplotlib.transforms import Bbox

from safemr import paper
from safemr.report.figures import style
from safemr.report.tables import SafetyRule

SAFE = "#009E73"
MOST_LABELS = 8  # of variants that are named beside their marks
# Where a name may stand beside its mark: offset in points, and which of its corners is there.
_SIDES = ((1, 0, "left", "center"), (-1, 0, "right", "center"), (0.7, 0.8, "left", "bottom"),
          (0.7, -0.8, "left", "top"), (-0.7, 0.8, "right", "bottom"), (-0.7, -0.8, "right", "top"),
          (0, 1.1, "center", "bottom"), (0, -1.1, "center", "top"))  # fmt: skip
_REACHES = (6.0, 12.0, 20.0, 30.0)


def draw_marks(points: pd.DataFrame, ax: Axes, *, dirty_share: float) -> Axes:
    """A mark an algorithm with its intervals, hollow where it is not safe.

    points: variant, safe, return, dirty [% of episodes], and their _low and _high. ``dirty_share``:
    how many episodes may violate; less is shaded.
    """
    ax.axvspan(-100, 100 * dirty_share, color=SAFE, alpha=0.09, lw=0, zorder=0)
    ax.axvline(100 * dirty_share, color=SAFE, lw=0.8, ls=(0, (3, 2)), zorder=1)
    for _, row in points.iloc[::-1].iterrows():
        tint, _, mark = style.look(str(row["variant"]))
        bars: dict[str, Any] = {"color": tint, "lw": 1.0, "zorder": 2}
        ax.plot([row["dirty"]] * 2, [row["return_low"], row["return_high"]], **bars)
        ax.plot([row["dirty_low"], row["dirty_high"]], [row["return"]] * 2, **bars)
        fill: dict[str, Any] = (
            {"mec": "white", "mew": 0.6} if row["safe"] else {"mfc": "white", "mew": 1.3}
        )
        ax.plot(row["dirty"], row["return"], marker=mark, color=tint, ms=6.5, zorder=3, **fill)
    right = max(float(np.nanmax(points[["dirty", "dirty_high"]])), 200 * dirty_share)
    ax.set_xlim(-0.06 * right, min(1.08 * right, 103.0))
    ax.margins(y=0.14)
    return ax


def name_marks(points: pd.DataFrame, ax: Axes, *, x: str = "dirty", bold: str = "") -> None:
    """Names beside the marks, where they cover least; the layout of the figure must be done.

    points: variant, return and ``x``, and where there are intervals their _low and _high.
    """
    figure = ax.get_figure()
    assert figure is not None
    scale = figure.dpi / 72
    marks = ax.transData.transform(points[[x, "return"]].to_numpy(float))
    reach = 4 * scale
    covered = [(Bbox.from_extents(*(mark - reach), *(mark + reach)), 3.0) for mark in marks]
    for _, row in points.iterrows():
        left, right = row.get(f"{x}_low", np.nan), row.get(f"{x}_high", np.nan)
        for low, high in (
            ((row[x], row["return_low"]), (row[x], row["return_high"])),
            ((left, row["return"]), (right, row["return"])),
        ):
            if not np.isnan([*low, *high]).any():
                (x0, y0), (x1, y1) = ax.transData.transform([low, high])
                covered.append((Bbox.from_extents(x0 - 1, y0 - 1, x1 + 1, y1 + 1), 1.0))
    texts = []
    for variant in points["variant"]:
        text = ax.annotate(
            style.label(variant), (0, 0), xycoords="figure points", fontsize=style.SMALL,
            fontweight="bold" if variant == bold else "normal", zorder=5,
        )  # fmt: skip
        text.set_path_effects([Stroke(linewidth=1.6, foreground="white"), Normal()])
        text.set_in_layout(False)
        texts.append(text)
    places = [
        [
            (_placed(mark, text.get_window_extent(), side, reach * scale), reach)
            for reach in _REACHES
            for side in _SIDES
        ]
        for mark, text in zip(marks, texts, strict=True)
    ]
    alone = [
        [_cost(box, covered, ax) + reach / 10 + _astray(box, own, marks) for box, reach in found]
        for own, found in enumerate(places)
    ]
    chosen: dict[int, int] = {}
    for _ in range(5):  # each beside the others as they stand, until none moves
        before = dict(chosen)
        for own, found in enumerate(places):
            others = [(places[o][at][0], 6.0) for o, at in chosen.items() if o != own]
            costs = [c + _common(b, others) for (b, _), c in zip(found, alone[own], strict=True)]
            chosen[own] = int(np.argmin(costs))
        if chosen == before:
            break
    for own, (mark, text) in enumerate(zip(marks, texts, strict=True)):
        box, reach = places[own][chosen[own]]
        text.set_position((box.x0 / scale, box.y0 / scale))
        if reach > _REACHES[0]:
            near = np.clip(mark, [box.x0, box.y0], [box.x1, box.y1])
            ends = ax.transData.inverted().transform([mark, near])
            ax.plot(*ends.T, color="0.5", lw=0.4, zorder=1.5)


def _placed(
    mark: np.ndarray, size: Bbox, side: tuple[float, float, str, str], reach: float
) -> Bbox:
    x, y = mark[0] + side[0] * reach, mark[1] + side[1] * reach
    left = x - {"left": 0.0, "center": 0.5, "right": 1.0}[side[2]] * size.width
    low = y - {"bottom": 0.0, "center": 0.5, "top": 1.0}[side[3]] * size.height
    return Bbox.from_bounds(left, low, size.width, size.height)


def _cost(box: Bbox, covered: Sequence[tuple[Bbox, float]], ax: Axes) -> float:
    """Square pixels that a name covers of others, weighted, and of what is outside."""
    inside = _common(box, [(ax.bbox.padded(-4), 1.0)])
    return _common(box, covered) + 10 * (box.width * box.height - inside)


def _common(box: Bbox, covered: Sequence[tuple[Bbox, float]]) -> float:
    """Square pixels that a name covers of others, weighted."""
    shared = ((Bbox.intersection(box, other), weight) for other, weight in covered)
    return sum(weight * both.width * both.height for both, weight in shared if both is not None)


def _astray(box: Bbox, own: int, marks: np.ndarray) -> float:
    """A line's height squared where another mark is about as near to a name as its own.

    A name is read with the mark on its line: across counts half.
    """
    gaps = np.hypot(*(np.clip(marks, box.p0, box.p1) - marks).T * [[0.5], [1.0]])
    others = np.delete(gaps, own)
    return box.height**2 if others.size and others.min() < 1.4 * gaps[own] else 0.0


@style.styled
def finding(
    points: pd.DataFrame,
    ahead: pd.DataFrame,
    tasks: Sequence[str],
    *,
    method: str = paper.METHOD,
    rule: SafetyRule | None = None,
    where: str = "",
) -> Figure:
    """Return against the share of episodes with a violation, one panel a task, all named.

    points, ahead: `safemr.report.finding`'s. ``where`` says which layouts were flown.
    """
    rule = rule or SafetyRule()
    variants = style.ordered(points["variant"].unique())
    columns = min(len(tasks), 2 if len(tasks) <= 4 else 4)
    rows = -(-len(tasks) // columns)
    named = len(variants) <= MOST_LABELS
    width = style.COLUMN_WIDTH if len(tasks) == 1 and named else style.TEXT_WIDTH
    figure = style.new_figure(
        width, 0.5 + 2.15 * rows + 0.4 * (width < style.TEXT_WIDTH or not named)
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    panels = []
    for ax, task in zip(axes.flat, tasks, strict=False):
        chosen = points[points["task"] == task].set_index("variant", drop=False)
        chosen = chosen.loc[style.ordered(chosen["variant"])]
        said = ahead.loc[ahead["task"] == task, "text"]
        ax.set_title("\n".join([task, *said]), linespacing=1.3)
        ax.set_xlabel("episodes with a violation (%)")
        if chosen.empty:
            style.note(ax, "no record: all runs")
            continue
        draw_marks(chosen, ax, dirty_share=1 - rule.clean_share)
        panels.append((ax, chosen))
    for ax in axes.flat[len(tasks) :]:
        ax.remove()
    for ax in axes[:, 0]:
        ax.set_ylabel("return (per episode)")
    look: dict[str, Any] = {"color": "0.3", "marker": "o", "ls": "none", "ms": 5.5}
    limit = f"violations in at most {100 * (1 - rule.clean_share):g}% of episodes"
    safe, hollow = rule.marks
    handles = [
        Patch(fc=SAFE, alpha=0.12, label=limit),
        Line2D([], [], **look, label=safe),
        Line2D([], [], **look, mfc="white", mew=1.2, label=hollow),
        Line2D([], [], color="0.3", lw=1.0, label="95% interval over seeds"),
    ]  # fmt: skip
    if not named:
        handles += style.marks(variants)
    style.legend_below(figure, handles, 4 if width > style.COLUMN_WIDTH else 1)
    if where:
        figure.suptitle(where)
    if named:
        figure.draw_without_rendering()
        for ax, chosen in panels:
            name_marks(chosen, ax, bold=method)
    return figure
