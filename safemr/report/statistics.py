"""Estimates from tidy records: t intervals over seeds, IQM, improvement, performance profiles.

Every function takes DataFrames or arrays and returns DataFrames or `Estimate`s; nothing is drawn
here and nothing random is unseeded. The tidy table has one row per (task, variant, seed, step,
metric) with a `value`; a *score table* has one row per (task, variant, seed, metric).

Aggregates follow Agarwal et al., "Deep RL at the edge of the statistical precipice" (2021): the
interquartile mean with a bootstrap that resamples seeds within each task.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from safemr.errors import UserError

LEVEL = 0.95  # confidence level of every interval in the paper and here
REPLICATES = (
    2000  # bootstrap resamples; the Monte-Carlo error of a limit is then well below 0.1 s.d.
)
FEWEST_RUNS = 3  # for an interval: that of two runs is 13 of their standard errors wide, or nothing
FINAL_SHARE = 0.1  # final performance: the last 10% of a run's evaluations

UNBOUNDED = (-np.inf, np.inf)
_SHARES = ("zero_violation_share", "violation_rate")
_COUNTS = ("violations", "goals", "episodes", "minutes", "length")

Samples = Mapping[str, np.ndarray]  # task -> [seeds] one score a run


class Estimate(NamedTuple):
    """A number with its interval; `low` and `high` are nan where `size` cannot support one."""

    mean: float
    low: float
    high: float
    size: int  # independent runs

    @property
    def half_width(self) -> float:
        """Half the length of the interval (nan or inf where it is undefined or unbounded)."""
        return (self.high - self.low) / 2


def bounds_of(metric: str) -> tuple[float, float]:
    """Between which values the mean of a metric lies whatever the runs: shares, costs, counts."""
    name = metric.removeprefix("eval_").removeprefix("train_")
    if name in _SHARES:
        return (0.0, 1.0)
    return (0.0, np.inf) if name in _COUNTS or name.startswith("cost") else UNBOUNDED


def mean_interval(
    values: np.ndarray, level: float = LEVEL, bounds: tuple[float, float] = UNBOUNDED
) -> Estimate:
    """Mean of independent runs and its Student-t interval, mean +- t(n-1) s / sqrt(n).

    `values` [n] is one number a seed; nan entries are dropped. Fewer than `FEWEST_RUNS` have a mean
    but no interval. What of it lies outside `bounds` (`bounds_of`), where the quantity cannot be,
    is cut off.
    """
    sample = np.asarray(values, dtype=float)
    sample = sample[~np.isnan(sample)]
    count = len(sample)
    if count == 0:
        return Estimate(np.nan, np.nan, np.nan, 0)
    mean = float(sample.mean())
    if count < FEWEST_RUNS:
        return Estimate(mean, np.nan, np.nan, count)
    if sample.min() == sample.max():  # whose deviation is rounding
        return Estimate(float(sample[0]), float(sample[0]), float(sample[0]), count)
    half = float(stdtrit(count - 1, (1 + level) / 2) * sample.std(ddof=1) / np.sqrt(count))
    return Estimate(mean, max(mean - half, bounds[0]), min(mean + half, bounds[1]), count)


def difference_interval(first: np.ndarray, second: np.ndarray, level: float = LEVEL) -> Estimate:
    """mean(first) - mean(second) with Welch's interval for unequal variances.

    Seeds are treated as independent between algorithms: a common seed fixes the layouts that are
    drawn, not the states that a policy visits. `size` is that of the smaller sample.
    """
    x, y = _finite(first), _finite(second)
    if not len(x) or not len(y):
        return Estimate(np.nan, np.nan, np.nan, 0)
    gap, count = float(x.mean() - y.mean()), min(len(x), len(y))
    if count < FEWEST_RUNS:
        return Estimate(gap, np.nan, np.nan, count)
    half = _welch_t(x, y, 1.0, level) * np.sqrt(_variance_of_mean(x) + _variance_of_mean(y))
    return Estimate(gap, gap - half, gap + half, count)


def improvement_interval(ours: np.ndarray, baseline: np.ndarray, level: float = LEVEL) -> Estimate:
    """Relative improvement mean(ours) / mean(baseline) - 1 with Fieller's interval.

    Fieller: all ratios r with (m1 - r m2)^2 <= t^2 (v1 + r^2 v2), m and v the means and their
    variances, t with Welch's degrees of freedom at the point estimate. The limits are infinite
    where the baseline's mean cannot be told from zero, and the improvement is undefined (nan) where
    that mean is not positive.
    """
    x, y = _finite(ours), _finite(baseline)
    if not len(x) or not len(y) or y.mean() <= 0:
        return Estimate(np.nan, np.nan, np.nan, 0)
    m1, m2, count = float(x.mean()), float(y.mean()), min(len(x), len(y))
    ratio = m1 / m2
    if count < FEWEST_RUNS:
        return Estimate(ratio - 1, np.nan, np.nan, count)
    v1, v2 = _variance_of_mean(x), _variance_of_mean(y)
    t2 = _welch_t(x, y, ratio, level) ** 2
    # (m2^2 - t^2 v2) r^2 - 2 m1 m2 r + (m1^2 - t^2 v1) <= 0
    leading = m2**2 - t2 * v2
    if leading <= 0:
        return Estimate(ratio - 1, -np.inf, np.inf, count)
    root = np.sqrt(max((m1 * m2) ** 2 - leading * (m1**2 - t2 * v1), 0.0))
    low, high = (m1 * m2 - root) / leading, (m1 * m2 + root) / leading
    return Estimate(ratio - 1, float(low) - 1, float(high) - 1, count)


def linear_effects(factors: np.ndarray, values: np.ndarray, level: float = LEVEL) -> list[Estimate]:
    """Slopes of values [n] against factors [n, k] by least squares with a constant, t intervals.

    Runs are treated as independent. Too few of them, or factors that are not independent of each
    other and of the constant, give nan.
    """
    count, slopes = factors.shape
    design = np.column_stack([np.ones(count), factors])
    free = count - slopes - 1
    if free < 1 or np.linalg.matrix_rank(design) <= slopes:
        return [Estimate(np.nan, np.nan, np.nan, count)] * slopes
    inverse = np.linalg.inv(design.T @ design)
    found = inverse @ design.T @ values
    variance = float(((values - design @ found) ** 2).sum()) / free
    half = stdtrit(free, (1 + level) / 2) * np.sqrt(variance * np.diag(inverse))
    return [
        Estimate(float(mean), float(mean - reach), float(mean + reach), count)
        for mean, reach in zip(found[1:], half[1:], strict=True)
    ]


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the middle half along the last axis: floor(n/4) values dropped at each end."""
    ordered = np.sort(np.asarray(values, dtype=float), axis=-1)
    cut = ordered.shape[-1] // 4
    return ordered[..., cut : ordered.shape[-1] - cut].mean(-1)


def stratified_bootstrap(
    samples: Samples,
    statistic: Callable[[Samples], np.ndarray],
    *,
    seed: int = 0,
    replicates: int = REPLICATES,
    level: float = LEVEL,
) -> Estimate:
    """`statistic(samples)` with a percentile interval; seeds are resampled within each task.

    The statistic works along the last axis of its arrays: it gets [seeds] once and
    [replicates, seeds] once. `size` is the smallest number of seeds of a task; with fewer than
    `FEWEST_RUNS` there is no interval.
    """
    point = float(statistic(samples))
    count = min((len(values) for values in samples.values()), default=0)
    if count < FEWEST_RUNS:
        return Estimate(point, np.nan, np.nan, count)
    draws = statistic(_resample(samples, np.random.default_rng(seed), replicates))
    low, high = np.quantile(draws, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(point, float(low), float(high), count)


def pooled_iqm(samples: Samples) -> np.ndarray:
    """Interquartile mean over the runs of all tasks; scores must be normalised beforehand."""
    return interquartile_mean(np.concatenate(list(samples.values()), axis=-1))


def probability_of_improvement(first: Samples, second: Samples) -> np.ndarray:
    """P(X > Y) + P(X = Y) / 2 for one run of each algorithm, averaged over their common tasks.

    The Mann-Whitney statistic divided by the number of pairs; 0.5 means no difference.
    """
    tasks = [task for task in first if task in second]
    if not tasks:
        raise UserError("probability of improvement: the two algorithms have no task in common")
    shares = []
    for task in tasks:
        x, y = np.asarray(first[task])[..., :, None], np.asarray(second[task])[..., None, :]
        shares.append(((x > y) + 0.5 * (x == y)).mean((-2, -1)))
    return np.mean(shares, axis=0)


def improvement_probability(
    first: Samples, second: Samples, *, seed: int = 0, replicates: int = REPLICATES
) -> Estimate:
    """`probability_of_improvement` with its stratified bootstrap interval."""
    tasks = [task for task in first if task in second]
    sides = {"x": first, "y": second}
    joint = {f"{side}/{task}": sides[side][task] for side in sides for task in tasks}

    def statistic(both: Samples) -> np.ndarray:
        x, y = ({task: both[f"{side}/{task}"] for task in tasks} for side in sides)
        return probability_of_improvement(x, y)

    return stratified_bootstrap(joint, statistic, seed=seed, replicates=replicates)


def performance_profile(
    samples: Samples,
    thresholds: np.ndarray,
    *,
    seed: int = 0,
    replicates: int = REPLICATES,
    level: float = LEVEL,
) -> pd.DataFrame:
    """Share of runs whose normalised score exceeds each threshold, tasks weighted equally.

    Returns columns threshold, mean, low, high (pointwise stratified bootstrap band; nan where a
    task has fewer than `FEWEST_RUNS`).
    """
    few = min((len(values) for values in samples.values()), default=0) < FEWEST_RUNS
    draws = _resample(samples, np.random.default_rng(seed), replicates)
    rows = []
    for threshold in thresholds:
        share, band = (
            np.mean([(np.asarray(v) > threshold).mean(-1) for v in drawn.values()], axis=0)
            for drawn in (samples, draws)
        )
        limits = np.quantile(band, [(1 - level) / 2, (1 + level) / 2])
        rows.append((threshold, share, *((np.nan, np.nan) if few else limits)))
    return pd.DataFrame(rows, columns=["threshold", "mean", "low", "high"])


# --- from the tidy table -------------------------------------------------------------------------


def final_scores(progress: pd.DataFrame, share: float = FINAL_SHARE) -> pd.DataFrame:
    """Final performance of each run: the mean over the last `share` of its evaluations (>= 1).

    An evaluation is a step at which `eval_return` has a value; the window is the same for every
    metric. Returns a score table (task, variant, seed, metric, value) of all metrics that have a
    value inside the window.
    """
    keys = ["task", "variant", "seed"]
    rows = progress.dropna(subset=["value"])
    evaluations = rows.loc[rows["metric"] == "eval_return", [*keys, "step"]]
    starts = (
        evaluations.sort_values("step")
        .groupby(keys, sort=False)["step"]
        .agg(lambda steps: steps.iloc[-max(1, int(np.floor(share * len(steps)))) :].iloc[0])
        .rename("window_start")
        .reset_index()
    )
    window = rows.merge(starts, on=keys)
    window = window[window["step"] >= window["window_start"]]
    return window.groupby([*keys, "metric"])["value"].mean().reset_index()


def last_values(progress: pd.DataFrame, metrics: Sequence[str]) -> pd.DataFrame:
    """Score table of the last logged value of each metric of each run."""
    rows = progress[progress["metric"].isin(list(metrics))].dropna(subset=["value"])
    keys = ["task", "variant", "seed", "metric"]
    return rows.sort_values("step").groupby(keys, sort=False)["value"].last().reset_index()


def training_violations(progress: pd.DataFrame) -> pd.DataFrame:
    """Score table of ``train_violations``: violating steps of all episodes that training finished.

    A row of the log has the mean over the episodes finished since the last; the sum is exact.
    """
    keys = ["task", "variant", "seed"]
    wide = progress[progress["metric"].isin(["train_cost_indicator", "train_episodes"])]
    wide = wide.pivot_table(index=[*keys, "step"], columns="metric", values="value")
    wide = wide.reindex(columns=["train_cost_indicator", "train_episodes"]).dropna()
    total = (wide["train_cost_indicator"] * wide["train_episodes"]).groupby(level=keys).sum()
    return total.round().rename("value").reset_index().assign(metric="train_violations")


def settling_share(steps: np.ndarray, values: np.ndarray, band: float = 0.1) -> float:
    """Share of training after which a curve stays within `band` of its range of its final value.

    0 for a constant curve, near 1 for one that still moves at the end; `steps` [T] ascending.
    """
    span = float(np.ptp(values))
    outside = np.flatnonzero(np.abs(values - values[-1]) > band * span)
    return 0.0 if not len(outside) else float(steps[outside[-1] + 1] / steps[-1])


def scores_of(scores: pd.DataFrame, task: str, variant: str, metric: str) -> np.ndarray:
    """[seeds] values of one metric in seed order; empty where there are no such runs."""
    chosen = scores[
        (scores["task"] == task) & (scores["variant"] == variant) & (scores["metric"] == metric)
    ]
    return chosen.sort_values("seed")["value"].to_numpy(float)


def score_interval(scores: pd.DataFrame, task: str, variant: str, metric: str) -> Estimate:
    """`mean_interval` of `scores_of`, within the metric's bounds."""
    return mean_interval(scores_of(scores, task, variant, metric), bounds=bounds_of(metric))


def normalised_samples(
    scores: pd.DataFrame, variant: str, metric: str, scale: Mapping[str, float]
) -> dict[str, np.ndarray]:
    """Task -> [seeds] metric divided by the task's entry in `scale` (tasks without one dropped)."""
    samples = {}
    for task, unit in scale.items():
        values = scores_of(scores, task, variant, metric)
        if len(values):
            samples[task] = values / unit
    return samples


class Aggregates(NamedTuple):
    """Over several tasks, by variant: performance profile, IQM, P(method > variant)."""

    profiles: dict[str, pd.DataFrame]
    iqm: dict[str, Estimate]
    improvement: dict[str, Estimate]


def aggregate(
    scores: pd.DataFrame,
    variants: Sequence[str],
    method: str,
    scale: Mapping[str, float],
    thresholds: np.ndarray,
    *,
    metric: str = "eval_return",
    seed: int = 0,
) -> Aggregates:
    """Profiles, IQM and probability of improvement of `metric` normalised by the task's `scale`.

    Only variants with runs on every task of `scale` take part: aggregates over different tasks
    cannot be compared.
    """
    samples = {v: normalised_samples(scores, v, metric, scale) for v in variants}
    samples = {v: s for v, s in samples.items() if len(s) == len(scale)}
    rivals = [v for v in samples if v != method] if method in samples else []
    return Aggregates(
        {v: performance_profile(s, thresholds, seed=seed) for v, s in samples.items()},
        {v: stratified_bootstrap(s, pooled_iqm, seed=seed) for v, s in samples.items()},
        {v: improvement_probability(samples[method], samples[v], seed=seed) for v in rivals},
    )


def summarise(scores: pd.DataFrame, *, seed: int = 0) -> pd.DataFrame:
    """One row per (task, variant, metric): mean, low, high (t), iqm, iqm_low, iqm_high, count."""
    rows = []
    for (task, variant, metric), group in scores.groupby(["task", "variant", "metric"], sort=False):
        values = group["value"].to_numpy(float)
        interval = mean_interval(values, bounds=bounds_of(str(metric)))
        iqm = stratified_bootstrap({"task": values}, pooled_iqm, seed=seed)
        rows.append((task, variant, metric, *interval[:3], *iqm[:3], interval.size))
    columns = ["task", "variant", "metric", "mean", "low", "high",
               "iqm", "iqm_low", "iqm_high", "count"]  # fmt: skip
    return pd.DataFrame(rows, columns=columns)


def learning_curves(progress: pd.DataFrame, metric: str, *, window: int = 1) -> pd.DataFrame:
    """Mean over seeds and its t interval: task, variant, step, mean, low, high, count.

    Runs may log at slightly different steps: each is interpolated linearly onto the steps of the
    shortest log of its (task, variant), and contributes only inside its own range. `window` is the
    length of a trailing moving average (in log points) applied to each run first.
    """
    rows = []
    chosen = progress[(progress["metric"] == metric)].dropna(subset=["value"])
    for (task, variant), group in chosen.groupby(["task", "variant"], sort=False):
        runs = [run.sort_values("step") for _, run in group.groupby("seed")]
        grid = min(runs, key=len)["step"].to_numpy(float)
        values = np.full((len(runs), len(grid)), np.nan)
        for index, run in enumerate(runs):
            steps = run["step"].to_numpy(float)
            smooth = run["value"].rolling(window, min_periods=1).mean().to_numpy(float)
            inside = (grid >= steps[0]) & (grid <= steps[-1])
            values[index, inside] = np.interp(grid[inside], steps, smooth)
        for step, column in zip(grid, values.T, strict=True):
            if not np.isnan(column).all():
                interval = mean_interval(column, bounds=bounds_of(metric))
                rows.append((task, variant, int(step), *interval))
    return pd.DataFrame(rows, columns=["task", "variant", "step", "mean", "low", "high", "count"])


def core_minutes(progress: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Processor minutes that a run had taken at each logged step, averaged over seeds.

    The log holds wall time; a run's processor time is spread over it evenly, so that a busy machine
    does not make an algorithm look slow. A run by several processes logs its workers' time, which
    comes to its own. runs: the runs table with wall_s and cpu_s. Returns task, variant, step,
    minutes; runs whose records do not say both times, or log none, have no part.
    """
    keys = ["task", "variant", "seed"]
    timed = runs[(runs["cpu_s"] > 0) & (runs["wall_s"] > 0)]
    clock = progress[progress["metric"] == "time_wall_s"].merge(
        timed.assign(busy=timed["cpu_s"] / timed["wall_s"])[[*keys, "busy"]], on=keys
    )
    workers = progress[progress["metric"] == "workers_cpu_s"]
    workers = workers.rename(columns={"value": "workers_s"})[[*keys, "step", "workers_s"]]
    clock = clock.merge(workers, on=[*keys, "step"], how="left").fillna({"workers_s": 0.0})
    clock["minutes"] = (clock["value"] * clock["busy"] + clock["workers_s"]) / 60
    return clock.groupby(["task", "variant", "step"], sort=False)["minutes"].mean().reset_index()


def missing_runs(expected: pd.DataFrame, runs: pd.DataFrame) -> pd.DataFrame:
    """Rows (task, variant, seed) of `expected` that `runs` lacks, in the order expected."""
    keys = ["task", "variant", "seed"]
    expected = expected.drop_duplicates(keys)
    present = set(runs[keys].itertuples(index=False, name=None))
    absent = [row not in present for row in expected[keys].itertuples(index=False, name=None)]
    return expected.loc[absent, keys].reset_index(drop=True)


def _finite(values: np.ndarray) -> np.ndarray:
    sample = np.asarray(values, dtype=float)
    return sample[~np.isnan(sample)]


def _variance_of_mean(sample: np.ndarray) -> float:
    if sample.min() == sample.max():  # whose deviation is rounding
        return 0.0
    return float(sample.var(ddof=1) / len(sample))


def _welch_t(x: np.ndarray, y: np.ndarray, ratio: float, level: float) -> float:
    """Student quantile with Welch-Satterthwaite freedom of mean(x) - ratio mean(y)."""
    v1, v2 = _variance_of_mean(x), ratio**2 * _variance_of_mean(y)
    if v1 + v2 == 0:
        return 0.0
    freedom = (v1 + v2) ** 2 / (v1**2 / (len(x) - 1) + v2**2 / (len(y) - 1))
    return float(stdtrit(freedom, (1 + level) / 2))


def _resample(
    samples: Samples, generator: np.random.Generator, replicates: int
) -> dict[str, np.ndarray]:
    return {
        task: np.asarray(values)[generator.integers(len(values), size=(replicates, len(values)))]
        for task, values in samples.items()
    }
