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
from numpy.typing import ArrayLike, NDArray

from safemr import paper
from safemr.report.figures import style
from safemr.report.statistics import FEWEST_RUNS, Aggregates, Estimate

_NONE = 0.3  # width of the strip of runs without a violation, in widths of the axis beside it


def draw_return_against_cost(
    points: pd.DataFrame,
    ax: Axes,
    *,
    low: float,
    high: float,
    tolerance: float | None = None,
    unsafe: Collection[str] = (),
    logarithmic: bool = True,
) -> Axes:
    """One small marker a seed, the mean over seeds large, and hollow if `unsafe`.

    points: variant, seed, cost, return. The axis of costs begins at ``low`` > 0 and ends at
    ``high``; runs without any cost stand in a strip of their own beside it, the variants side by
    side, as most would lie upon each other. Costs up to ``tolerance`` are shaded.
    """

    def along(cost: ArrayLike) -> NDArray[np.float64]:
        value = np.asarray(cost, float)
        if logarithmic:
            return style.steady(np.log(np.maximum(value, low) / low) / np.log(high / low))
        return value / high

    variants = style.ordered(points["variant"].unique())
    clean = style.ordered(points.loc[points["cost"] == 0, "variant"].unique())
    sides = {name: _NONE * ((i + 0.5) / len(clean) - 1) for i, name in enumerate(clean)}
    if tolerance is not None:
        end = float(along(tolerance)) if tolerance > 0 else 0.0
        ax.axvspan(-_NONE, end, color="#009E73", alpha=0.08, lw=0, zorder=0)
    ax.axvline(0, color="0.3", lw=0.8)
    for order, variant in enumerate(reversed(variants)):  # the first of the legend on top
        run = points[points["variant"] == variant]
        tint, side = style.colour(variant), sides.get(variant, 0.0)
        look: dict[str, Any] = {"color": tint, "marker": style.marker(variant), "ls": "none"}
        fill = {"mfc": "none", "mec": tint, "mew": 1.1} if variant in unsafe else {"mec": "white"}
        cost = np.array([run["cost"].mean(), *run["cost"]])
        place = np.where(cost > 0, along(cost), side)
        ax.plot(place[0], run["return"].mean(), ms=6, zorder=2 + order / 100,
                **{"mew": 0.6, **look, **fill})  # fmt: skip
        ax.plot(place[1:], run["return"], ms=2.6, alpha=0.75, zorder=3 + order / 100,
                **{"mec": "white", "mew": 0.25, **look})  # fmt: skip
    ticks = style.log_ticks(low, high) if logarithmic else _fifths(high)
    ax.set_xlim(-_NONE, 1.03)
    ax.set_xticks([-_NONE / 2, *along(ticks)], ["none", *(f"{tick:g}" for tick in ticks)])
    return ax


def _fifths(high: float) -> list[float]:
    """Three round numbers up to ``high``, from 0 on."""
    step = next((s for s in (1, 2, 5, 10, 20, 25, 50) if 2 * s <= high < 4 * s), high / 2)
    return [float(tick) for tick in np.arange(1, 4) * step if tick <= high]


_RULE = {  # of the safety rule: what a panel shows, and with a logarithmic scale or a linear one
    "eval_cost_indicator": ("violating steps an episode (log scale)", 1.0, True),
    "eval_zero_violation_share": ("episodes with a violation (%)", 100.0, False),
}


@style.styled
def return_against_cost(
    scores: pd.DataFrame,
    tasks: Sequence[str],
    *,
    tolerance: float | None = None,
    clean_share: float | None = None,
    unsafe: Collection[tuple[str, str]] = (),
    hollow_means: str = "not safe",
) -> Figure:
    """Return against both costs of the safety rule, one column a task.

    Above violating steps, up to ``tolerance`` shaded; below the share of episodes with a violation,
    shaded where at least ``clean_share`` have none. `unsafe` (task, variant) have hollow means, of
    which the legend says ``hollow_means``. Scores without that share have no such row.
    """
    metrics = [name for name in _RULE if (scores["metric"] == name).any()]
    wide = scores[scores["metric"].isin(["eval_return", *_RULE])].pivot_table(
        index=["task", "variant", "seed"], columns="metric", values="value"
    )
    wide = wide.rename(columns={"eval_return": "return"}).reset_index()
    rows = max(len(metrics), 1)
    figure = style.new_figure(style.text_width(len(tasks)), 0.4 + 1.75 * rows)
    axes = figure.subplots(rows, len(tasks), squeeze=False, sharey="col")
    for row, metric in zip(axes, metrics or list(_RULE)[:1], strict=True):
        name, unit, logarithmic = _RULE[metric]
        cost = wide[metric] if metric in wide else pd.Series(dtype=float)
        cost = unit * (1 - cost) if "share" in metric else cost
        cost = cost.round(9)
        limit = tolerance if logarithmic else clean_share and unit * (1 - clean_share)
        low = min([*cost[cost > 0], limit or 1.0]) / 1.5
        high = 1.2 * max([*cost, limit or 1.0, 2 * low])
        for ax, task in zip(row, tasks, strict=True):
            chosen = wide.assign(cost=cost)[wide["task"] == task]
            hollow = [variant for where, variant in unsafe if where == task]
            draw_return_against_cost(chosen, ax, low=low, high=high, tolerance=limit,
                                     unsafe=hollow, logarithmic=logarithmic)  # fmt: skip
            if chosen.empty:
                style.note(ax, "no record")
        row[len(tasks) // 2].set_xlabel(name)
        if len(tasks) % 2 == 0:
            row[len(tasks) // 2].xaxis.set_label_coords(-0.1, -0.16)
        row[0].set_ylabel(
            "final return (per episode)" if rows == 1 else "final return\n(per episode)"
        )
    for ax, task in zip(axes[0], tasks, strict=True):
        ax.set_title(task)
    handles = style.marks(style.ordered(wide["variant"].unique()))
    look: dict[str, Any] = {"color": "0.3", "marker": "o", "ls": "none", "ms": 6}
    handles.append(Line2D([], [], **look, label="mean, safe"))
    handles.append(Line2D([], [], **look, mfc="none", mew=1.1, label=f"mean, {hollow_means}"))
    handles.append(Line2D([], [], **{**look, "ms": 2.6}, label="one seed"))
    columns = style.legend_columns([str(handle.get_label()) for handle in handles])
    style.legend_below(figure, handles, columns)
    return figure


def draw_profiles(profiles: Mapping[str, pd.DataFrame], ax: Axes) -> Axes:
    """Share of runs above a normalised score; profiles: variant -> threshold, mean, low, high."""
    for place, variant in enumerate(style.ordered(profiles)):
        profile = profiles[variant].rename(columns={"threshold": "x"})
        # Whiskers every few thresholds, not at each.
        of = 3 * len(profiles)
        style.interval_line(ax, profile, style.look(variant), place=3 * place, of=of)
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
    meaning: str = "",
    absent: Sequence[str] = (),
    tasks: Sequence[str] = (),
) -> Figure:
    """Performance profiles over tasks, IQM of the normalised score, probability of improvement.

    aggregates: `statistics.aggregate`; a variant that lacks a task is not in it and not drawn, but
    named if it is among `absent`. ``meaning`` explains the ``name`` of the score. `tasks` are named
    where they are not all of the grid's. Where a task has too few runs for intervals, the figure
    says so.
    """
    figure = style.new_figure(style.TEXT_WIDTH, 2.4)
    said = [meaning] * bool(meaning) + [f"on {', '.join(tasks)} alone"] * bool(tasks)
    if said:
        figure.suptitle("\n".join(said), fontsize=style.SMALL, color="0.4")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1.5, 1, 1])
    draw_profiles(aggregates.profiles, left)
    if not aggregates.profiles:
        style.note(left, "no algorithm has runs on every task")
    if absent:
        names = ", ".join(map(style.label, style.ordered(absent)))
        left.set_title(f"runs missing: {names}", fontsize=style.SMALL, color="0.4", style="italic")
    left.set_xlabel(rf"score $\tau$: {name} / the paper's return of SafeMR")
    draw_intervals(aggregates.iqm, middle, neutral=1.0)
    middle.set_xlabel("interquartile mean of the score")
    runs = min((estimate.size for estimate in aggregates.iqm.values()), default=FEWEST_RUNS)
    if runs < FEWEST_RUNS:
        few = f"{runs} run{'s' * (runs > 1)} a task: no intervals"
        for ax in (middle, right):
            ax.set_title(few, fontsize=style.SMALL, color="0.4", style="italic")
    draw_intervals(aggregates.improvement, right, neutral=0.5)
    right.set_xlim(-0.03, 1.03)
    right.set_xlabel(rf"$P$({style.label(method)} $>$ other)")
    for letter, ax in zip("abc", (left, middle, right), strict=True):
        style.panel_letter(ax, letter)
    handles = [
        style.line_entry(style.look(v), style.label(v)) for v in style.ordered(aggregates.profiles)
    ]
    if handles:
        columns = style.legend_columns(aggregates.profiles)
        style.legend_below(figure, handles, columns)
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
        ax.text(place, row, text, ha="center", va="center", fontsize=style.SMALL,
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
