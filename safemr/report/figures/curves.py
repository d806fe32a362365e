"""Quantities against environment steps: training curves, sensitivity, parameters of the energy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike, NDArray

from safemr import paper
from safemr.report.figures import style

# One hue for SafeMR everywhere; the [a, b] points differ in lightness and dash.
_POINT_LOOKS: tuple[style.Look, ...] = (
    ("#D55E00", "-", "o"), ("#7A2E00", (0, (4, 1.5)), "^"), ("#F2A36B", (0, (1, 1.2)), "D"),
)  # fmt: skip
_RIDGES = (1, 10, 100, 1000)  # guide lines of the costs


def draw_curves(
    curves: pd.DataFrame, ax: Axes, *, looks: Mapping[str, style.Look] | None = None
) -> Axes:
    """Mean lines with intervals as whiskers; curves: variant, step, mean, low, high (one task).

    The view holds every mean, and whiskers up to half the range of the means beyond it: two seeds
    have t intervals of many times that, which would flatten all curves.
    """
    variants = style.ordered(curves["variant"].unique())
    shown = []
    for place, variant in enumerate(variants):
        run = curves[curves["variant"] == variant].rename(columns={"step": "x"})
        look = (looks or {}).get(variant, style.look(variant))
        shown.append(style.interval_line(ax, run, look, place=place, of=len(variants)))
    if len(curves):
        bottom, top = curves["mean"].min(), curves["mean"].max()
        reach = 0.5 * max(top - bottom, 1e-3)
        ends = pd.concat(shown)[["low", "high"]].fillna({"low": bottom, "high": top})
        low = min(max(bottom - reach, ends["low"].min()), bottom)
        high = max(min(top + reach, ends["high"].max()), top)
        margin = 0.05 * max(high - low, 1e-3)  # all costs of a safe method are 0
        ax.set_ylim(low - margin, high + margin)
    ax.margins(x=0)
    ax.set_xlim(left=0)
    return ax


def cost_axis(ax: Axes, name: str) -> None:
    """Costs are linear up to 1 and logarithmic above, so that 0, 0.1 and 100 can all be read."""
    ax.set_yscale("symlog", linthresh=1.0, linscale=0.8)
    top = max(ax.get_ylim()[1], 1.0)
    ax.set_ylim(-0.08, top)
    ax.set_yticks([tick for tick in (0, 1, 10, 100, 1000) if tick <= top])
    ax.set_yticks([], minor=True)
    ax.yaxis.set_major_formatter("{x:g}")
    ax.axhline(1.0, color="0.6", lw=0.7, ls=(0, (1, 2)), zorder=1)
    ax.set_ylabel(f"{name},\nlinear to 1, then logarithmic")


def draw_ridges(
    costs: pd.DataFrame,
    variants: Sequence[str],
    ax: Axes,
    *,
    top: float,
    scale: bool = True,
    gap: float = 1.15,
) -> Axes:
    """Costs of one task, a row a variant: the mean filled, the interval's upper end a thin line.

    costs: variant, step, mean, high. All rows have one scale, linear to 1 and logarithmic above,
    of which ``top`` is the last value that fits in a row; above it curves are cut off. ``scale``
    writes it at the right side of the first row. A tick marks where a curve ends.
    """

    def height(values: ArrayLike) -> NDArray[np.float64]:
        cost = np.clip(np.asarray(values, float), 0.0, top)
        folded = np.where(cost > 1.0, 1.0 + np.log10(np.maximum(cost, 1.0)), cost)
        return style.steady(folded / (1.0 + np.log10(top)))

    for row, variant in enumerate(variants):
        run, base = costs[costs["variant"] == variant], -gap * row
        tint = style.colour(variant)
        for guide in (0, *_RIDGES):
            if guide <= top:
                ax.axhline(base + float(height(guide)), color="0.55" if guide == 0 else "0.9",
                           lw=0.5, zorder=1)  # fmt: skip
        mean = base + height(run["mean"])
        ax.fill_between(run["step"], base, mean, color=tint, alpha=0.55, lw=0, zorder=2)
        ax.plot(run["step"], mean, color=tint, lw=0.9, zorder=3)
        ax.plot(run["step"], base + height(run["high"]), color=tint, lw=0.6, ls=(0, (1, 1)),
                zorder=3)  # fmt: skip
        if len(run):  # where there are runs: the others' budgets may be longer
            ax.plot(run["step"].iloc[-1], base, marker="|", color="0.3", ms=4, zorder=4)
    ax.set_yticks([-gap * row for row in range(len(variants))], map(style.label, variants))
    for text in ax.get_yticklabels():
        text.set(va="bottom")
    ax.set_ylim(-gap * (len(variants) - 1) - 0.1, 1.1)
    ax.tick_params(axis="y", length=0)
    ax.grid(False, axis="y")
    ax.spines["left"].set_visible(False)
    if scale:
        right = ax.secondary_yaxis("right")
        ticks = [guide for guide in (0, *_RIDGES) if guide <= top]
        texts = [f"{tick:g}" if tick in (0, 1, ticks[-1]) else "" for tick in ticks]
        right.set_yticks([float(height(tick)) for tick in ticks], texts)
        right.spines["right"].set_bounds(0, 1)
    return ax


@style.styled
def training_curves(
    returns: pd.DataFrame, costs: pd.DataFrame, tasks: Sequence[str], *, cost_name: str = "cost"
) -> Figure:
    """Fig. "major": expected return above, expected cost below, one column a task, one legend.

    returns, costs: `statistics.learning_curves` of the same runs. A task without runs keeps its
    panels, which then say so. Costs have a row an algorithm, as most of them are 0 and the others
    peaks. Where budgets differ by more than a factor of two the steps of all panels are
    logarithmic, so that the shorter curves are not squeezed into a corner.
    """
    variants = style.ordered(returns["variant"].unique())
    height = max(0.32 * len(variants), 1.6)
    figure = style.new_figure(style.text_width(len(tasks)), 2.8 + height)
    axes = figure.subplots(2, len(tasks), sharex=True, squeeze=False, height_ratios=[1.9, height])
    ends = returns.groupby(["task", "variant"])["step"].agg(["min", "max"])
    wide = any(e["max"].max() > 2 * e["max"].min() for _, e in ends.groupby("task"))
    largest = max(float(costs["mean"].max()), 1.0) if len(costs) else 1.0
    top = float(np.clip(10.0 ** np.ceil(np.log10(largest)), 10.0, _RIDGES[-1]))
    for task, upper, lower in zip(tasks, *axes, strict=True):
        _task_panel(returns, task, upper)
        upper.set_title(task)
        chosen = costs[costs["task"] == task]
        draw_ridges(chosen, variants, lower, top=top, scale=task == tasks[-1])
        if chosen.empty:
            style.note(lower, "no record: all runs")
    if len(returns):
        axes[0, 0].set_xlim(ends["min"].min() if wide else 0, ends["max"].max())
    for ax in axes[1]:
        style.steps_axis(ax, logarithmic=wide)
    if len(tasks) > 2:  # one name for all, as several would run into each other
        name = axes[1, 0].get_xlabel()
        for ax in axes[1]:
            ax.set_xlabel("")
        middle, even = divmod(len(tasks), 2)
        axes[1, middle].set_xlabel(name, x=0.5 if even else -0.1)
    for ax in axes[1, 1:]:
        ax.tick_params(axis="y", labelleft=False)
    axes[0, 0].set_ylabel("expected return\n(per episode)")
    axes[1, 0].set_ylabel(f"expected {cost_name} (per episode;\nlinear to 1, then logarithmic)")
    _legend(figure, variants)
    return figure


@style.styled
def compute_curves(
    returns: pd.DataFrame, minutes: pd.DataFrame, tasks: Sequence[str], *, name: str = "return"
) -> Figure:
    """Expected return against processor minutes, evaluations included, one panel a task.

    More than eight variants of one task get one panel for each algorithm that they vary.
    returns: `statistics.learning_curves`; minutes: `statistics.core_minutes` of the same runs.
    """
    timed = returns.merge(minutes, on=["task", "variant", "step"])
    timed = timed.drop(columns="step").rename(columns={"minutes": "step"})
    variants = style.ordered(timed["variant"].unique())  # whose records say what they cost
    crowded = len(tasks) == 1 and len(variants) > 8
    figure = style.new_figure(style.text_width(len(tasks)), 2.9 if crowded else 2.1)
    if crowded:
        groups = _by_base(variants)
        axes = figure.subplots(1, len(groups), squeeze=False)[0]
        for ax, (base, members) in zip(axes, groups.items(), strict=True):
            looks = {name: style.member_look(index) for index, name in enumerate(members)}
            draw_curves(timed[timed["variant"].isin(members)], ax, looks=looks)
            ax.set_title(f"{tasks[0]}, {style.label(base)}")
            handles = [style.line_entry(looks[v], v) for v in members]
            ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    else:
        axes = figure.subplots(1, len(tasks), squeeze=False)[0]
        for ax, task in zip(axes, tasks, strict=True):
            _task_panel(timed, task, ax)
            ax.set_title(task)
        _legend(figure, variants)
    for ax in axes:
        ax.set_xlabel("core-minutes")
    axes[0].set_ylabel(f"expected {name} (per episode)")
    return figure


@style.styled
def sensitivity(
    returns: pd.DataFrame,
    costs: pd.DataFrame,
    points: Mapping[str, tuple[float, float]],
    *,
    method: str = paper.METHOD,
    baseline: str = paper.ABLATION,
    cost_name: str = "cost",
) -> Figure:
    """Fig. "sensitive": return and cost for each [a, b] and for the baseline without regularizer.

    returns, costs: learning curves of one task. points: variant -> (a, b).
    """
    looks = {
        variant: _POINT_LOOKS[index % len(_POINT_LOOKS)] for index, variant in enumerate(points)
    }
    names = {variant: f"{method}, $[a, b]=[{a:g}, {b:g}]$" for variant, (a, b) in points.items()}
    wanted = [*points, baseline]
    figure = style.new_figure(0.8 * style.TEXT_WIDTH, 2.4)
    axes = figure.subplots(1, 2)
    looks[baseline], names[baseline] = style.look(baseline), style.label(baseline)
    for ax, table in zip(axes, (returns, costs), strict=True):
        chosen = table[table["variant"].isin(wanted)]
        draw_curves(chosen, ax, looks=looks)
        style.steps_axis(ax)
    for task in returns["task"].unique():
        figure.suptitle(task)
    axes[0].set_ylabel("expected return (per episode)")
    cost_axis(axes[1], f"expected {cost_name} (per episode)")
    drawn = set(returns["variant"])
    handles = [
        style.line_entry(looks[v], names[v] + " (no record)" * (v not in drawn)) for v in wanted
    ]
    style.legend_below(figure, handles, 2)
    return figure


def _symbols(parameters: Sequence[str]) -> dict[str, str]:
    """How a parameter of an energy function is written; the paper's as in the paper."""
    papers = {"sigma": r"$\sigma$", "k": "$k$", "n": "$n$"}
    return {name: papers.get(name, name) for name in parameters}


@style.styled
def parameter_evolution(
    progress: pd.DataFrame,
    tasks: Sequence[str],
    *,
    variants: Sequence[str] = (paper.METHOD, paper.ABLATION),
    parameters: Sequence[str] = paper.Zeta._fields,
) -> Figure:
    """How far the energy's parameters are from their start; one row a task, a column each.

    progress: tidy table. One thin line a seed, the mean bold. All panels have one scale, linear up
    to about a hundredth of the largest change and logarithmic beyond, so that what moves little
    does not look still. At most two variants have their last values written at the ends.
    A variant has lines in the columns of its family's parameters.
    """
    names = _symbols(parameters)
    chosen = progress[progress["variant"].isin(list(variants)) & progress["task"].isin(list(tasks))]
    chosen = chosen[chosen["metric"].isin(list(names))].sort_values("step")
    first = chosen.groupby(["task", "variant", "seed", "metric"])["value"].transform("first")
    chosen = chosen.assign(change=style.steady(chosen["value"] - first), start=first)
    largest = float(chosen["change"].abs().max()) if len(chosen) else 0.0
    linear = 10.0 ** np.floor(np.log10(max(largest, 1e-6) / 30))
    figure = style.new_figure(style.TEXT_WIDTH, 0.8 + 1.25 * len(tasks))
    axes = figure.subplots(len(tasks), len(names), sharey=True, sharex=True, squeeze=False)
    for row, task in zip(axes, tasks, strict=True):
        for ax, metric in zip(row, names, strict=True):
            runs = chosen[(chosen["task"] == task) & (chosen["metric"] == metric)]
            for variant in variants:
                _seed_lines(runs[runs["variant"] == variant], ax, variant, len(variants) <= 2)
            if runs.empty:
                style.note(ax, "no record: all runs")
            style.steps_axis(ax)
            ax.label_outer()
        row[0].set_ylabel(f"{task}\nchange since start")
    for ax, (metric, symbol) in zip(axes[0], names.items(), strict=True):
        starts = chosen.loc[chosen["metric"] == metric, "start"].unique()
        ax.set_title(f"{symbol}, from {starts[0]:g}" if len(starts) == 1 else symbol)
    axes[0, 0].set_xlim(0, max(chosen["step"], default=1))
    axes[0, 0].set_yscale("symlog", linthresh=linear, linscale=0.5)
    if largest:
        ends = chosen["change"].agg(["min", "max"]).to_numpy()
        axes[0, 0].set_ylim(1.8 * ends[0] - 0.3 * linear, 1.8 * ends[1] + 0.3 * linear)
    decades = [linear * 10**power for power in range(4) if linear * 10**power <= 1.5 * largest]
    used = [-d for d in decades[::-1] if chosen["change"].min() < -0.3 * d]
    used += [0.0, *(d for d in decades if chosen["change"].max() > 0.3 * d)]
    axes[0, 0].set_yticks(used, [f"{tick:+g}".replace("-", "\N{MINUS SIGN}") if tick else "0"
                                 for tick in used])  # fmt: skip
    axes[0, 0].set_yticks([], minor=True)
    handles = [style.line_entry(style.look(v), style.label(v)) for v in variants]
    scale = f"scale: linear to $\\pm${linear:g}, then logarithmic"
    handles.append(Line2D([], [], ls="none", label=scale))
    columns = min(len(handles), 3)
    style.legend_below(figure, handles, columns)
    return figure


@style.styled
def certificate_paths(
    progress: pd.DataFrame,
    travelled: pd.DataFrame,
    *,
    groups: Mapping[str, Sequence[str]],
    parameters: Sequence[str] = paper.Zeta._fields,
) -> Figure:
    """zeta against the sum of its learning rates so far; one row a group of variants.

    progress: tidy table of one task; travelled: variant, step, travel. Where zeta only drifts the
    paths of different rates lie on each other; where it has settled they are level.
    """
    names = _symbols(parameters)
    figure = style.new_figure(style.TEXT_WIDTH, 0.3 + 1.55 * len(groups))
    axes = figure.subplots(len(groups), len(names), squeeze=False)
    for row, (group, variants) in zip(axes, groups.items(), strict=True):
        shades = matplotlib.colormaps["viridis"].resampled(len(variants) + 1)
        for index, variant in enumerate(variants):
            path = travelled[travelled["variant"] == variant][["step", "travel"]]
            for ax, metric in zip(row, names, strict=True):
                chosen = progress[(progress["variant"] == variant) & (progress["metric"] == metric)]
                mean = chosen.groupby("step")["value"].mean().reset_index().merge(path, on="step")
                if mean.empty:  # of another family
                    continue
                line = ("-", (0, (4, 1.5)), (0, (1, 1.2)))[index % 3]
                label = variant.removeprefix(group).lstrip("-") or "default"
                ax.plot(mean["travel"], mean["value"], color=shades(index), ls=line, label=label)
                ax.plot(*mean[["travel", "value"]].iloc[-1], ".", color=shades(index), ms=4)
        for ax, symbol in zip(row, names.values(), strict=True):
            ax.set_xscale("symlog", linthresh=0.1)
            ax.set_xlim(left=0)
            ax.set_xticks([0, 0.1, 0.33, 1, 3.3], ["0", "0.1", "0.33", "1", "3.3"])
            ax.set_xticks([], minor=True)
            ax.set_ylabel(symbol, rotation=0, labelpad=6)
        row[0].set_title(group, loc="left")
        row[-1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    for ax in axes[-1]:
        ax.set_xlabel("sum of learning rates (linear to 0.1, then log)")
    return figure


def _by_base(variants: Sequence[str]) -> dict[str, list[str]]:
    """Variants by the one whose name theirs extends; what extends none is alone."""
    groups: dict[str, list[str]] = {}
    for name in sorted(variants, key=len):
        base = next((base for base in groups if name.startswith(f"{base}-")), name)
        groups.setdefault(base, []).append(name)
    return {base: style.ordered(groups[base]) for base in style.ordered(groups)}


def _task_panel(table: pd.DataFrame, task: str, ax: Axes) -> None:
    chosen = table[table["task"] == task]
    if chosen.empty:
        style.note(ax, "no record: all runs")
    draw_curves(chosen, ax)


def _seed_lines(runs: pd.DataFrame, ax: Axes, variant: str, written: bool) -> None:
    tint, line, mark = style.look(variant)
    for _, run in runs.groupby("seed"):
        ax.plot(run["step"], run["change"], color=tint, lw=0.5, alpha=0.6)
    mean = runs.groupby("step")[["change", "value"]].agg(["mean", "count"])
    complete = mean[mean["change", "count"] == runs["seed"].nunique()]
    ax.plot(complete.index, complete["change", "mean"], color=tint, ls=line, lw=1.4)
    if len(complete):
        end, change = complete.index[-1], complete["change", "mean"].iloc[-1]
        ax.plot(end, change, marker=mark, color=tint, ms=3.8, mec="white", mew=0.4, clip_on=False)
        if written:
            ax.annotate(f"{complete['value', 'mean'].iloc[-1]:.3f}", (end, change), (4, 0),
                        textcoords="offset points", va="center", fontsize=style.SMALL,
                        annotation_clip=False)  # fmt: skip


def _legend(figure: Figure, variants: Sequence[str]) -> None:
    handles = [style.line_entry(style.look(v), style.label(v)) for v in variants]
    columns = style.legend_columns(variants)
    style.legend_below(figure, handles, columns)
