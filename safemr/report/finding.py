"""What the picture of the finding shows: returns and violations of all on the same layouts."""

from __future__ import annotations

from collections.abc import Callable, Collection

import pandas as pd

from safemr import paper
from safemr.report import statistics
from safemr.report.tables import SafetyRule, entries


def points(flown: pd.DataFrame, rule: SafetyRule) -> pd.DataFrame:
    """A row a task and algorithm: whether it is safe, mean return and share of dirty episodes [%].

    flown: a score table. Intervals over seeds are the columns _low and _high.
    """
    rows = []
    for task, variant in entries(flown, None):
        gained = statistics.score_interval(flown, task, variant, "eval_return")
        dirty = rule.dirty(flown, task, variant)
        rows.append(
            {
                "task": task, "variant": variant, "seeds": gained.size,
                "safe": bool(rule.is_safe(flown, task, variant)),
                "label": rule.label(flown, task, variant),
                "return": gained.mean, "return_low": gained.low, "return_high": gained.high,
                "dirty": 100 * dirty.mean,
                "dirty_low": 100 * dirty.low, "dirty_high": 100 * dirty.high,
                "steps": statistics.score_interval(flown, task, variant, rule.cost).mean,
            }
        )  # fmt: skip
    columns = ["task", "variant", "seeds", "safe", "label"]
    columns += [f"{name}{end}" for name in ("return", "dirty") for end in ("", "_low", "_high")]
    return pd.DataFrame(rows, columns=[*columns, "steps"])


def ahead(
    flown: pd.DataFrame,
    found: pd.DataFrame,
    method: str = paper.METHOD,
    printed: Callable[[str], str] = str,
    baselines: Collection[str] | None = None,
) -> pd.DataFrame:
    """task, text: the method's return minus that of the best safe baseline, Welch's interval.

    found: `points`. printed: a variant's name as the text has it. baselines: those it is compared
    with, without all others; other forms of the method are none. Where the method is not safe, or
    no baseline is, the text says that.
    """
    rows = []
    for task, group in found.groupby("task", sort=False):
        ours = group[group["variant"] == method]
        if ours.empty:
            continue
        others = group[group["safe"] & (group["variant"] != method)]
        if baselines is not None:
            others = others[others["variant"].isin(list(baselines))]
        text = "no baseline is safe"
        if ours["label"].item() == "not decided":
            dirty = ours["dirty"].item()
            text = f"whether {method} is safe is not decided: {dirty:.1f}% of episodes"
        elif not ours["safe"].item():
            steps, dirty = ours["steps"].item(), ours["dirty"].item()
            text = f"{method} is not safe: {steps:.1f} violating steps an episode, "
            text += f"in {dirty:.1f}% of them"
        elif len(others):
            rival = str(others.loc[others["return"].idxmax(), "variant"])
            first, second = (
                statistics.scores_of(flown, str(task), name, "eval_return")
                for name in (method, rival)
            )
            gap = statistics.difference_interval(first, second)
            interval = "" if pd.isna(gap.low) else rf" $\pm$ {gap.half_width:.1f}"
            names = f"{printed(method)} $-$ {printed(rival)}"
            text = f"{names}, the best safe baseline: {gap.mean:+.1f}{interval}"
        rows.append((task, text))
    return pd.DataFrame(rows, columns=["task", "text"])
