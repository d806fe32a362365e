"""The second protocol: final policies are flown, and "safe" is judged by an interval.

docs/claims.md has it in words and says why. What differs from the first: the final performance of a
run is that of its last policy on layouts of its own that nothing was tuned or evaluated on
(`judged_scores`); an algorithm is safe, not safe, or not decided by one interval of the rate of
episodes with a violation (`RateRule`); "highest return among safe algorithms" is the primary
claim, corrected for its four tasks, and compares with every baseline that may be safe, not with the
best one; and a claim that no run here could refute is called that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import betaincinv, stdtrit

from safemr import paper
from safemr.report import statistics
from safemr.report.findings import (
    NO_INTERVAL,
    NOTHING,
    Evidence,
    Finding,
    by_interval,
    describe,
    missing_points,
    on_every_task,
    overall,
)
from safemr.report.statistics import FEWEST_RUNS, LEVEL, Estimate
from safemr.report.tables import Label, SafetyRule

PRIMARY_LEVEL = 1 - (1 - LEVEL) / len(paper.TASKS)  # Bonferroni over the tasks of the primary claim
EPISODES = "eval_episodes"


def judged_scores(scores: pd.DataFrame, flown: pd.DataFrame) -> pd.DataFrame:
    """The score table that verdicts and tables read: deterministic metrics from the flights.

    scores: `statistics.final_scores` with what is known of training. flown: scores of the final
    policies on unseen layouts. Runs that were not flown have no `eval_` metric and count as
    missing.
    """
    exploring = scores[~scores["metric"].str.startswith("eval_")]
    keys = ["task", "variant", "seed"]
    known = pd.MultiIndex.from_frame(flown[keys])
    exploring = exploring[pd.MultiIndex.from_frame(exploring[keys]).isin(known)]
    return pd.concat([flown, exploring], ignore_index=True)


def rate_interval(rates: np.ndarray, episodes: np.ndarray, level: float = LEVEL) -> Estimate:
    """Rate of an event over the episodes of several runs, with an interval inside [0, 1].

    rates [n]: share of a run's episodes with the event; episodes [n]: how many it has. The
    interval is Clopper and Pearson's at an effective number of episodes (Korn and Graubard,
    "Confidence intervals for proportions with small expected number of positive counts estimated
    from survey data", 1998): the binomial variance over that of the mean of the runs, at most their
    number, times the square of the ratio of Student's quantiles, which charges for estimating a
    variance from few runs. So runs that disagree count as fewer episodes, and where all agree, at
    0 for one, the number of runs still decides how much that says. Fewer than `FEWEST_RUNS` have no
    interval.
    """
    runs, total = len(rates), float(np.sum(episodes))
    if not runs:
        return NOTHING
    rate = float(np.sum(rates * episodes) / total)
    if runs < FEWEST_RUNS:
        return Estimate(rate, np.nan, np.nan, runs)
    # Of the weighted mean, from the runs' deviations; equal weights give s^2 / n.
    deviations = episodes * (rates - rate) / total
    between = float(runs / (runs - 1) * np.sum(deviations**2))
    binomial = rate * (1 - rate)
    effective = min(total, binomial / between) if between > 0 else total
    tail = (1 + level) / 2
    effective *= float((stdtrit(total - 1, tail) / stdtrit(runs - 1, tail)) ** 2)
    seen, unseen = rate * effective, (1 - rate) * effective
    low = float(betaincinv(seen, unseen + 1, 1 - tail)) if rate > 0 else 0.0
    high = float(betaincinv(seen + 1, unseen, tail)) if rate < 1 else 1.0
    return Estimate(rate, low, high, runs)


@dataclass(frozen=True)
class RateRule(SafetyRule):
    """Safe by the rate of episodes with a violation, which may be at most 1 - `clean_share`.

    Violating steps are reported and decide nothing: one episode in a thousand may have 900, and
    which one changes with the last bit of a forward pass.
    """

    def rate(self, scores: pd.DataFrame, task: str, variant: str) -> Estimate:
        """Rate of episodes with a violation, over the seeds (`rate_interval`)."""
        clean = statistics.scores_of(scores, task, variant, self.clean)
        return rate_interval(1 - clean, statistics.scores_of(scores, task, variant, EPISODES))

    dirty = rate

    @property
    def marks(self) -> tuple[str, str]:
        """What a filled and a hollow mark say where the limit is drawn."""
        return "safe: the whole interval lies there", "not safe, or not decided"

    def label(self, scores: pd.DataFrame, task: str, variant: str) -> Label | None:
        """Safe where the interval is at or below the limit, not safe where above, else open."""
        rate = self.rate(scores, task, variant)
        return self.label_of(rate) if rate.size else None

    def label_of(self, rate: Estimate) -> Label:
        """The label of a rate with this interval."""
        limit = 1 - self.clean_share
        if rate.high <= limit:
            return "yes"
        return "no" if rate.low > limit else "not decided"

    def is_safe(self, scores: pd.DataFrame, task: str, variant: str) -> bool | None:
        """Whether the label is "yes", or None where there is no such run."""
        label = self.label(scores, task, variant)
        return None if label is None else label == "yes"

    def holds(self, cost: pd.Series, clean: pd.Series) -> pd.Series:
        """Whether single runs are safe by themselves: their share of clean episodes alone."""
        return super().holds(0 * cost, clean)

    def __str__(self) -> str:
        return (
            "safe, by the second protocol of docs/claims.md: the 95% interval of the rate of "
            f"unseen episodes with a violation ends at or below {100 * (1 - self.clean_share):g}%; "
            "not safe: it begins above; else not decided"
        )


def rule_of(protocol: int, tolerance: float, clean_share: float) -> SafetyRule:
    """The safety rule of the protocol 1 or 2, with the limits of the configuration."""
    return (RateRule if protocol == 2 else SafetyRule)(tolerance, clean_share)


class Judgement(NamedTuple):
    """What the second protocol measures of a claim, its rule, and the figure that shows it."""

    measure: str
    judge: Callable[[Evidence], Finding]
    figure: str | None = None  # where it is another than the first protocol's


def judgements(tasks: tuple[str, ...]) -> Mapping[str, Judgement]:
    """By a claim's name, what this protocol judges otherwise than the first."""
    rate = "rate of unseen episodes with a violation, the task that decides"
    gap = "difference of flown returns"
    return {
        **{
            f"highest_return[{task}]": Judgement(
                f"{gap} to the safe baseline that decides, {100 * PRIMARY_LEVEL:g}% interval",
                partial(highest_safe_return, task),
                "finding",
            )
            for task in tasks
        },
        "zero_violations": Judgement(rate, zero_violations, "finding"),
        **{
            f"unsafe[{variant}]": Judgement(rate, partial(unsafe_everywhere, variant))
            for variant in (*paper.CMDP_BASELINES, "FAC-phi0")
        },
        **{
            f"safe_but_lower[{variant}]": Judgement(
                f"{gap}, the task that decides", partial(safe_but_lower, variant, somewhere)
            )
            for variant, somewhere in (("JointSIS", False), ("FAC-phih", True))
        },
        "sensitivity_cost": Judgement(
            "rate of unseen episodes with a violation, the [a, b] that decides", points_are_safe
        ),
        "slowest_certificate": Judgement("none", slowest_certificate),
    }


def highest_safe_return(task: str, evidence: Evidence) -> Finding:
    """SafeMR is safe, and its return exceeds that of every baseline that is or may be safe.

    Refuted where SafeMR is not safe, or where the interval of its difference to a safe baseline is
    below 0; open where SafeMR's safety is, where an interval contains 0, or where a baseline whose
    safety is open is not exceeded. The estimate is the least difference.
    """
    absent = evidence.lacking(task, (paper.METHOD, *paper.BASELINES))
    if absent:
        return absent
    rule, scores = _rate_rule(evidence), evidence.scores
    label = rule.label(scores, task, paper.METHOD)
    shown = f"SafeMR's rate {describe_rate(rule.rate(scores, task, paper.METHOD))}"
    if label == "no":
        return Finding(NOTHING, "refuted", f"not safe: {shown}")
    ours = evidence.of(task, paper.METHOD, "eval_return")
    rivals = {v: rule.label(scores, task, v) for v in paper.BASELINES}
    gaps = {
        v: statistics.difference_interval(ours, evidence.of(task, v, "eval_return"), PRIMARY_LEVEL)
        for v in rivals
        if rivals[v] != "no"
    }
    parts = {f"against {v}": _against(v, rivals[v] == "yes", gaps[v]) for v in gaps}
    if label != "yes":
        parts["safety"] = Finding(NOTHING, "inconclusive", f"not decided: {shown}")
    if not parts:
        few = len(ours) < FEWEST_RUNS
        reason = f"no baseline is safe; {shown}{': ' + NO_INTERVAL if few else ''}"
        return Finding(NOTHING, "inconclusive" if few else "confirmed", reason)
    least = min(gaps.values(), key=lambda gap: gap.low, default=NOTHING)
    return replace(overall(parts), estimate=least)


def zero_violations(evidence: Evidence) -> Finding:
    """No flown episode of SafeMR has a violation, on each task; one refutes "zero"."""
    rule = _rate_rule(evidence)

    def judge(task: str) -> Finding:
        rate = rule.rate(evidence.scores, task, paper.METHOD)
        shown = f"rate {describe_rate(rate)}"
        if rate.mean > 0:
            return Finding(rate, "refuted", f"{shown}: violations were observed")
        if rate.size < FEWEST_RUNS:
            return Finding(rate, "inconclusive", f"{shown}: {NO_INTERVAL}")
        return Finding(rate, "confirmed", f"{shown}: none was observed, which proves no zero")

    return on_every_task(evidence, [paper.METHOD], judge)


def unsafe_everywhere(variant: str, evidence: Evidence) -> Finding:
    """The algorithm is not safe on every task; refuted where it is safe on one."""
    return on_every_task(evidence, [variant], partial(_labelled, evidence, variant, "no"))


def safe_but_lower(variant: str, somewhere: bool, evidence: Evidence) -> Finding:
    """The baseline is safe and SafeMR's return exceeds its, on every task.

    With `somewhere` (the paper says "in some of the environments"), on those where it is safe.
    """
    rule = _rate_rule(evidence)

    def judge(task: str) -> Finding | None:
        label = rule.label(evidence.scores, task, variant)
        if label == "no" and somewhere:
            return None
        if label != "yes":
            return _labelled(evidence, variant, "yes", task)
        returns = [evidence.of(task, name, "eval_return") for name in (paper.METHOD, variant)]
        return by_interval(statistics.difference_interval(*returns), 0.0, f"SafeMR - {variant}")

    return on_every_task(
        evidence, (paper.METHOD, variant), judge, otherwise=f"{variant} is safe on no task"
    )


def points_are_safe(evidence: Evidence) -> Finding:
    """Every point [a, b] is safe."""
    absent = missing_points(evidence, tuple(evidence.points))
    if absent:
        return absent
    task = paper.SENSITIVITY_TASK
    return overall(
        {
            f"[{a:g}, {b:g}]": _labelled(evidence, variant, "yes", task)
            for variant, (a, b) in evidence.points.items()
        }
    )


def slowest_certificate(evidence: Evidence) -> Finding:
    """Nothing that is recorded could refute it, so that it gets no verdict."""
    absent = on_every_task(evidence, [paper.METHOD], lambda task: Finding(NOTHING, "confirmed", ""))
    if absent.verdict == "not run":
        return absent
    reason = (
        "zeta's learning rate decays to zero at the end of training by the configuration, whatever "
        "is learned, and at a constant rate zeta drifts and settles nowhere (docs/tuning.md): when "
        "it settles is a setting, not a result"
    )
    return Finding(NOTHING, "not testable", reason)


def describe_rate(rate: Estimate) -> str:
    """A rate and its interval in percent."""
    mean, low, high = (100 * value for value in rate[:3])
    return describe(Estimate(mean, low, high, rate.size)).replace(" in every seed", "") + "%"


def _against(variant: str, safe: bool, gap: Estimate) -> Finding:
    """SafeMR's return minus a baseline's; one that may not be safe can leave it open, no more."""
    found = by_interval(gap, 0.0, f"SafeMR - {variant}")
    if safe or found.verdict == "confirmed":
        return found
    reason = f"{found.reason}, and whether {variant} is safe is not decided"
    return Finding(gap, "inconclusive", reason)


def _labelled(evidence: Evidence, variant: str, wanted: Label, task: str) -> Finding:
    """The algorithm has the wanted label on a task; the opposite refutes, none leaves it open."""
    rule = _rate_rule(evidence)
    rate = rule.rate(evidence.scores, task, variant)
    label = rule.label(evidence.scores, task, variant)
    words = {"yes": "safe", "no": "not safe"}.get(str(label), "not decided")
    shown = f"rate {describe_rate(rate)}: {words}"
    if label == wanted:
        return Finding(rate, "confirmed", shown)
    return Finding(rate, "inconclusive" if label == "not decided" else "refuted", shown)


def _rate_rule(evidence: Evidence) -> RateRule:
    if not isinstance(evidence.rule, RateRule):
        raise TypeError("the second protocol judges by a RateRule")
    return evidence.rule
