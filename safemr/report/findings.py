"""What the paper's claims are judged by: evidence, findings, and the kinds of verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import pandas as pd

from safemr import paper
from safemr.report import statistics
from safemr.report.absence import describe_missing
from safemr.report.statistics import Estimate
from safemr.report.tables import SafetyRule

Verdict = Literal["confirmed", "refuted", "inconclusive", "not testable", "not run"]

NO_INTERVAL = "too few seeds for an interval"
NOTHING = Estimate(np.nan, np.nan, np.nan, 0)


@dataclass(frozen=True)
class Evidence:
    """Everything a rule may look at.

    scores: score table of final evaluations (`statistics.final_scores`). progress: tidy table.
    expected: runs (task, variant, seed) that the configured grid asks for; without it, nothing
    counts as missing but what a rule needs and cannot find at all. points: variant -> (a, b).
    aircraft: the comparison of `scoring.compare`, of which variant (with phi_h for the
    handcrafted function), volume_ratio and missed_share are used. certificates: rows of
    `certify.certify`.
    """

    scores: pd.DataFrame
    progress: pd.DataFrame
    expected: pd.DataFrame | None = None
    points: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    aircraft: pd.DataFrame | None = None
    certificates: pd.DataFrame | None = None
    rule: SafetyRule = field(default_factory=SafetyRule)
    tasks: Sequence[str] = paper.TASKS

    def missing(self, pairs: Iterable[tuple[str, str]]) -> str:
        """What is missing of these (task, variant) pairs, in words; "" if nothing."""
        runs = self.scores[["task", "variant", "seed"]].drop_duplicates()
        present = set(zip(runs["task"], runs["variant"], strict=True))
        texts = []
        for task, variant in pairs:
            if self.expected is not None:
                wanted = self.expected
                wanted = wanted[(wanted["task"] == task) & (wanted["variant"] == variant)]
                absent = statistics.missing_runs(wanted, runs)
                if len(absent):
                    texts.append(describe_missing(absent))
                    continue
            if (task, variant) not in present:
                texts.append(f"{variant} on {task} (all)")
        return "; ".join(texts)

    def missing_flights(self, variants: Iterable[str]) -> str:
        """What the aircraft comparison lacks of these learners, in words; "" if nothing."""
        texts = []
        for variant in variants:
            found = set() if self.aircraft is None else set(
                self.aircraft.loc[self.aircraft["variant"] == variant, "seed"].dropna().astype(int)
            )  # fmt: skip
            wanted = pd.DataFrame(columns=["task", "variant", "seed"])
            if self.expected is not None:
                wanted = self.expected[
                    (self.expected["variant"] == variant)
                    & (self.expected["task"] == paper.AIRCRAFT_TASK)
                ]
            absent = wanted[~wanted["seed"].isin(found)]
            if not found:
                texts.append(f"{variant} on {paper.AIRCRAFT_TASK} (all)")
            elif len(absent):
                texts.append(describe_missing(absent))
        return "; ".join(texts)

    def asks_for(self, pairs: Iterable[tuple[str, str]]) -> bool:
        """Whether the configured grid has any of these (task, variant) pairs."""
        if self.expected is None:
            return True
        asked = set(zip(self.expected["task"], self.expected["variant"], strict=True))
        return any(pair in asked for pair in pairs)

    def lacking(self, task: str, variants: Sequence[str]) -> Finding | None:
        """The finding where runs on a task are missing, or are none of the grid's."""
        pairs = [(task, variant) for variant in variants]
        if not self.asks_for(pairs):
            return not_run(f"{', '.join(variants)} on {task}")
        absent = self.missing(pairs)
        return unavailable(absent) if absent else None

    def lacking_flights(self, variants: Sequence[str]) -> Finding | None:
        """The finding where the aircraft comparison lacks runs of these learners."""
        pairs = [(paper.AIRCRAFT_TASK, variant) for variant in variants]
        if not self.asks_for(pairs):
            return not_run(f"{', '.join(variants)} on {paper.AIRCRAFT_TASK}")
        absent = self.missing_flights(variants)
        return unavailable(absent) if absent else None

    def interval(self, task: str, variant: str, metric: str) -> Estimate:
        """Mean of final scores with its t interval, within the metric's bounds."""
        return statistics.score_interval(self.scores, task, variant, metric)

    def of(self, task: str, variant: str, metric: str) -> np.ndarray:
        """[seeds] final scores."""
        return statistics.scores_of(self.scores, task, variant, metric)

    def measured(self, variant: str, metric: str) -> np.ndarray:
        """[seeds] values of a column of the aircraft comparison."""
        if self.aircraft is None:
            return np.empty(0)
        rows = self.aircraft[self.aircraft["variant"] == variant]
        return rows[metric].dropna().to_numpy(float)


@dataclass(frozen=True)
class Finding:
    """One judged statement: our number, its interval, what follows and why."""

    estimate: Estimate
    verdict: Verdict
    reason: str


def by_interval(estimate: Estimate, threshold: float, what: str) -> Finding:
    """Confirmed where the interval is above the threshold, refuted where below, else open."""
    shown = f"{what} {describe(estimate)}"
    if not has_interval(estimate):
        return Finding(estimate, "inconclusive", f"{shown}: {NO_INTERVAL}")
    if estimate.low > threshold:
        return Finding(estimate, "confirmed", shown)
    if estimate.high < threshold:
        return Finding(estimate, "refuted", shown)
    return Finding(estimate, "inconclusive", f"{shown}: the interval contains {threshold:g}")


def overall(parts: Mapping[str, Finding]) -> Finding:
    """All parts must hold: one refuted part refutes, one open part leaves it open.

    The estimate is that of the part that decides; the reason names every part.
    """
    rank: dict[Verdict, int] = {"refuted": 0, "confirmed": 2}  # 1: whatever leaves it open
    deciding = min(parts.values(), key=lambda part: rank.get(part.verdict, 1))
    reason = "; ".join(f"{name}: {part.verdict}, {part.reason}" for name, part in parts.items())
    return Finding(deciding.estimate, deciding.verdict, reason)


def at_most(estimate: Estimate, bound: float, what: str) -> Finding:
    """Confirmed where the whole interval is at or below the bound, refuted where it is above."""
    shown = f"{what} {describe(estimate)}"
    if not has_interval(estimate):
        return Finding(estimate, "inconclusive", f"{shown}: {NO_INTERVAL}")
    if estimate.high <= bound:
        return Finding(estimate, "confirmed", shown)
    if estimate.low > bound:
        return Finding(estimate, "refuted", shown)
    return Finding(estimate, "inconclusive", f"{shown}: the interval contains {bound:g}")


def has_interval(estimate: Estimate) -> bool:
    """Whether there is one: few seeds have none, and seeds that are all equal are none.

    Shares of a few episodes are coarse, so that equal values in every seed say little, but for 0.
    """
    return bool(estimate.low < estimate.high or estimate.low == estimate.high == 0)


def surely_below(estimate: Estimate, bound: float) -> bool:
    """Whether there is an interval and it ends below the bound."""
    return has_interval(estimate) and estimate.high < bound


def unavailable(what: str) -> Finding:
    """The finding of a claim whose runs are missing."""
    return Finding(NOTHING, "inconclusive", f"runs missing: {what}")


def not_run(what: str) -> Finding:
    """The finding of a claim about nothing that is in the configured grid."""
    return Finding(NOTHING, "not run", f"not in this configuration: {what}")


def on_every_task(
    evidence: Evidence,
    variants: Sequence[str],
    judge: Callable[[str], Finding | None],
    otherwise: str = "",
) -> Finding:
    """`overall` of the tasks; one on which runs of these variants are missing is open.

    So what has been run cannot confirm what the paper says of every task, but can refute it. A task
    that ``judge`` leaves out (None) has no part; ``otherwise`` refutes where all are left out.
    """
    pairs = [(task, variant) for task in evidence.tasks for variant in variants]
    if not evidence.asks_for(pairs):
        return not_run(f"{', '.join(variants)} on any of the paper's tasks")
    absent = {task: evidence.missing([(task, v) for v in variants]) for task in evidence.tasks}
    if all(absent.values()):
        return unavailable("; ".join(absent.values()))
    found = {task: unavailable(what) if what else judge(task) for task, what in absent.items()}
    parts = {task: finding for task, finding in found.items() if finding is not None}
    return overall(parts) if parts else Finding(NOTHING, "refuted", otherwise)


def missing_points(evidence: Evidence, variants: Sequence[str]) -> Finding | None:
    """The finding where runs of the points are missing, or none is of the paper's task."""
    task = paper.SENSITIVITY_TASK
    if evidence.expected is not None and not (
        evidence.points and evidence.asks_for((task, v) for v in evidence.points)
    ):
        return not_run(f"the points [a, b] on {task}")
    unknown = [p for p in paper.TABLE_II if p not in evidence.points.values()]
    texts = [f"SafeMR with [a, b] = [{a:g}, {b:g}]" for a, b in unknown]
    texts.append(evidence.missing((paper.SENSITIVITY_TASK, v) for v in variants))
    missing = "; ".join(text for text in texts if text)
    return unavailable(missing) if missing else None


def smooth_curves(
    progress: pd.DataFrame, task: str, metrics: Sequence[str]
) -> list[dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Of each SafeMR run on a task: metric -> steps, values averaged over a tenth of the log."""
    chosen = progress[
        (progress["variant"] == paper.METHOD)
        & progress["metric"].isin(list(metrics))
        & (progress["task"] == task)
    ].dropna(subset=["value"])
    runs = []
    for _, run in chosen.groupby("seed"):
        curves = {}
        for metric, curve in run.sort_values("step").groupby("metric"):
            window = max(1, len(curve) // 10)
            smooth = curve["value"].rolling(window, min_periods=1).mean().to_numpy(float)
            curves[str(metric)] = (curve["step"].to_numpy(float), smooth)
        runs.append(curves)
    return runs


def describe(estimate: Estimate) -> str:
    """ "mean [low, high]", or a dash for no number."""
    if np.isnan(estimate.mean):
        return "–"
    if np.isnan(estimate.low) or estimate.low == estimate.high:
        equal = estimate.low == estimate.high and estimate.size > 1
        return f"{estimate.mean:.3g}{' in every seed' if equal else ''}"
    return f"{estimate.mean:.3g} [{estimate.low:.3g}, {estimate.high:.3g}]"
