"""Aircraft: claimed unsafe sets against the true one, and learners against the frontier.

All sets come as functions on one plane grid, x [X] ahead and y [Y] to the left of the evader in
metres: ``truth`` is the value V (unsafe where <= 0), the others are unsafe where > 0.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch, Polygon
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from safemr.aircraft.slices import Slice
from safemr.report.figures import style

Array = NDArray[np.float64]

TRUE = "#B2182B"  # the paper draws the true boundary in red
_PERIOD = 9.0  # of learners' dashes, in line widths
_HANDCRAFTED, _HANDCRAFTED_LABEL = "FAC-phih", r"handcrafted $\phi_h$"
# The left half of an aircraft's outline, nose at the right, one unit long.
_OUTLINE_X = (0.5, 0.42, 0.12, -0.12, -0.22, -0.1, -0.34, -0.43, -0.5, -0.46)
_OUTLINE_Y = (0.0, 0.05, 0.06, 0.46, 0.46, 0.06, 0.04, 0.18, 0.18, 0.0)


def draw_aircraft(
    ax: Axes, x: float, y: float, psi: float, colour: str, length: float = 2.4
) -> Axes:
    """An aircraft at (x, y) [m], flying along psi [rad]."""
    left = np.column_stack([_OUTLINE_X, _OUTLINE_Y])
    outline = np.concatenate([left, left[-2:0:-1] * [1, -1]])
    turn = np.array([[np.cos(psi), np.sin(psi)], [-np.sin(psi), np.cos(psi)]])
    points = style.steady(length * outline @ turn + [x, y])
    ax.add_patch(Polygon(points, closed=True, fc=colour, ec="white", lw=0.4, zorder=9))
    return ax


def draw_slice(ax: Axes, x: Array, y: Array, cut: Slice, d_min: float) -> Axes:
    """Boundaries of all unsafe sets around the evader, which flies to the right.

    Of a learner's runs the median boundary, and shaded what is unsafe by some of them only.
    """
    ax.contourf(x, y, cut.truth.T, levels=[-np.inf, 0], colors=[TRUE], alpha=0.13)
    ax.add_patch(Circle((0, 0), d_min, fc="0.8", ec="0.35", lw=0.8, alpha=0.9, zorder=2))
    ax.contour(x, y, cut.truth.T, levels=[0], colors=[TRUE], linewidths=2.0, zorder=4)
    if cut.adversarial is not None:
        ax.contour(x, y, cut.adversarial.T, levels=[0], colors=[TRUE], linewidths=0.7,
                   linestyles=[(0, (4, 2))], zorder=3)  # fmt: skip
    handcrafted = style.steady(cut.handcrafted)
    ax.contour(x, y, handcrafted.T, levels=[0], colors=[style.colour(_HANDCRAFTED)],
               linewidths=1.2, linestyles=[(0, (1.5, 1))], zorder=5)  # fmt: skip
    for variant in _drawn(cut):
        tint, runs = style.colour(variant), style.steady(np.stack(cut.learned[variant]))
        disputed = np.minimum(runs.max(0), -runs.min(0))  # > 0: unsafe by some, but not by all
        if disputed.max() > 0:
            ax.contourf(x, y, disputed.T, levels=[0, np.inf], colors=[tint], alpha=0.35, zorder=5)
        ax.contour(x, y, np.median(runs, axis=0).T, levels=[0], colors=[tint],
                   linewidths=1.2, linestyles=[_dash(variant, cut)], zorder=6)  # fmt: skip
    draw_aircraft(ax, 0.0, 0.0, 0.0, "#0072B2")
    ax.set(aspect="equal", xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    ax.xaxis.set_major_locator(MultipleLocator(5))
    ax.yaxis.set_major_locator(MultipleLocator(5))
    ax.grid(False)
    return ax


def _drawn(cut: Slice) -> list[str]:
    """The learners, the method first: the solid line lies below what has gaps."""
    return sorted(style.ordered(cut.learned), key=lambda variant: variant != cut.method)


def _dash(variant: str, cut: Slice) -> object:
    """Boundaries often coincide: all dashes begin together, and each ends before that below it."""
    drawn = _drawn(cut)
    off = _PERIOD * drawn.index(variant) / len(drawn)
    return (0, (_PERIOD - off, off)) if off else "-"


def _handles(cut: Slice) -> list[Line2D | Patch]:
    handles: list[Line2D | Patch] = [
        Patch(fc=(*_rgb(TRUE), 0.13), ec=TRUE, lw=2.0, label="true unsafe set"),
        *(
            Line2D([], [], color=style.colour(v), ls=_dash(v, cut), lw=1.2,
                   label=style.label(v) + ", median" * (len(cut.learned[v]) > 1))
            for v in _drawn(cut)
        ),
        Line2D([], [], color=style.colour(_HANDCRAFTED), ls=(0, (1.5, 1)), lw=1.2,
               label=_HANDCRAFTED_LABEL),
        Patch(fc="0.8", ec="0.35", lw=0.8, label=r"collision, $d<d_{\min}$"),
    ]  # fmt: skip
    if any(len(runs) > 1 for runs in cut.learned.values()):
        handles.append(Patch(fc="0.5", alpha=0.35, label="shade: unsafe by some seeds only"))
    if cut.adversarial is not None:
        handles.append(Line2D([], [], color=TRUE, ls=(0, (4, 2)), lw=0.7,
                              label="true, adversarial traffic"))  # fmt: skip
    return handles


def _rgb(colour: str) -> tuple[float, ...]:
    return tuple(int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))


@style.styled
def slices(x: Array, y: Array, cuts: Sequence[Slice], d_min: float) -> Figure:
    """One panel a heading difference; the traffic's heading is shown in the corner."""
    columns = min(3, len(cuts))
    rows = -(-len(cuts) // columns)
    figure = style.new_figure(style.TEXT_WIDTH, 1.95 * rows + 0.5)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for ax, cut in zip(axes.flat, cuts, strict=False):
        draw_slice(ax, x, y, cut, d_min)
        draw_aircraft(ax, x[-1] - 2.4, y[-1] - 2.4, cut.psi, "0.35")
        ax.set_title(rf"$\psi={np.degrees(cut.psi):.0f}\degree$")
    for ax in axes.flat[len(cuts) :]:
        ax.remove()
    for ax in axes[-1]:
        ax.set_xlabel("$x$ ahead (m)")
    for ax in axes[:, 0]:
        ax.set_ylabel("$y$ left (m)")
    style.legend_below(figure, _handles(cuts[0]), 4)
    return figure


def draw_frontier(
    ax: Axes,
    frontier: pd.DataFrame,
    comparison: pd.DataFrame,
    covers: float,
    handcrafted: Collection[str] = (),
) -> Axes:
    """Volume ratio against missed share [%], of the best members of the family and of the runs.

    Of ``handcrafted`` variants the certificate is the fixed one, which is drawn once. Where the
    runs lie close together they are shown once more, larger.
    """
    ax.axvspan(0, 100 * covers, color="#009E73", alpha=0.4, lw=0)
    ax.axhline(1, color=TRUE, lw=1.0, ls=(0, (4, 2)))
    ax.fill_between(100 * frontier["missed_share"], 0, frontier["volume_ratio"], fc="none",
                    ec="0.82", hatch="////", lw=0)  # fmt: skip
    ax.plot(100 * frontier["missed_share"], frontier["volume_ratio"], color="k", lw=1.4)
    ax.text(6.0, 0.62, r"below the least found of all $[\sigma,k,n]$",
            bbox={"fc": "white", "ec": "none", "pad": 1.0})  # fmt: skip
    looks = {"phi_h": (style.colour("FAC-phih"), "X"), "phi_0": (style.colour("FAC-phi0"), "P"),
             "code init": ("k", "1")}  # fmt: skip
    fixed = comparison[comparison["variant"].isin(list(looks))]
    for _, row in fixed.iterrows():
        tint, marker = looks[str(row["variant"])]
        ax.plot(100 * row["missed_share"], row["volume_ratio"], marker=marker, color=tint, ms=6,
                mec="k" if marker == "1" else "white", mew=1.2 if marker == "1" else 0.5,
                ls="none", clip_on=False, zorder=4)  # fmt: skip
    runs = comparison[comparison["variant"].isin(_moving(comparison, handcrafted))]
    _draw_runs(ax, runs)
    ax.set_xlim(-2, 103)
    ax.xaxis.set_major_locator(MultipleLocator(20))
    highest = float(pd.concat([comparison["volume_ratio"], frontier["volume_ratio"]]).max())
    ax.set_ylim(0.5, max(2.0, 1.08 * highest))
    ax.set(xlabel="share of the true set's shell that is missed (%)", ylabel="volume / true volume")
    ends = runs[["missed_share", "volume_ratio"]].agg(["min", "max"]) * [100, 1]
    if len(runs) > 1 and (ends.loc["max"] - ends.loc["min"] < [30, 0.5]).all():
        near = ax.inset_axes((0.47, 0.54, 0.5, 0.44))
        near.plot(100 * frontier["missed_share"], frontier["volume_ratio"], color="k", lw=1.4)
        _draw_runs(near, runs)
        margin = 0.12 * (ends.loc["max"] - ends.loc["min"]) + [0.5, 0.01]
        low, high = ends.loc["min"] - margin, ends.loc["max"] + margin
        near.set(xlim=(low.iloc[0], high.iloc[0]), ylim=(low.iloc[1], high.iloc[1]))
        style.mark_zoom(ax, near)
    return ax


def _draw_runs(ax: Axes, runs: pd.DataFrame) -> None:
    for variant in style.ordered(runs["variant"].unique())[::-1]:
        run, tint = runs[runs["variant"] == variant], style.colour(variant)
        ax.plot(100 * run["missed_share"], run["volume_ratio"], marker=style.marker(variant),
                ms=5, mfc=(*_rgb(tint), 0.35), mec=tint, mew=1.0, ls="none", zorder=5)  # fmt: skip


def _moving(comparison: pd.DataFrame, handcrafted: Collection[str] = ()) -> list[str]:
    """Learners whose certificate is learned."""
    learners = comparison[comparison["kind"] == "learner"]
    return [name for name in learners["variant"].unique() if name not in handcrafted]


@style.styled
def frontier(
    best: pd.DataFrame,
    comparison: pd.DataFrame,
    covers: float,
    handcrafted: Collection[str] = (),
) -> Figure:
    """Where each run lies on the trade-off that the energy family allows."""
    figure = style.new_figure(style.COLUMN_WIDTH, 3.3)
    draw_frontier(figure.subplots(), best, comparison, covers, handcrafted)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color="k", lw=1.4, label=r"frontier over $[\sigma,k,n]$"),
        Line2D([], [], color=TRUE, lw=1.0, ls=(0, (4, 2)), label="true volume"),
        *(
            Line2D([], [], marker=style.marker(v), ls="none", ms=5, mew=1.0, mec=style.colour(v),
                   mfc=(*_rgb(style.colour(v)), 0.35), label=f"{style.label(v)}, one run")
            for v in style.ordered(_moving(comparison, handcrafted))
        ),
        Line2D([], [], color=style.colour("FAC-phih"), marker="X", ls="none", ms=6, mec="white",
               mew=0.5, label=_HANDCRAFTED_LABEL),
        Line2D([], [], color=style.colour("FAC-phi0"), marker="P", ls="none", ms=6, mec="white",
               mew=0.5, label=r"distance $\phi_0$"),
        Line2D([], [], color="k", marker="1", ls="none", ms=6, mew=1.2, label="learners' start"),
        Patch(fc="#009E73", alpha=0.4, label=f"covers ({100 * covers:g}% missed or less)"),
    ]  # fmt: skip
    style.legend_below(figure, handles, 2)
    return figure


@style.styled
def neural(
    x: Array,
    y: Array,
    cut: Slice,
    d_min: float,
    best: pd.DataFrame,
    comparison: pd.DataFrame,
    covers: float,
) -> Figure:
    """Neural energies: (a) on the trade-off between volume and coverage, (b) one slice of them.

    ``comparison`` holds rows of kind "learner" and, of kind "control", the curve of the same
    function fitted to the truth.
    """
    figure = style.new_figure(style.TEXT_WIDTH, 3.5)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    draw_frontier(left, best, comparison, covers)
    control = comparison[comparison["kind"] == "control"].sort_values("missed_share")
    left.plot(100 * control["missed_share"], control["volume_ratio"], color="k", lw=1.2, ls="--")
    draw_slice(right, x, y, cut, d_min)
    draw_aircraft(right, x[-1] - 2.4, y[-1] - 2.4, cut.psi, "0.35")
    right.set(xlabel="$x$ ahead (m)", ylabel="$y$ left (m)")
    for ax, letter in ((left, "a"), (right, "b")):
        style.panel_letter(ax, letter)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color="k", lw=1.4, label=r"frontier over $[\sigma,k,n]$"),
        Line2D([], [], color="k", lw=1.2, ls="--", label="network fitted to the truth"),
        *(
            Line2D([], [], color=style.colour(v), marker=style.marker(v), ms=4.5, lw=1.0,
                   ls=_dash(v, cut) if v in cut.learned else "none", label=style.label(v))
            for v in style.ordered(_moving(comparison))
        ),
        *_handles(replace(cut, learned={})),
    ]  # fmt: skip
    style.legend_below(figure, handles, 4)
    return figure
