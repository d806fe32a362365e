"""Final scores: return against cost, performance profiles, probability of improvement."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from safemr import paper
from safemr.report.figures import style
from safemr.report.statistics import FEWEST_RUNS, Aggregates, Estimate


def draw_return_against_cost(
    points: pd.DataFrame,
    ax: Axes,
    *,
    tolerance: float | None = None,
    unsafe: Collection[str] = (),
) -> Axes:
    """One small marker a seed, the mean over seeds large, and hollow if `unsafe`.

    points: variant, seed, cost, return. Costs of 0 are spread left of 0, the variants that have
    any side by side, or most would lie upon each other.
    """
    if tolerance is not None:
        ax.axvspan(-1, tolerance, color="#009E73", alpha=0.08, lw=0, zorder=0)
    variants = style.ordered(points["variant"].unique())
    clean = style.ordered(points.loc[points["cost"] == 0, "variant"].unique())
    sides = {variant: 0.5 * ((i + 0.5) / len(clean) - 1) for i, variant in enumerate(clean)}
    for order, variant in enumerate(reversed(variants)):  # the first of the legend on top
        run = points[points["variant"] == variant]
        tint = style.colour(variant)
        look: dict[str, Any] = {"color": tint, "marker": style.marker(variant), "ls": "none"}
        side = sides.get(variant, 0.0)
        middle = run["cost"].mean()
        fill = {"mfc": "none", "mec": tint, "mew": 1.1} if variant in unsafe else {"mec": "white"}
        ax.plot(middle + side * (middle == 0), run["return"].mean(), ms=6, zorder=2 + order / 100,
                **{"mew": 0.6, **look, **fill})  # fmt: skip
        shifted = run["cost"] + side * (run["cost"] == 0)
        ax.plot(shifted, run["return"], ms=2.6, alpha=0.75, zorder=3 + order / 100,
                **{"mec": "white", "mew": 0.25, **look})  # fmt: skip
    ax.set_xscale("symlog", linthresh=1.0, linscale=0.8)
    right = max(1.6 * points["cost"].max(), 10.0) if len(points) else 10.0
    ax.set_xlim(-0.55, right)
    ax.set_xticks([tick for tick in (0, 1, 10, 100, 1000) if tick <= right])
    ax.set_xticks([], minor=True)
    ax.xaxis.set_major_formatter("{x:g}")
    return ax


@style.styled
def return_against_cost(
    scores: pd.DataFrame,
    tasks: Sequence[str],
    *,
    cost: str = "eval_cost_indicator",
    cost_name: str = "violating steps an episode",
    tolerance: float | None = None,
    unsafe: Collection[tuple[str, str]] = (),
) -> Figure:
    """Return against cost of the final policies, one panel a task.

    Costs up to `tolerance` are shaded; `unsafe` (task, variant) have hollow means.
    """
    wide = scores[scores["metric"].isin(["eval_return", cost])].pivot_table(
        index=["task", "variant", "seed"], columns="metric", values="value"
    )
    wide = wide.rename(columns={"eval_return": "return", cost: "cost"}).reset_index()
    figure = style.new_figure(style.text_width(len(tasks)), 2.1)
    axes = figure.subplots(1, len(tasks), squeeze=False)[0]
    for ax, task in zip(axes, tasks, strict=True):
        hollow = [variant for where, variant in unsafe if where == task]
        chosen = wide[wide["task"] == task]
        draw_return_against_cost(chosen, ax, tolerance=tolerance, unsafe=hollow)
        if not (wide["task"] == task).any():
            _say(ax, "no record")
        ax.set_title(task)
        ax.set_xlabel(cost_name)
    axes[0].set_ylabel("final return")
    variants = style.ordered(wide["variant"].unique())
    handles = style.marks(variants)
    columns = style.legend_columns(variants)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    return figure


def draw_profiles(profiles: Mapping[str, pd.DataFrame], ax: Axes) -> Axes:
    """Share of runs above a normalised score; profiles: variant -> threshold, mean, low, high."""
    for variant in style.ordered(profiles):
        profile, tint = profiles[variant], style.colour(variant)
        ax.plot(profile["threshold"], profile["mean"], color=tint, ls=style.line_style(variant))
        ax.fill_between(profile["threshold"], profile["low"], profile["high"],
                        color=tint, alpha=0.12, lw=0)  # fmt: skip
    ax.set_ylim(-0.02, 1.02)
    ax.margins(x=0)
    ax.set_ylabel(r"share of runs with score $> \tau$")
    return ax


def draw_intervals(estimates: Mapping[str, Estimate], ax: Axes, *, neutral: float) -> Axes:
    """Horizontal point-and-interval plot, one row a variant, with a line at the neutral value."""
    variants = style.ordered(estimates)[::-1]
    ax.axvline(neutral, color=style.INK, lw=0.7, ls=(0, (3, 2)))
    for row, variant in enumerate(variants):
        mean, low, high, _ = estimates[variant]
        tint = style.colour(variant)
        ax.plot([low, high], [row, row], color=tint, lw=3.2, alpha=0.35, solid_capstyle="butt")
        ax.plot(mean, row, marker=style.marker(variant), color=tint, ms=5, mec="white", mew=0.5)
    ax.set_yticks(range(len(variants)), [style.label(variant) for variant in variants])
    ax.set_ylim(-0.6, len(variants) - 0.4)
    ax.grid(axis="y", visible=False)
    ax.tick_params(axis="y", length=0)
    return ax


@style.styled
def aggregate_scores(
    aggregates: Aggregates,
    *,
    method: str = paper.METHOD,
    name: str = "return",
    absent: Sequence[str] = (),
    tasks: Sequence[str] = (),
) -> Figure:
    """Performance profiles over tasks, IQM of the normalised score, probability of improvement.

    aggregates: `statistics.aggregate`; a variant that lacks a task is not in it and not drawn, but
    named if it is among `absent`. `tasks` are named where they are not all of the grid's. Where a
    task has too few runs for intervals, the figure says so.
    """
    figure = style.new_figure(style.TEXT_WIDTH, 2.3)
    if tasks:
        figure.suptitle(f"on {', '.join(tasks)} alone", fontsize="small", color="0.4")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1.5, 1, 1])
    draw_profiles(aggregates.profiles, left)
    if not aggregates.profiles:
        _say(left, "no algorithm has runs on every task")
    if absent:
        names = ", ".join(map(style.label, style.ordered(absent)))
        left.set_title(f"runs missing: {names}", fontsize="small", color="0.4", style="italic")
    left.set_xlabel(rf"normalised {name} $\tau$ (paper's SafeMR: 1)")
    draw_intervals(aggregates.iqm, middle, neutral=1.0)
    middle.set_xlabel(f"IQM of normalised {name}")
    runs = min((estimate.size for estimate in aggregates.iqm.values()), default=FEWEST_RUNS)
    if runs < FEWEST_RUNS:
        few = f"{runs} run{'s' * (runs > 1)} a task: no intervals"
        for ax in (middle, right):
            ax.set_title(few, fontsize="small", color="0.4", style="italic")
    draw_intervals(aggregates.improvement, right, neutral=0.5)
    right.set_xlim(-0.03, 1.03)
    right.set_xlabel(rf"$P$({style.label(method)} $>$ baseline)")
    for letter, ax in zip("abc", (left, middle, right), strict=True):
        style.panel_letter(ax, letter)
    handles = [
        Line2D([], [], color=style.colour(v), ls=style.line_style(v), label=style.label(v))
        for v in style.ordered(aggregates.profiles)
    ]
    if handles:
        columns = style.legend_columns(aggregates.profiles)
        figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    return figure


_MAPPED = {
    "return": ("final return", "{:.1f}"),
    "half_width": ("half width of its 95% interval", "{:.1f}"),
    "violating_steps": ("violating steps an episode", "{:.2f}"),
}
_PAPERS = {"sigma": r"$\sigma$", "k": "$k$", "n": "$n$"}


def draw_grid(data: pd.DataFrame, column: str, ax: Axes, *, number: str = "{:.2f}") -> Axes:
    """One value a point [a, b] as shade and number; data: `sensitivity.weight_map`'s."""
    missing = "–" if column == "half_width" and data["return"].notna().all() else "missing"
    table = data.pivot(index="b", columns="a", values=column)
    values = table.to_numpy(float)
    known = values[np.isfinite(values)]
    low, high = (known.min(), known.max()) if len(known) else (0.0, 1.0)
    if high - low < 1e-9:  # one shade, not noise
        low, high = low - 1.0, high + 1.0
    ax.imshow(values, origin="lower", cmap="viridis", vmin=low, vmax=high, aspect="auto")
    for (row, place), value in np.ndenumerate(values):
        text = number.format(value) if np.isfinite(value) else missing
        dark = not np.isfinite(value) or value > low + 0.6 * (high - low)
        ax.text(place, row, text, ha="center", va="center", fontsize="small",
                color="k" if dark else "w")  # fmt: skip
    ax.set_xticks(range(len(table.columns)), [f"{a:g}" for a in table.columns])
    ax.set_yticks(range(len(table.index)), [f"{b:g}" for b in table.index])
    ax.grid(False)
    ax.tick_params(length=0)
    return ax


@style.styled
def weight_map(data: pd.DataFrame, parameters: Sequence[str] = tuple(_PAPERS)) -> Figure:
    """Final performance and learned zeta over the weights [a, b]; data: `sensitivity.weight_map`'s.

    parameters: of the energy's family; the first three are shown.
    A frame marks the points whose return is told apart from the baseline's: white where it is
    higher, black where it is lower.
    """
    figure = style.new_figure(style.TEXT_WIDTH, 4.2)
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    learned = {
        name: (f"learned {_PAPERS.get(name, name)}", "{:.3f}") for name in list(parameters)[:3]
    }
    shown = {**_MAPPED, **learned}
    for ax, (column, (title, number)) in zip(axes.flat, shown.items(), strict=False):
        draw_grid(data, column, ax, number=number)
        ax.set_title(title)
    for ax in axes.flat[len(shown) :]:
        ax.set_visible(False)
    rank = {name: {v: i for i, v in enumerate(sorted(set(data[name])))} for name in "ab"}
    for _, row in data.iterrows():
        side = "w" if row["gain_low"] > 0 else "k" if row["gain_high"] < 0 else None
        if side:
            corner = (rank["a"][row["a"]] - 0.46, rank["b"][row["b"]] - 0.46)
            axes[0, 0].add_patch(Rectangle(corner, 0.92, 0.92, fill=False, ec=side, lw=1.2))
    papers = list(parameters) == list(_PAPERS)
    for ax in axes[-1]:
        ax.set_xlabel(r"$a$, weight of $(\sigma+d_{\min})^n$" if papers else "$a$")
    for ax in axes[:, 0]:
        ax.set_ylabel("$b$, weight of $k$" if papers else "$b$")
    return figure


def _say(ax: Axes, text: str) -> None:
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", color="0.5", style="italic")
