"""What the paper says of training curves, judged: when zeta settles, whether losses are bounded."""

from __future__ import annotations

import numpy as np

from safemr import paper
from safemr.report import statistics
from safemr.report.findings import (
    NOTHING,
    Evidence,
    Finding,
    at_most,
    by_interval,
    on_every_task,
    smooth_curves,
    unavailable,
)

GROWTH = 2.0  # "bounded": the last quarter at most this many times the largest before


def certificate_settles_last(evidence: Evidence) -> Finding:
    """Share of training at which zeta settles, minus that of return and mean multiplier.

    A curve has settled where it stays within a tenth of its range of its final value, after a
    trailing average over a tenth of its points. One number a SafeMR run: the last of sigma, k, n
    minus the last of the other two. Interval above 0 on every task.
    """
    late = ("sigma", "k", "n")
    metrics = (*late, "train_return", "multiplier_mean")

    def judge(task: str) -> Finding:
        lags = []
        for curves in smooth_curves(evidence.progress, task, metrics):
            settled = {
                metric: statistics.settling_share(steps, values)
                for metric, (steps, values) in curves.items()
            }
            others = [settled[metric] for metric in settled if metric not in late]
            own = [settled[metric] for metric in late if metric in settled]
            if own and others:
                lags.append(max(own) - max(others))
        if not lags:
            return unavailable(f"curves of SafeMR on {task}")
        return by_interval(statistics.mean_interval(np.array(lags)), 0.0, "settling lag")

    return on_every_task(evidence, [paper.METHOD], judge)


def losses_bounded(evidence: Evidence) -> Finding:
    """Largest |value| in the last quarter over that in the rest, every loss and gradient norm.

    One number a SafeMR run, its worst metric, after the same trailing average. Confirmed if the
    interval ends at or below 2 on every task; refuted if it begins above, or if any value is not
    finite. A run that diverged leaves no record and counts as missing.
    """
    names = evidence.progress.loc[evidence.progress["variant"] == paper.METHOD, "metric"]
    metrics = [m for m in names.unique() if m.endswith(("_loss", "_grad_norm"))]

    def judge(task: str) -> Finding:
        runs = smooth_curves(evidence.progress, task, metrics)
        if not runs:
            return unavailable(f"losses and gradient norms of SafeMR on {task}")
        ratios = []
        for curves in runs:
            worst = 0.0
            for steps, values in curves.values():
                if not np.isfinite(values).all():
                    return Finding(NOTHING, "refuted", "a loss or gradient norm is not finite")
                late = steps > 0.75 * steps[-1]
                early = np.abs(values[~late]).max(initial=0.0)
                worst = max(worst, float(np.abs(values[late]).max() / max(early, 1e-12)))
            ratios.append(worst)
        return at_most(statistics.mean_interval(np.array(ratios)), GROWTH, "growth")

    return on_every_task(evidence, [paper.METHOD], judge)
