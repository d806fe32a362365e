"""The final policies on unseen layouts, beside their final evaluations, as a table."""

from __future__ import annotations

import pandas as pd
from scipy.special import betaincinv

from safemr import paper
from safemr.report import statistics
from safemr.report.statistics import Estimate
from safemr.report.tables import ABSENT, FEW, SafetyRule, Table, entries, plus_minus


def table(
    flown: pd.DataFrame,
    scores: pd.DataFrame,
    *,
    episodes: int,
    rule: SafetyRule | None = None,
    layouts: int = 10,
    own: bool = False,
    method: str = paper.METHOD,
) -> Table:
    """A row an algorithm and task: return, its change against the final evaluations, how far it is
    behind the method's, violations.

    flown: `measured_scores`. scores: `statistics.final_scores`, of evaluations on ``layouts``. The
    upper end is Clopper and Pearson's one-sided 95% bound on the probability that an episode has a
    violation, as if all episodes of all seeds were independent.
    """
    rule = rule or SafetyRule()
    keys = ["task", "variant", "seed"]
    evaluated = scores.merge(flown[keys].drop_duplicates())  # a change is of the same runs
    rows = []
    for task, variant in entries(flown, None):
        ours = {
            metric: statistics.scores_of(flown, task, variant, metric)
            for metric in ("eval_return", rule.cost, rule.clean)
        }
        before = statistics.scores_of(evaluated, task, variant, "eval_return")
        mean = statistics.mean_interval(ours["eval_return"])
        best = statistics.scores_of(flown, task, method, "eval_return")
        gap = statistics.difference_interval(best, ours["eval_return"])
        if variant == method:
            gap = Estimate(float("nan"), float("nan"), float("nan"), 0)
        steps = statistics.score_interval(flown, task, variant, rule.cost)
        total = episodes * len(ours[rule.clean])
        dirty = round(float((episodes * (1 - ours[rule.clean])).sum()))
        bound = 1.0 if dirty == total else float(betaincinv(dirty + 1, total - dirty, 0.95))
        rows.append(
            {
                "task": task, "variant": variant, "seeds": mean.size,
                "safe": rule.is_safe(flown, task, variant),
                "label": rule.label(flown, task, variant),
                "return": mean.mean, "return_low": mean.low, "return_high": mean.high,
                "change": mean.mean - before.mean() if len(before) else float("nan"),
                "behind": gap.mean, "behind_low": gap.low, "behind_high": gap.high,
                "violating_steps": steps.mean, "steps_low": steps.low, "steps_high": steps.high,
                "violating_episodes": dirty, "episodes": total, "upper_bound": bound,
            }
        )  # fmt: skip
    data = pd.DataFrame(rows).drop(columns="label")
    display = pd.DataFrame(
        [
            [
                row["task"], row["variant"], str(row["seeds"]), row["label"],
                plus_minus(row["return"], row["return_low"], row["return_high"], 2),
                ABSENT if pd.isna(row["change"]) else f"{row['change']:+.2f}",
                ABSENT if pd.isna(row["behind"])
                else plus_minus(row["behind"], row["behind_low"], row["behind_high"], 2),
                plus_minus(row["violating_steps"], row["steps_low"], row["steps_high"], 2),
                f"{row['violating_episodes']} of {row['episodes']}", f"{row['upper_bound']:.1%}",
            ]
            for row in rows
        ],
        columns=["task", "algorithm", "seeds", "safe", "return", "against the final evaluations",
                 f"{method} minus it",
                 "violating steps", "episodes with a violation", "at most"],
    )  # fmt: skip
    shared = "each seed's own" if own else "the same for all"
    caption = (
        f"Final policies on {episodes} layouts that no run was evaluated on, {shared}: "
        "mean over seeds ± half width of the 95% t interval; what it changes against the final "
        f"evaluations on {layouts} layouts; {method}'s return minus this one, with Welch's "
        f"interval; [the ends] of an interval that is cut off at 0. {FEW} At "
        "most: one-sided 95% bound on the probability that an episode has a violation, as if all "
        f"episodes were independent. {str(rule).capitalize()}; here applied to these episodes."
    )
    return Table("unseen_layouts", caption, data, display)
