"""The aircraft experiment's comparisons as tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from safemr import paper
from safemr.aircraft.scoring import CONTROL, FLIGHTS, as_scores
from safemr.conventions import COVERS
from safemr.report import statistics
from safemr.report.absence import describe_missing
from safemr.report.tables import ABSENT, FEW, Table, plus_minus
from safemr.tasks import Task, name_of


def table_lines(comparison: pd.DataFrame) -> pd.DataFrame:
    """What a reader sees: learners (mean over seeds and half width of the 95% t interval), then
    the other rows as they are."""
    trained = comparison[comparison["kind"] == "learner"]
    groups = list(trained.groupby("variant", sort=False))
    groups += [
        (comparison["variant"][index], comparison.loc[[index]])
        for index in comparison.index[comparison["kind"] != "learner"]
    ]
    lines = []
    for name, group in groups:
        seeds = len(group) if (group["kind"] == "learner").any() else 0
        certified = group["volume_ratio"].notna().any()
        covering = int(group["covers"].sum())
        covers = f"{covering} of {seeds}" if seeds else ("no", "yes")[covering]
        lines.append(
            {
                "certificate": name,
                "seeds": str(seeds or ABSENT),
                "volume ratio": _cell(group["volume_ratio"], 1, 2),
                "missed %": _cell(group["missed_share"], 100, 1),
                "covers": covers if certified else ABSENT,
                "IoU": _cell(group["iou"], 1, 3),
                "least ratio": _cell(group["least_volume_ratio"], 1, 2),
                "infeasible %": _cell(group["infeasible_share"], 100, 1),
                "at own eta": _cell(group["infeasible_share_eta"], 100, 1),
                "leak %": _cell(group["leak_share"], 100, 1),
                "collisions %": _cell(group["collision_share"], 100, 2),
                "effort": _cell(group["effort"], 1, 2),
            }
        )
    return pd.DataFrame(lines)


def comparison_table(
    comparison: pd.DataFrame,
    missing: pd.DataFrame | None = None,
    task: Task = paper.AIRCRAFT_TASK,
    pair: Sequence[str] = (paper.METHOD, paper.ABLATION),
) -> Table:
    """Learners (mean over seeds and half width of the 95% t interval), then the references.

    pair: the method and its ablation, which a note compares.
    """
    caption = (
        f"{name_of(task)}. Unsafe sets against the true one (constant traffic): volume over that "
        "of the truth; share of the truth minus the collision disc that is missed (covers: at most "
        f"{100 * COVERS:g}%); least ratio: what the best [sigma, k, n] needs at the same "
        "share missed, by interpolation; states outside the disc where no turn keeps the "
        "constraint, with eta 0 and the learner's; states of the claimed safe set that every turn "
        f"leaves. Deterministic policies from {FLIGHTS:,} truly safe states: flights that collide, "
        "mean sum of a^2. The policy of a fixed certificate keeps its constraint with the least "
        "turn, or violates it least. Learners: mean over seeds ± half width of the 95% t interval, "
        f"or [its ends] where it is cut off at a bound of the quantity. {FEW}"
    )
    trained = (comparison["kind"] == "learner").any()
    notes = [_verdict(as_scores(comparison), *pair)] if trained and len(pair) == 2 else []
    if missing is not None and len(missing):
        notes.append(f"Runs missing: {describe_missing(missing)}.")
    lines = table_lines(comparison)
    return Table("aircraft", caption, comparison, lines, tuple(filter(None, notes)))


def _verdict(scores: pd.DataFrame, method: str, rival: str) -> str:
    """What magnitude regularization changed, with Welch's intervals; "" without both learners."""
    texts = []
    for metric, name, factor, unit in (
        ("volume_ratio", "volume ratio", 1.0, ""),
        ("missed_share", "missed share", 100.0, " points"),
        ("iou", "IoU", 1.0, ""),
    ):
        ours, theirs = (
            factor * statistics.scores_of(scores, paper.AIRCRAFT_TASK, variant, metric)
            for variant in (method, rival)
        )
        gap = statistics.difference_interval(ours, theirs)
        if np.isnan(gap.mean):
            return ""
        interval = "" if np.isnan(gap.low) else f" [{gap.low:+.3f}, {gap.high:+.3f}]"
        texts.append(f"{name} {gap.mean:+.3f}{interval}{unit}")
    return f"{method} minus {rival}, Welch's 95% interval: {'; '.join(texts)}."


def _cell(values: pd.Series, factor: float, digits: int) -> str:
    """Shares are multiplied by 100; nothing here is negative, and no share above its whole."""
    share = factor == 100 or values.name == "iou"
    estimate = statistics.mean_interval(
        factor * values.to_numpy(float), bounds=(0.0, factor if share else np.inf)
    )
    return ABSENT if np.isnan(estimate.mean) else plus_minus(*estimate[:3], digits)


def neural_table(comparison: pd.DataFrame, missing: pd.DataFrame) -> Table:
    """Learners (mean and 95% t interval over seeds), then the control."""
    shown = comparison[comparison["kind"] != "control"]
    caption = (
        "Aircraft, neural energy functions: columns as in the aircraft table; least ratio is what "
        "the best [sigma, k, n] needs at the same share missed; obeyed: collisions of the policy "
        "that keeps the constraint with the least turn, or violates it least. "
        f"{CONTROL.capitalize()}: the same function by supervised learning on the solved value, "
        f"as it is and shifted to miss {100 * COVERS:g}%."
    )
    lines = table_lines(shown).drop(columns="at own eta")
    obeyed = shown.assign(collision_share=shown["obeyed_collision_share"])
    lines["obeyed %"] = table_lines(obeyed)["collisions %"]
    notes = [f"Runs missing: {describe_missing(missing)}."] if len(missing) else []
    return Table("aircraft_neural", caption, comparison, lines, tuple(notes))
