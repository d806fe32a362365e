"""What a number of seeds can see, by simulation from the spread between the runs of a pilot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from safemr.report import statistics
from safemr.report.second_protocol import EPISODES, PRIMARY_LEVEL, RateRule, rate_interval
from safemr.report.tables import ABSENT, SafetyRule, Table

SEEDS = (5, 10)
WANTED = 0.8  # power at which a difference counts as seen
MOST = 100  # seeds; more are not asked for
DRAWS = 4000
RATES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)


def detection_power(gap: float, seeds: int, level: float, draws: int = DRAWS) -> float:
    """Probability that Welch's interval of two normal samples of this size lies above 0.

    gap: the true difference, in units of the standard deviation between runs, which is that of
    both. The draws are seeded: the same question has the same answer.
    """
    first, second = np.random.default_rng(0).standard_normal((2, draws, seeds))
    variances = [sample.var(1, ddof=1) / seeds for sample in (first, second)]
    total = variances[0] + variances[1]
    freedom = total**2 / ((variances[0] ** 2 + variances[1] ** 2) / (seeds - 1))
    half = stdtrit(freedom, (1 + level) / 2) * np.sqrt(total)
    return float(np.mean(gap + first.mean(1) - second.mean(1) > half))


def smallest_seen(seeds: int, level: float) -> float:
    """The least true difference seen with probability `WANTED`, in standard deviations."""
    low, high = 0.0, 8.0
    for _ in range(20):
        middle = (low + high) / 2
        seen = detection_power(middle, seeds, level) >= WANTED
        low, high = (low, middle) if seen else (middle, high)
    return high


def seeds_to_see(gap: float, level: float) -> int | None:
    """The fewest seeds (2 to `MOST`) that see a true difference with probability `WANTED`.

    gap: in standard deviations, as in `detection_power`. None where `MOST` do not.
    """
    few, many = 1, MOST
    if detection_power(gap, many, level) < WANTED:
        return None
    while many - few > 1:
        middle = (few + many) // 2
        seen = detection_power(gap, middle, level) >= WANTED
        few, many = (few, middle) if seen else (middle, many)
    return many


def of_returns(
    flown: pd.DataFrame, tasks: Sequence[str], method: str, baselines: Sequence[str]
) -> Table:
    """For each task and baseline: the spread, the difference observed, and what seeds can see.

    flown: score table. Standard deviations are of each algorithm's runs, and pooled over the two
    that are compared: pooled over all of a task, one that is widely spread would decide for all.
    With three runs they are rough. `data` has one row (task, variant).
    """
    least = [smallest_seen(seeds, PRIMARY_LEVEL) for seeds in SEEDS]
    rows, lines = [], []
    for task in tasks:
        returns = {v: statistics.scores_of(flown, task, v, "eval_return") for v in
                   (method, *baselines)}  # fmt: skip
        if not len(returns[method]):
            continue
        for variant in baselines:
            known = [v for v in (returns[method], returns[variant]) if len(v) > 1]
            squares = sum(((values - values.mean()) ** 2).sum() for values in known)
            if not squares or not len(returns[variant]):
                continue
            pooled = float(np.sqrt(squares / sum(len(values) - 1 for values in known)))
            gap = float(returns[method].mean() - returns[variant].mean())
            smallest = [pooled * unit for unit in least]
            powers = [detection_power(abs(gap) / pooled, seeds, PRIMARY_LEVEL) for seeds in SEEDS]
            wanted = seeds_to_see(abs(gap) / pooled, PRIMARY_LEVEL)
            own = [float(v.std(ddof=1)) if len(v) > 1 else np.nan
                   for v in (returns[method], returns[variant])]  # fmt: skip
            rows.append([task, variant, gap, *own, pooled, *smallest, *powers, wanted])
            lines.append(
                [task, variant, f"{gap:+.2f}",
                 *(ABSENT if np.isnan(sd) else f"{sd:.2f}" for sd in own), f"{pooled:.2f}",
                 *(f"{value:.2f}" for value in smallest), *(f"{value:.0%}" for value in powers),
                 f"over {MOST}" if wanted is None else f"{wanted}"]
            )  # fmt: skip
    names = ["task", "variant", "difference", "method_sd", "variant_sd", "pooled_sd"]
    names += [f"smallest_{seeds}" for seeds in SEEDS] + [f"power_{seeds}" for seeds in SEEDS]
    names.append("seeds_to_see")
    heads = ["task", "minus", "difference here", f"SD of {method}", "its SD", "pooled SD"]
    heads += [f"seen with {seeds} seeds" for seeds in SEEDS]
    heads += [*(f"power with {seeds}" for seeds in SEEDS), f"seeds for {WANTED:.0%}"]
    caption = (
        "What five and ten seeds of both can see of a difference of flown returns to "
        f"{method}: standard deviations between runs; the least true difference at which Welch's "
        f"{100 * PRIMARY_LEVEL:g}% interval, that of the primary claim, excludes 0 in "
        f"{WANTED:.0%} of {DRAWS:,} simulated experiments with the pooled deviation of the two; "
        "and, if the difference seen here is the true one, the share in which it does so and the "
        f"seeds with which it does so in {WANTED:.0%}."
    )
    return Table(
        "power", caption, pd.DataFrame(rows, columns=names), pd.DataFrame(lines, columns=heads)
    )


def of_safety(flown: pd.DataFrame, tasks: Sequence[str], rule: SafetyRule) -> Table:
    """How an algorithm with a given rate of violating episodes would be labelled.

    Rates of runs are drawn from a beta distribution with that mean and the intra-class correlation
    rho that the runs of the pilot with violations have (moments, all tasks together); episodes are
    binomial. `data` has one row (rate, seeds).
    """
    if not isinstance(rule, RateRule):
        raise TypeError("what is simulated is the second protocol's rule")
    episodes, rho = _correlation(flown, tasks, rule)
    generator = np.random.default_rng(0)
    rows = []
    for rate in RATES:
        for seeds in SEEDS:
            counts = np.zeros((DRAWS // 4, seeds))
            if rate > 0:
                weight = (1 - rho) / rho if rho > 0 else np.inf
                rates = (
                    generator.beta(rate * weight, (1 - rate) * weight, counts.shape)
                    if np.isfinite(weight)
                    else np.full(counts.shape, rate)
                )
                counts = generator.binomial(episodes, rates)
            each = np.full(seeds, float(episodes))
            labels = [rule.label_of(rate_interval(row / episodes, each)) for row in counts]
            shares = [labels.count(label) / len(labels) for label in ("yes", "not decided", "no")]
            rows.append([rate, seeds, *shares])
    data = pd.DataFrame(rows, columns=["rate", "seeds", "safe", "not_decided", "not_safe"])
    display = pd.DataFrame(
        [[f"{rate:.0%}", f"{seeds:g}", *(f"{share:.0%}" for share in shares)]
         for rate, seeds, *shares in rows],
        columns=["true rate of violating episodes", "seeds", "labelled safe", "not decided",
                 "not safe"],
    )  # fmt: skip
    caption = (
        "How an algorithm is labelled by the second protocol, by the true rate of its episodes "
        f"with a violation: share of {DRAWS // 4:,} simulated experiments with {episodes} episodes "
        f"a run and the correlation within runs, {rho:.2f}, of the algorithms here that violate. "
        f"{str(rule).capitalize()}."
    )
    return Table("power_of_safety", caption, data, display)


def _correlation(flown: pd.DataFrame, tasks: Sequence[str], rule: RateRule) -> tuple[int, float]:
    """Episodes a run, and the intra-class correlation of violations within runs."""
    episodes = int(flown.loc[flown["metric"] == EPISODES, "value"].max())
    excess, expected = 0.0, 0.0
    chosen = flown[flown["task"].isin(list(tasks)) & (flown["metric"] == rule.clean)]
    for _, group in chosen.groupby(["task", "variant"]):
        rates = 1 - group["value"].to_numpy(float)
        mean = float(rates.mean())
        if len(rates) > 1 and 0 < mean < 1:
            binomial = mean * (1 - mean)
            excess += float(rates.var(ddof=1)) - binomial / episodes
            expected += binomial * (1 - 1 / episodes)
    return episodes, float(np.clip(excess / expected, 0, 0.99)) if expected else 0.0
