"""The paper's claims, judged: one rule a claim, computed from records.

A rule turns the evidence into a `Finding`: our number with its 95% interval, a verdict, and the
reason. docs/claims.md states the rules in words, and which of them are younger than the first
reported run. Common to all: a verdict needs every run of the
grid that it speaks about, else it is "inconclusive: runs missing: ..." (a claim about all tasks can
be refuted before by one of them); an interval that contains the threshold is inconclusive; and few
seeds support 95% intervals, not corrections for the number of claims.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd

from safemr import paper
from safemr.conventions import COVERS
from safemr.report import statistics
from safemr.report.convergence import certificate_settles_last, losses_bounded
from safemr.report.findings import (
    NO_INTERVAL,
    NOTHING,
    Evidence,
    Finding,
    Verdict,
    at_most,
    by_interval,
    describe,
    has_interval,
    missing_points,
    not_run,
    on_every_task,
    overall,
    surely_below,
    unavailable,
)
from safemr.report.second_protocol import Judgement, judgements
from safemr.report.statistics import Estimate
from safemr.report.tables import Table, best_safe_baseline

COLUMNS = ["estimate", "low", "high", "count"]


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and the rule that judges it."""

    name: str
    statement: str  # what the paper says
    measure: str  # what the estimate is
    figure: str  # stem of the figure that shows it
    judge: Callable[[Evidence], Finding]


# --- conservativeness (aircraft) -----------------------------------------------------------------


def smaller_than_joint_sis(evidence: Evidence) -> Finding:
    """Volume of JointSIS's unsafe set minus SafeMR's, in units of the true one: Welch, above 0."""
    names = ("JointSIS", paper.METHOD)
    absent = evidence.lacking_flights(names)
    if absent:
        return absent
    volumes = [evidence.measured(variant, "volume_ratio") for variant in names]
    gap = statistics.difference_interval(volumes[0], volumes[1])
    return by_interval(gap, 0.0, "JointSIS - SafeMR")


def covers_true_set(evidence: Evidence) -> Finding:
    """Missed share of SafeMR: confirmed if its interval is at or below 1%, refuted if above."""
    absent = evidence.lacking_flights([paper.METHOD])
    if absent:
        return absent
    missed = evidence.measured(paper.METHOD, "missed_share")
    estimate = statistics.mean_interval(missed, bounds=(0.0, 1.0))
    return at_most(estimate, COVERS, "missed share")


def handcrafted_does_not_cover(evidence: Evidence) -> Finding:
    """Missed share of phi_h, a fixed function without seeds: confirmed if above 1%."""
    missed = evidence.measured("phi_h", "missed_share")
    if not len(missed):
        what = "aircraft measurements of phi_h"
        return unavailable(what) if _asks_for_flights(evidence) else not_run(what)
    value = float(missed.mean())
    verdict: Verdict = "confirmed" if value > COVERS else "refuted"
    return Finding(Estimate(value, value, value, 1), verdict, f"missed share {value:.3f}, computed")


# --- return and safety ---------------------------------------------------------------------------


def highest_safe_return(task: str, evidence: Evidence) -> Finding:
    """SafeMR is safe and its return exceeds the best safe baseline's (Welch interval above 0).

    Refuted where SafeMR is not safe or the interval is below 0. With no safe baseline at all the
    claim holds as soon as SafeMR is safe.
    """
    baselines = paper.BASELINES
    absent = evidence.lacking(task, (paper.METHOD, *baselines))
    if absent:
        return absent
    ours = evidence.of(task, paper.METHOD, "eval_return")
    if not evidence.rule.is_safe(evidence.scores, task, paper.METHOD):
        cost = evidence.interval(task, paper.METHOD, evidence.rule.cost)
        return Finding(NOTHING, "refuted", f"SafeMR is not safe: {describe(cost)} violating steps")
    best, returns = best_safe_baseline(evidence.scores, task, evidence.rule, baselines)
    if not best:
        own = statistics.mean_interval(ours)
        shown = f"no baseline is safe; SafeMR returns {describe(own)}"
        if own.size < statistics.FEWEST_RUNS:
            return Finding(NOTHING, "inconclusive", f"{shown}: {NO_INTERVAL}")
        return Finding(NOTHING, "confirmed", shown)
    gap = statistics.difference_interval(ours, returns)
    return by_interval(gap, 0.0, f"SafeMR - {best}")


def zero_violations(evidence: Evidence) -> Finding:
    """Share of final evaluation episodes without any violation, SafeMR, each task.

    Confirmed if it is 1 in every seed of three or more (none observed; not a proof), refuted by
    one violation: it contradicts zero, whatever the interval of the share.
    """

    def judge(task: str) -> Finding:
        shares = evidence.of(task, paper.METHOD, evidence.rule.clean)
        estimate = evidence.interval(task, paper.METHOD, evidence.rule.clean)
        shown = f"clean share {describe(estimate)}"
        if (shares == 1).all() and len(shares) < statistics.FEWEST_RUNS:
            return Finding(estimate, "inconclusive", f"{shown}: {NO_INTERVAL}")
        if (shares == 1).all():
            return Finding(estimate, "confirmed", f"{shown}, no violation observed")
        seeds = f"violations in {(shares != 1).sum()} of {len(shares)} seeds"
        return Finding(estimate, "refuted", f"{shown}, {seeds}")

    return on_every_task(evidence, [paper.METHOD], judge)


def unsafe_everywhere(variant: str, evidence: Evidence) -> Finding:
    """The algorithm is unsafe on every task, beyond doubt of its interval.

    Confirmed on a task if the interval of its violating steps lies above the tolerance or that of
    its clean share below the rule's (`surely_below`); refuted if it is safe by the rule; else open.
    """
    rule = evidence.rule

    def judge(task: str) -> Finding:
        cost = evidence.interval(task, variant, rule.cost)
        clean = evidence.interval(task, variant, rule.clean)
        shown = f"{describe(cost)} violating steps, clean share {describe(clean)}"
        if rule.is_safe(evidence.scores, task, variant):
            return Finding(cost, "refuted", f"{shown}: safe")
        if has_interval(cost) and cost.low > rule.tolerance:
            return Finding(cost, "confirmed", f"{shown}: the steps decide")
        if surely_below(clean, rule.clean_share):
            return Finding(cost, "confirmed", f"{shown}: the share decides")
        return Finding(cost, "inconclusive", f"{shown}: unsafe on average only")

    return on_every_task(evidence, [variant], judge)


def higher_than_ours(variant: str, evidence: Evidence) -> Finding:
    """The algorithm's return exceeds SafeMR's on every task (Welch interval above 0)."""
    names = (variant, paper.METHOD)

    def judge(task: str) -> Finding:
        returns = [evidence.of(task, name, "eval_return") for name in names]
        gap = statistics.difference_interval(returns[0], returns[1])
        return by_interval(gap, 0.0, f"{variant} - SafeMR")

    return on_every_task(evidence, names, judge)


def safe_but_lower(variant: str, somewhere: bool, evidence: Evidence) -> Finding:
    """The baseline is safe and SafeMR's return exceeds its (Welch interval above 0).

    On every task, or, with `somewhere` (the paper says "in some of the environments"), on those
    tasks where the baseline is safe, at least one.
    """
    names = (paper.METHOD, variant)

    def judge(task: str) -> Finding | None:
        if not evidence.rule.is_safe(evidence.scores, task, variant):
            if somewhere:
                return None
            cost = evidence.interval(task, variant, evidence.rule.cost)
            reason = f"{variant} is not safe: {describe(cost)} violating steps"
            return Finding(NOTHING, "refuted", reason)
        returns = [evidence.of(task, name, "eval_return") for name in names]
        gap = statistics.difference_interval(returns[0], returns[1])
        return by_interval(gap, 0.0, f"SafeMR - {variant}")

    return on_every_task(evidence, names, judge, otherwise=f"{variant} is safe on no task")


# --- the points [a, b] ---------------------------------------------------------------------------


def points_beat_joint_sis(evidence: Evidence) -> Finding:
    """For every [a, b] of Table II: return minus JointSIS's, Welch interval above 0."""
    task = paper.SENSITIVITY_TASK
    absent = missing_points(evidence, (*evidence.points, "JointSIS"))
    if absent:
        return absent
    baseline = evidence.of(task, "JointSIS", "eval_return")
    return overall(
        {
            f"[{a:g}, {b:g}]": by_interval(
                statistics.difference_interval(evidence.of(task, v, "eval_return"), baseline),
                0.0, "return - JointSIS",
            )
            for v, (a, b) in evidence.points.items()
        }
    )  # fmt: skip


def point_costs_vanish(evidence: Evidence) -> Finding:
    """For every [a, b]: violating steps of the final policy at most the tolerance, by interval."""
    absent = missing_points(evidence, tuple(evidence.points))
    if absent:
        return absent
    rule = evidence.rule
    return overall(
        {
            f"[{a:g}, {b:g}]": at_most(
                evidence.interval(paper.SENSITIVITY_TASK, variant, rule.cost),
                rule.tolerance, "violating steps",
            )
            for variant, (a, b) in evidence.points.items()
        }
    )  # fmt: skip


# --- feasibility -----------------------------------------------------------------------------


def parameters_feasible(group: str, evidence: Evidence) -> Finding:
    """No searched state lacks a safe action, for every certificate of a group.

    The group is the paper's ("paper") or a variant's at every point [a, b], on the paper's tasks.

    Feasible means that the safe action set is nonempty at every state, so one replayable state
    without a safe action refutes it; a search that finds none leaves it unrefuted, and then the
    analytic condition with the aligned brake must hold too. The estimate is the least constraint
    value g that the best action reaches at the worst state found: positive means that no action
    satisfies the constraint. It has no sampling interval, the states are a fixed low-discrepancy
    set, refined around the worst. Of each learned variant the first recorded seed is certified.
    """
    rows = evidence.certificates
    if rows is not None:
        rows = rows[[_belongs(name, group) for name in rows["certificate"]]]
        rows = rows[rows["task"].isin(evidence.tasks)]
    if rows is None or rows.empty:
        what = f"certify results of {group}"
        asked = group != "paper" and evidence.asks_for((task, group) for task in evidence.tasks)
        return unavailable(what) if asked or evidence.expected is None else not_run(what)
    if "family" in rows and rows["family"].notna().any():
        return not_run(f"an analytic condition for the family of energy functions of {group}")
    worst = rows.sort_values("worst_margin").iloc[-1]
    share = float(rows["infeasible_share"].max())
    estimate = Estimate(float(worst["worst_margin"]), np.nan, np.nan, len(rows))
    aligned = rows[["margin_inside_aligned", "margin_outside_aligned"]].to_numpy()
    drag = rows[["margin_inside_drag", "margin_outside_drag"]].to_numpy()
    shown = (
        f"{len(rows)} certificates; infeasible share up to {100 * share:.3f}% of searched states; "
        f"analytic condition holds for {(aligned >= 0).all(1).sum()} with the aligned brake, for "
        f"{(drag >= 0).all(1).sum()} with drag only"
    )
    if worst["worst_margin"] >= 0:
        found = (
            f"{worst['certificate']} has a state, not necessarily one that is ever reached, where "
        )
        found += f"every action leaves g above 0, at best {worst['worst_margin']:+.4f}"
        return Finding(estimate, "refuted", f"{found}; {shown}")
    verdict: Verdict = "confirmed" if (aligned >= 0).all() else "inconclusive"
    return Finding(estimate, verdict, f"{shown}; no infeasible state found")


# --- the list ------------------------------------------------------------------------------------


def claims(tasks: Sequence[str] = paper.TASKS, protocol: int = 1) -> list[Claim]:
    """Every claim of the paper that the repository judges, in the paper's order.

    protocol: 1, or 2, which judges some of them otherwise (`second_protocol`).
    """
    listed = _first_protocol(tasks)
    if protocol == 1:
        return listed
    others = judgements(tuple(tasks))
    return [_judged_otherwise(claim, others.get(claim.name)) for claim in listed]


def _judged_otherwise(claim: Claim, by: Judgement | None) -> Claim:
    if by is None:
        return claim
    return replace(claim, measure=by.measure, judge=by.judge, figure=by.figure or claim.figure)


def _first_protocol(tasks: Sequence[str]) -> list[Claim]:
    listed = [
        Claim(
            "conservativeness", "The unsafe set learned by SafeMR is smaller than JointSIS's",
            "difference of volumes, in units of the true unsafe set", "aircraft_frontier",
            smaller_than_joint_sis,
        ),
        Claim(
            "coverage", "SafeMR's unsafe set covers the true unsafe set",
            "share of the true unsafe set beyond the collision disc missed", "aircraft_frontier",
            covers_true_set,
        ),
        Claim(
            "handcrafted_coverage", "The handcrafted unsafe set does not cover the true one",
            "share of the true unsafe set beyond the collision disc missed", "aircraft_frontier",
            handcrafted_does_not_cover,
        ),
    ]  # fmt: skip
    listed += [
        Claim(
            f"highest_return[{task}]",
            f"SafeMR has the highest return among safe algorithms on {task}",
            "difference of final returns to the best safe baseline", "training_curves",
            partial(highest_safe_return, task),
        )
        for task in tasks
    ]  # fmt: skip
    listed.append(
        Claim(
            "zero_violations", "SafeMR has zero constraint violations",
            "share of final evaluation episodes without violation", "training_curves",
            zero_violations,
        )
    )  # fmt: skip
    listed += [
        Claim(
            f"{name}[{variant}]", f"{variant} {says}", measure, "return_against_cost",
            partial(judge, variant),
        )
        for name, says, measure, judge in (
            ("unsafe", "is not safe at cost limit zero",
             "violating steps an episode, the task that decides", unsafe_everywhere),
            ("higher_return", "has a higher return than SafeMR",
             "difference of final returns, the task that decides", higher_than_ours),
        )
        for variant in (*paper.CMDP_BASELINES, "FAC-phi0")
    ]  # fmt: skip
    listed += [
        Claim(
            f"safe_but_lower[{variant}]",
            f"{variant} is safe{where} but has lower return than SafeMR",
            "difference of final returns, the task that decides", "return_against_cost",
            partial(safe_but_lower, variant, bool(where)),
        )
        for variant, where in (("JointSIS", ""), ("FAC-phih", " in some of the environments"))
    ]  # fmt: skip
    return [
        *listed,
        Claim(
            "sensitivity_return", "All choices of [a, b] outperform JointSIS",
            "difference of final returns, the [a, b] that decides", "sensitivity",
            points_beat_joint_sis,
        ),
        Claim(
            "sensitivity_cost", "The costs converge to zero for all [a, b]",
            "violating steps an episode, the [a, b] that decides", "sensitivity",
            point_costs_vanish,
        ),
        Claim(
            "feasibility_paper", "All three sets of learned parameters are feasible (the paper's)",
            "least g of the best action at the worst state found", "certificates",
            partial(parameters_feasible, "paper"),
        ),
        Claim(
            "feasibility_ours", "All learned parameters are feasible (SafeMR's, learned here)",
            "least g of the best action at the worst state found", "certificates",
            partial(parameters_feasible, paper.METHOD),
        ),
        Claim(
            "slowest_certificate", "The energy function converges the most slowly",
            "share of training by which zeta settles later, the task that decides",
            "parameters", certificate_settles_last,
        ),
        Claim(
            "bounded", "Loss and gradient norm do not increase too much and cause no divergence",
            "largest value in the last quarter over the largest before, the task that decides",
            "parameters",
            losses_bounded,
        ),
    ]  # fmt: skip


OURS = "ours [95% interval if not said]"  # the head of a column, by which the page finds it


def claims_table(evidence: Evidence, protocol: int = 1) -> Table:
    """A row a claim: statement, measure, our number with its interval, verdict, why, figure."""
    rows = []
    for claim in claims(evidence.tasks, protocol):
        finding = claim.judge(evidence)
        rows.append([claim.name, claim.statement, claim.measure, *finding.estimate,
                     finding.verdict, finding.reason, claim.figure])  # fmt: skip
    data = pd.DataFrame(
        rows,
        columns=["claim", "statement", "measure", "estimate", "low", "high", "count",
                 "verdict", "reason", "figure"],
    )  # fmt: skip
    display = pd.DataFrame(
        {
            "paper's statement": data["statement"],
            "our measure": data["measure"],
            OURS: [
                describe(Estimate(mean, low, high, int(count)))
                for mean, low, high, count in data[COLUMNS].to_numpy(float)
            ],
            "verdict": data["verdict"],
            "why": data["reason"],
            "figure": data["figure"],
        }
    )  # fmt: skip
    rules = {
        1: "by rules of which docs/claims.md says which were changed or added after the first "
        "reported run",
        2: "by the second protocol of docs/claims.md",
    }
    caption = (
        f"Claims of the paper and what these runs say of them, {rules[protocol]}. "
        "Not run: nothing that the "
        "claim is about, a task with the paper's settings, is in this configuration. "
        f"{str(evidence.rule).capitalize()}."
    )
    return Table("claims", caption, data, display)


def _belongs(certificate: str, group: str) -> bool:
    """Whether a certificate's name, "label (seed n)", is of a group: SafeMR, not SafeMR-literal."""
    label = certificate.partition(" (")[0]
    return label == group or label.startswith((f"{group} [", f"{group}["))


def _asks_for_flights(evidence: Evidence) -> bool:
    expected = evidence.expected
    return expected is None or bool((expected["task"] == paper.AIRCRAFT_TASK).any())
