"""Statistics against closed forms, scipy, and simulated coverage."""

from __future__ import annotations

import itertools

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from safemr.errors import UserError
from safemr.report import statistics

FIVE = np.array([17.3, 15.9, 16.8, 19.1, 14.2])
OTHER = np.array([12.1, 13.5, 11.0, 12.9, 14.4])


def tidy(values: dict[tuple[str, str, int], list[float]], metric: str = "eval_return"):
    """A tidy table with one row per list entry, logged at steps 10, 20, ..."""
    rows = [
        (task, variant, seed, 10 * (index + 1), metric, value)
        for (task, variant, seed), series in values.items()
        for index, value in enumerate(series)
    ]
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "step", "metric", "value"])


def test_mean_interval_is_the_one_sample_t_interval():
    interval = stats.ttest_1samp(FIVE, 0.0).confidence_interval(0.95)
    estimate = statistics.mean_interval(np.append(FIVE, np.nan))
    assert estimate.size == 5
    np.testing.assert_allclose(estimate[:3], (FIVE.mean(), interval.low, interval.high), rtol=1e-12)


def test_mean_interval_of_three_runs_by_hand():
    # t(2) at a two-sided level L is L sqrt(2 / (1 - L^2)); s = 1
    estimate = statistics.mean_interval(np.array([1.0, 2.0, 3.0]))
    assert estimate.half_width == pytest.approx(0.95 * np.sqrt(2 / (1 - 0.95**2)) / np.sqrt(3))


def test_an_interval_ends_at_the_bounds_of_its_quantity():
    shares = np.array([1.0, 1.0, 0.9])
    free = statistics.mean_interval(shares)
    kept = statistics.mean_interval(
        shares, bounds=statistics.bounds_of("eval_zero_violation_share")
    )
    assert free.high > 1
    assert kept == (free.mean, free.low, 1.0, 3)
    costs = np.array([0.0, 0.0, 3.0])
    assert statistics.mean_interval(costs).low < 0
    for metric in ("eval_cost", "train_cost_indicator", "train_violations", "eval_goals"):
        assert statistics.mean_interval(costs, bounds=statistics.bounds_of(metric)).low == 0
    assert statistics.bounds_of("eval_return") == statistics.UNBOUNDED


@pytest.mark.parametrize("metric", ["eval_cost", "eval_zero_violation_share"])
def test_tables_and_curves_use_the_bounds(metric):
    values = {("t", "A", seed): [value] for seed, value in enumerate((0.0, 0.0, 1.0))}
    progress = tidy(values, metric=metric)
    scores = progress.drop(columns="step")
    for table in (statistics.summarise(scores), statistics.learning_curves(progress, metric)):
        assert table["low"].iloc[0] == 0
        assert table["high"].iloc[0] == (
            1.0 if "share" in metric else pytest.approx(1.768, abs=1e-3)
        )


def test_equal_runs_have_exactly_no_width_whatever_the_rounding_of_their_mean():
    estimate = statistics.mean_interval(np.full(7, 0.1))
    assert estimate.low == estimate.high == 0.1


@pytest.mark.parametrize(
    ("values", "count"), [([], 0), ([3.0], 1), ([np.nan], 0), ([3.0, 4.0], 2), ([3.0, 3.0], 2)]
)
def test_too_few_runs_have_no_interval(values, count):
    estimate = statistics.mean_interval(np.array(values))
    assert estimate.size == count
    assert np.isnan(estimate.low)
    assert np.isnan(estimate.high)


def test_difference_interval_is_welch():
    reference = stats.ttest_ind(FIVE, OTHER, equal_var=False).confidence_interval(0.95)
    estimate = statistics.difference_interval(FIVE, OTHER)
    np.testing.assert_allclose(estimate[1:3], (reference.low, reference.high), rtol=1e-10)


def test_improvement_limits_solve_fiellers_equation():
    estimate = statistics.improvement_interval(FIVE, OTHER)
    assert estimate.mean == pytest.approx(FIVE.mean() / OTHER.mean() - 1)
    v1, v2 = FIVE.var(ddof=1) / 5, OTHER.var(ddof=1) / 5
    ratio = FIVE.mean() / OTHER.mean()
    freedom = (v1 + ratio**2 * v2) ** 2 / (v1**2 / 4 + (ratio**2 * v2) ** 2 / 4)
    for limit in (estimate.low + 1, estimate.high + 1):
        z = (FIVE.mean() - limit * OTHER.mean()) / np.sqrt(v1 + limit**2 * v2)
        assert abs(z) == pytest.approx(stats.t.ppf(0.975, freedom), rel=1e-9)


def test_improvement_covers_the_true_ratio_at_its_nominal_rate():
    generator = np.random.default_rng(5)
    hits = 0
    for _ in range(2000):
        limits = statistics.improvement_interval(
            generator.normal(12, 2, size=5), generator.normal(10, 1, size=5)
        )
        hits += limits.low <= 0.2 <= limits.high
    assert 0.93 <= hits / 2000 <= 0.97


def test_improvement_over_a_baseline_that_may_be_zero_is_unbounded():
    estimate = statistics.improvement_interval(FIVE, np.array([-1.0, 0.5, 1.0, 2.0, -0.5]))
    assert estimate.low == -np.inf
    assert estimate.high == np.inf
    assert np.isnan(statistics.improvement_interval(FIVE, -OTHER).mean)


def test_iqm_drops_a_quarter_on_each_side():
    assert statistics.interquartile_mean(np.arange(8.0)) == pytest.approx((2 + 3 + 4 + 5) / 4)
    assert statistics.interquartile_mean(np.array([0, 1, 2, 3, 1e9])) == pytest.approx(2.0)


def test_stratified_bootstrap_matches_full_enumeration():
    """With 3 seeds in each of 2 tasks all 3^6 resamples can be listed: the exact distribution."""
    samples = {"a": np.array([0.0, 1.0, 5.0]), "b": np.array([10.0, 12.0, 13.0])}

    def statistic(draw):
        return np.mean([values.mean(-1) for values in draw.values()], axis=0)

    exact = [
        (np.mean(a) + np.mean(b)) / 2
        for a in itertools.product(samples["a"], repeat=3)
        for b in itertools.product(samples["b"], repeat=3)
    ]
    low, high = np.quantile(exact, [0.025, 0.975])
    estimate = statistics.stratified_bootstrap(samples, statistic, seed=1, replicates=20_000)
    assert estimate.low == pytest.approx(low, abs=0.1)
    assert estimate.high == pytest.approx(high, abs=0.1)


def test_bootstrap_depends_on_its_seed_alone():
    samples = {"t": np.random.default_rng(0).normal(size=20)}

    def interval(seed):
        return statistics.stratified_bootstrap(samples, statistics.pooled_iqm, seed=seed)

    assert interval(1) == interval(1)
    assert interval(1) != interval(2)


@given(
    st.lists(st.integers(-5, 5), min_size=1, max_size=8),
    st.lists(st.integers(-5, 5), min_size=1, max_size=8),
)
def test_probability_of_improvement_is_mann_whitney(x, y):
    expected = stats.mannwhitneyu(x, y).statistic / (len(x) * len(y))
    first, second = {"t": np.array(x)}, {"t": np.array(y)}
    assert statistics.probability_of_improvement(first, second) == pytest.approx(expected)
    backwards = statistics.probability_of_improvement(second, first)
    assert backwards == pytest.approx(1 - expected)


def test_probability_of_improvement_needs_a_common_task():
    with pytest.raises(UserError, match="no task in common"):
        statistics.probability_of_improvement({"a": FIVE}, {"b": OTHER})


def test_improvement_probability_of_separated_samples_is_certain():
    estimate = statistics.improvement_probability({"a": FIVE + 10}, {"a": OTHER, "b": OTHER})
    assert estimate[:3] == (1.0, 1.0, 1.0)


def test_performance_profile_is_the_survival_function_averaged_over_tasks():
    samples = {"a": np.array([0.2, 0.6, 0.2, 0.6]), "b": np.array([0.5, 0.5, 1.5, 2.0])}
    profile = statistics.performance_profile(
        samples, np.array([0.0, 0.5, 1.0, 3.0]), replicates=200
    )
    np.testing.assert_allclose(profile["mean"], [1.0, 0.5, 0.25, 0.0])
    assert (profile["low"] <= profile["mean"]).all()
    assert (profile["mean"] <= profile["high"]).all()


def test_two_runs_have_no_interval_of_any_kind():
    two, five = np.array([1.0, 2.0]), np.arange(5.0) + 3
    found = [
        statistics.difference_interval(two, five),
        statistics.improvement_interval(five, two),
        statistics.stratified_bootstrap({"t": two, "u": five}, statistics.pooled_iqm),
        statistics.improvement_probability({"t": five}, {"t": two}),
    ]
    assert all(np.isnan([estimate.low, estimate.high]).all() for estimate in found)
    assert [estimate.size for estimate in found] == [2] * 4
    assert not any(np.isnan(estimate.mean) for estimate in found)
    profile = statistics.performance_profile({"t": two}, np.array([1.5]))
    assert profile["mean"].tolist() == [0.5]
    assert profile[["low", "high"]].isna().all(axis=None)


def test_final_scores_average_the_last_tenth_of_the_evaluations():
    progress = tidy({("t", "A", 0): list(range(30)), ("t", "B", 1): [1.0, 2.0]})
    other = tidy({("t", "A", 0): [100.0] * 27 + [0.0, 3.0, 6.0]}, metric="sigma")
    scores = statistics.final_scores(pd.concat([progress, other]))
    assert statistics.scores_of(scores, "t", "A", "eval_return") == pytest.approx([28.0])
    assert statistics.scores_of(scores, "t", "A", "sigma") == pytest.approx([3.0])
    assert statistics.scores_of(scores, "t", "B", "eval_return") == pytest.approx([2.0])
    assert len(statistics.scores_of(scores, "t", "C", "eval_return")) == 0


def test_learning_curves_interpolate_runs_logged_at_different_steps():
    progress = tidy({("t", "A", 0): [1.0, 2.0, 3.0, 4.0], ("t", "A", 1): [3.0, 4.0, 5.0]})
    progress.loc[progress["seed"] == 1, "step"] += 5  # 15, 25, 35
    curves = statistics.learning_curves(progress, "eval_return")
    assert list(curves["step"]) == [15, 25, 35]
    np.testing.assert_allclose(curves["mean"], [2.25, 3.25, 4.25])
    assert set(curves["count"]) == {2}


def test_summary_holds_mean_and_iqm_of_each_metric():
    progress = tidy({("t", "A", seed): [value] for seed, value in enumerate(FIVE)})
    row = statistics.summarise(statistics.final_scores(progress)).iloc[0]
    assert row["mean"] == pytest.approx(FIVE.mean())
    assert row["iqm"] == pytest.approx(np.sort(FIVE)[1:4].mean())
    assert row["iqm_low"] < row["iqm"] < row["iqm_high"]
    assert row["count"] == 5


@pytest.mark.parametrize("rate", [0.05, 0.2, 0.5])
def test_settling_share_of_an_exponential(rate):
    """exp(-t / rate) is within a tenth of its range of its end when exp(-t/rate) does so."""
    time = np.linspace(0.0, 1.0, 2001)
    end = np.exp(-1 / rate)
    exact = -rate * np.log(end + 0.1 * (1 - end))
    assert statistics.settling_share(time, np.exp(-time / rate)) == pytest.approx(exact, abs=1e-3)
    assert statistics.settling_share(time, np.full(2001, 3.0)) == 0.0


def test_aggregates_leave_out_variants_that_lack_a_task():
    rows = [("t", "A", 0, 1.0), ("t", "A", 1, 2.0), ("u", "A", 0, 3.0), ("u", "A", 1, 5.0),
            ("t", "B", 0, 0.5), ("t", "B", 1, 1.5), ("u", "B", 0, 1.0), ("u", "B", 1, 1.0),
            ("t", "C", 0, 9.0)]  # fmt: skip
    scores = pd.DataFrame(rows, columns=["task", "variant", "seed", "value"])
    scores = scores.assign(metric="eval_return")
    result = statistics.aggregate(scores, "ABC", "A", {"t": 1.0, "u": 2.0}, np.array([0.75]))
    assert list(result.profiles) == list(result.iqm) == ["A", "B"]
    assert result.profiles["B"]["mean"].tolist() == [0.25]
    # on t: A > B in 3 of 4 pairs; on u: in all
    assert result.improvement["B"].mean == pytest.approx((0.75 + 1.0) / 2)


def test_core_minutes_scale_wall_time_by_the_share_of_a_processor():
    wall = {("T", "A", 0): [60.0, 120.0], ("T", "A", 1): [60.0, 240.0]}
    runs = pd.DataFrame(
        {"task": "T", "variant": "A", "seed": [0, 1], "wall_s": [120.0, 240.0],
         "cpu_s": [120.0, 120.0]}
    )  # fmt: skip
    found = statistics.core_minutes(tidy(wall, "time_wall_s"), runs)
    # seed 1 had half a processor
    np.testing.assert_allclose(found["minutes"], [(1 + 0.5) / 2, (2 + 2) / 2])
    assert found["step"].tolist() == [10, 20]
    # what the workers of a run by several processes took comes to it
    logged = [tidy(wall, "time_wall_s"), tidy({("T", "A", 1): [30.0, 60.0]}, "workers_cpu_s")]
    found = statistics.core_minutes(pd.concat(logged), runs)
    np.testing.assert_allclose(found["minutes"], [(1 + 1) / 2, (2 + 3) / 2])


def test_missing_runs_are_listed_in_the_expected_order():
    expected = pd.DataFrame(
        [("t", "A", 0), ("t", "A", 1), ("u", "B", 0)], columns=["task", "variant", "seed"]
    )
    missing = statistics.missing_runs(expected, expected.iloc[[1]])
    assert list(missing.itertuples(index=False, name=None)) == [("t", "A", 0), ("u", "B", 0)]


def test_a_run_expected_twice_is_missing_once():
    expected = pd.DataFrame({"task": "t", "variant": "v", "seed": [1, 2, 1]})
    missing = statistics.missing_runs(expected, expected.iloc[:0])
    assert missing["seed"].tolist() == [1, 2]


def test_violations_of_training_are_summed_over_episodes():
    log = {100: (2, 0.5), 200: (0, np.nan), 300: (4, 2.25)}  # step: episodes, mean violating steps
    progress = pd.DataFrame(
        [("t", "v", 0, step, metric, value)
         for step, values in log.items()
         for metric, value in zip(("train_episodes", "train_cost_indicator"), values, strict=True)],
        columns=["task", "variant", "seed", "step", "metric", "value"],
    )  # fmt: skip
    (total,) = statistics.training_violations(progress).to_dict("records")
    assert total == {
        "task": "t", "variant": "v", "seed": 0, "metric": "train_violations", "value": 10.0
    }  # fmt: skip


def test_linear_effects_are_those_of_simple_regression_where_factors_are_orthogonal():
    generator = np.random.default_rng(0)
    x = np.repeat([0.0, 1.0, 2.0, 3.0], 5)
    y = 2 * x + generator.normal(size=x.size)
    (slope,) = statistics.linear_effects(x[:, None], y)
    expected = stats.linregress(x, y)
    assert slope.mean == pytest.approx(expected.slope)
    half = stats.t.ppf(0.975, x.size - 2) * expected.stderr
    assert slope.half_width == pytest.approx(half)


@pytest.mark.parametrize("factors", [np.ones((5, 1)), np.arange(2.0)[:, None], np.zeros((0, 2))])
def test_linear_effects_need_factors_that_vary_and_runs(factors):
    found = statistics.linear_effects(factors, np.zeros(len(factors)))
    assert len(found) == factors.shape[1]
    assert all(np.isnan(effect.mean) for effect in found)


@pytest.mark.parametrize("values", [(0.7, 0.1), (0.75, 0.25)])  # exact in binary, and not
def test_equal_runs_differ_by_no_more_than_rounding_says(values: tuple[float, float]) -> None:
    first, second = ([value] * count for value, count in zip(values, (6, 3), strict=True))
    gap = statistics.difference_interval(np.array(first), np.array(second))
    assert gap.low == gap.mean == gap.high
