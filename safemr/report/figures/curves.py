"""Quantities against environment steps: training curves, sensitivity, parameters of the energy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from safemr import paper
from safemr.report.figures import style

# One hue for SafeMR everywhere; the [a, b] points differ in lightness and dash.
_POINT_SHADES = (("#D55E00", "-"), ("#7A2E00", (0, (4, 1.5))), ("#F2A36B", (0, (1, 1.2))))


def draw_curves(
    curves: pd.DataFrame,
    ax: Axes,
    *,
    looks: Mapping[str, tuple[str, object]] | None = None,
) -> Axes:
    """Mean lines with shaded intervals; curves: variant, step, mean, low, high (one task).

    The view holds every mean, and intervals up to half the range of the means beyond it: two seeds
    have t intervals of many times that, which would flatten all curves.
    """
    for variant in style.ordered(curves["variant"].unique()):
        run = curves[curves["variant"] == variant]
        default = (style.colour(variant), style.line_style(variant))
        tint, line = (looks or {}).get(variant, default)
        ax.plot(run["step"], run["mean"], color=tint, ls=line, zorder=3)
        ax.fill_between(run["step"], run["low"], run["high"], color=tint, alpha=0.15, lw=0)
    if len(curves):
        bottom, top = curves["mean"].min(), curves["mean"].max()
        reach = 0.5 * max(top - bottom, 1e-3)
        ends = curves[["low", "high"]].fillna({"low": bottom, "high": top})
        low, high = max(bottom - reach, ends["low"].min()), min(top + reach, ends["high"].max())
        margin = 0.05 * max(high - low, 1e-3)  # all costs of a safe method are 0
        ax.set_ylim(low - margin, high + margin)
    ax.margins(x=0)
    ax.set_xlim(left=0)
    return ax


def cost_axis(ax: Axes) -> None:
    """Costs are linear up to 1 and logarithmic above, so that 0, 0.1 and 100 can all be read."""
    ax.set_yscale("symlog", linthresh=1.0, linscale=0.8)
    top = max(ax.get_ylim()[1], 1.0)
    ax.set_ylim(-0.08, top)
    ax.set_yticks([tick for tick in (0, 1, 10, 100, 1000) if tick <= top])
    ax.set_yticks([], minor=True)
    ax.yaxis.set_major_formatter("{x:g}")


@style.styled
def training_curves(
    returns: pd.DataFrame, costs: pd.DataFrame, tasks: Sequence[str], *, cost_name: str = "cost"
) -> Figure:
    """Fig. "major": expected return above, expected cost below, one column a task, one legend.

    returns, costs: `statistics.learning_curves` of the same runs. A task without runs keeps its
    panels, which then say so. Where budgets differ by more than a factor of two the steps are
    logarithmic, so that the shorter curves are not squeezed into a corner.
    """
    figure = style.new_figure(style.text_width(len(tasks)), 3.3)
    axes = figure.subplots(2, len(tasks), sharex="col", squeeze=False)
    for column, task in enumerate(tasks):
        for ax, table in zip(axes[:, column], (returns, costs), strict=True):
            _task_panel(table, task, ax)
        ends = returns[returns["task"] == task].groupby("variant")["step"].agg(["min", "max"])
        if ends["max"].max() > 2 * ends["max"].min():
            axes[0, column].set_xscale("log")
            axes[0, column].set_xlim(ends["min"].min(), ends["max"].max())
        axes[0, column].set_title(task)
        cost_axis(axes[1, column])
        style.thousands(axes[1, column])
    axes[0, 0].set_ylabel("expected return")
    axes[1, 0].set_ylabel(f"expected {cost_name}")
    _legend(figure, style.ordered(returns["variant"].unique()))
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
            handles = [Line2D([], [], color=looks[v][0], ls=looks[v][1], label=v) for v in members]
            ax.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)
    else:
        axes = figure.subplots(1, len(tasks), squeeze=False)[0]
        for ax, task in zip(axes, tasks, strict=True):
            _task_panel(timed, task, ax)
            ax.set_title(task)
        _legend(figure, variants)
    for ax in axes:
        ax.set_xlabel("core-minutes")
    axes[0].set_ylabel(f"expected {name}")
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
        variant: _POINT_SHADES[index % len(_POINT_SHADES)] for index, variant in enumerate(points)
    }
    names = {variant: f"{method}, $[a, b]=[{a:g}, {b:g}]$" for variant, (a, b) in points.items()}
    wanted = [*points, baseline]
    figure = style.new_figure(0.8 * style.TEXT_WIDTH, 2.3)
    axes = figure.subplots(1, 2)
    for ax, table, name in zip(axes, (returns, costs), ("return", cost_name), strict=True):
        chosen = table[table["variant"].isin(wanted)]
        draw_curves(chosen, ax, looks=looks)
        _say_missing(ax, [v for v in wanted if v not in set(chosen["variant"])])
        ax.set_ylabel(f"expected {name}")
        style.thousands(ax)
    cost_axis(axes[1])
    looks[baseline] = (style.colour(baseline), style.line_style(baseline))
    names[baseline] = style.label(baseline)
    handles = [Line2D([], [], color=looks[v][0], ls=looks[v][1]) for v in wanted]
    figure.legend(handles, [names[v] for v in wanted], loc="outside lower center", ncols=2)
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
    fixed: Mapping[str, Mapping[str, float]] | None = None,
    parameters: Sequence[str] = paper.Zeta._fields,
) -> Figure:
    """The energy's parameters during training: one thin line a seed, the mean bold; one row a task.

    progress: tidy table. fixed: variant -> {"sigma": .., "k": .., "n": ..} drawn as level lines.
    parameters: a column each; a variant has lines in those of its family.
    """
    names = _symbols(parameters)
    figure = style.new_figure(style.TEXT_WIDTH, 0.7 + 1.25 * len(tasks))
    axes = figure.subplots(len(tasks), len(names), sharex="row", squeeze=False)
    for index, (row, task) in enumerate(zip(axes, tasks, strict=True)):
        for ax, (metric, symbol) in zip(row, names.items(), strict=True):
            chosen = progress[(progress["task"] == task) & (progress["metric"] == metric)]
            for variant in variants:
                _seed_lines(chosen[chosen["variant"] == variant], ax, style.colour(variant))
            if not chosen["variant"].isin(list(variants)).any():
                _say_missing(ax, ["all runs"])
            for variant, zeta in (fixed or {}).items():
                ax.axhline(zeta[metric], color=style.colour(variant), ls=style.line_style(variant))
            ax.set_ylabel(symbol, rotation=0, labelpad=6)
            ax.margins(x=0)
            ax.set_xlim(left=0)
            style.thousands(ax)
        row[0].set_title(task, loc="left")
        for ax in row[1:]:
            ax.set_title(" ", loc="left")
        for ax in row if index < len(tasks) - 1 else ():
            ax.set_xlabel("")
    _legend(figure, [*variants, *(fixed or {})])
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
        ax.set_xlabel("sum of learning rates")
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
        _say_missing(ax, ["all runs"])
    draw_curves(chosen, ax)


def _say_missing(ax: Axes, what: Sequence[str]) -> None:
    if what:
        text = "no record: " + ", ".join(what)
        ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", color="0.5", style="italic")


def _seed_lines(runs: pd.DataFrame, ax: Axes, tint: str) -> None:
    for _, run in runs.groupby("seed"):
        run = run.sort_values("step")
        ax.plot(run["step"], run["value"], color=tint, lw=0.5, alpha=0.6)
    mean = runs.groupby("step")["value"].agg(["mean", "count"])
    complete = mean[mean["count"] == runs["seed"].nunique()]
    ax.plot(complete.index, complete["mean"], color=tint, lw=1.4)


def _legend(figure: Figure, variants: Sequence[str]) -> None:
    handles = [
        Line2D([], [], color=style.colour(v), ls=style.line_style(v), label=style.label(v))
        for v in variants
    ]
    columns = style.legend_columns(variants)
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)
