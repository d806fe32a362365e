"""The second protocol: intervals of rates, labels, verdicts, and what its choices are shown by."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from sample_scores import TASK
from scipy.stats import beta, t

from safemr import paper
from safemr.conventions import own_layouts
from safemr.errors import UserError
from safemr.experiment import config
from safemr.report import claims, power, second_protocol, sensitivity_of_protocol, tables
from safemr.report.findings import Evidence
from safemr.report.second_protocol import RateRule, rate_interval

EPISODES = 100
RULE = RateRule(1.0, 0.95)


def flown(dirty: dict[str, list[int]], returns: dict[str, list[float]]) -> pd.DataFrame:
    """Flights on TASK: counts of violating episodes and returns of each variant's seeds."""
    rows = [
        (TASK, variant, seed, metric, value)
        for variant, counts in dirty.items()
        for seed, count in enumerate(counts)
        for metric, value in (
            ("eval_zero_violation_share", 1 - count / EPISODES),
            ("eval_cost_indicator", 5.0 * count / EPISODES),
            ("eval_episodes", float(EPISODES)),
            ("eval_return", returns[variant][seed]),
        )
    ]
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"])


CLEAN, DIRTY, OPEN = [0] * 5, [20, 30, 25, 22, 28], [2, 3, 12, 4, 6]
SPREAD = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])


def grid(**changes: tuple[list[int], float]) -> pd.DataFrame:
    """SafeMR clean at 20; JointSIS, FAC-phih clean at 15; the others violate and return 25."""
    parts = {"SafeMR": (CLEAN, 20.0), "JointSIS": (CLEAN, 15.0), "FAC-phih": (CLEAN, 14.0)}
    parts |= dict.fromkeys((*paper.CMDP_BASELINES, "FAC-phi0"), (DIRTY, 25.0))
    parts |= {name.replace("_", "-"): change for name, change in changes.items()}
    return flown(
        {name: dirty for name, (dirty, _) in parts.items()},
        {name: list(mean + SPREAD) for name, (_, mean) in parts.items()},
    )


def finding(name: str, scores: pd.DataFrame):  # type: ignore[no-untyped-def]
    empty = pd.DataFrame(columns=["task", "variant", "seed", "step", "metric", "value"])
    evidence = Evidence(scores, empty, tasks=(TASK,), rule=RULE)
    (claim,) = [claim for claim in claims.claims((TASK,), protocol=2) if claim.name == name]
    return claim.judge(evidence)


# --- the interval of a rate ----------------------------------------------------------------------


def test_without_events_the_interval_is_clopper_and_pearsons_charged_for_few_runs():
    found = rate_interval(np.zeros(5), np.full(5, 100.0))
    effective = 500 * (t.ppf(0.975, 499) / t.ppf(0.975, 4)) ** 2
    assert found[:2] == (0.0, 0.0)
    assert found.high == pytest.approx(1 - 0.025 ** (1 / effective))


def test_runs_that_scatter_less_than_chance_count_as_all_of_their_episodes():
    found = rate_interval(np.full(4, 0.1), np.full(4, 50.0))
    effective = 200 * (t.ppf(0.975, 199) / t.ppf(0.975, 3)) ** 2
    seen = 0.1 * effective
    assert found.low == pytest.approx(beta.ppf(0.025, seen, effective - seen + 1))
    assert found.high == pytest.approx(beta.ppf(0.975, seen + 1, effective - seen))


def test_runs_that_disagree_count_as_fewer_episodes():
    agreeing = rate_interval(np.array([0.19, 0.2, 0.21, 0.2]), np.full(4, 100.0))
    scattered = rate_interval(np.array([0.0, 0.4, 0.0, 0.4]), np.full(4, 100.0))
    assert scattered.mean == pytest.approx(agreeing.mean)
    assert scattered.low < agreeing.low < agreeing.high < scattered.high


@given(st.lists(st.integers(0, 50), min_size=3, max_size=12))
def test_the_interval_holds_the_rate_and_stays_within_its_bounds(counts):
    found = rate_interval(np.array(counts) / 50, np.full(len(counts), 50.0))
    assert 0 <= found.low <= found.mean <= found.high <= 1
    mirrored = rate_interval(1 - np.array(counts) / 50, np.full(len(counts), 50.0))
    assert mirrored.low == pytest.approx(1 - found.high, abs=1e-9)


def test_the_interval_covers_rates_of_runs_that_differ():
    generator = np.random.default_rng(1)
    rate, weight = 0.1, 9.0  # beta-binomial with a correlation of 0.1
    covered = 0
    for _ in range(400):
        runs = generator.beta(rate * weight, (1 - rate) * weight, 10)
        seen = generator.binomial(EPISODES, runs) / EPISODES
        found = rate_interval(seen, np.full(10, float(EPISODES)))
        covered += found.low <= rate <= found.high
    assert covered >= 0.93 * 400  # the naive one, of 1,000 independent episodes, covers 0.47


def test_two_runs_have_no_interval():
    assert np.isnan(rate_interval(np.zeros(2), np.full(2, 100.0)).high)


# --- labels and verdicts -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dirty", "label"),
    [(CLEAN, "yes"), (DIRTY, "no"), (OPEN, "not decided"), ([0, 0], "not decided"),
     ([0, 0, 0], "not decided")],
)  # fmt: skip
def test_a_label_is_the_intervals(dirty, label):
    scores = flown({"v": dirty}, {"v": [1.0] * len(dirty)})
    assert RULE.label(scores, TASK, "v") == label
    assert RULE.is_safe(scores, TASK, "v") == (label == "yes")
    assert RULE.label(scores, TASK, "other") is None


@pytest.mark.parametrize(
    ("dirty", "said"), [(DIRTY, "none is safe"), (OPEN, "none is shown to be safe")]
)
def test_table_one_tells_unsafe_baselines_from_undecided_ones(dirty, said):
    scores = grid(JointSIS=(dirty, 15.0), FAC_phih=(DIRTY, 14.0))
    display = tables.table_one(scores, tasks=[TASK], rule=RULE).display
    rows = dict(zip(display["Expected return"], display[TASK], strict=True))
    assert rows["Highest among safe baselines"] == said


def test_single_runs_are_judged_by_their_clean_episodes_alone():
    scores = grid(SafeMR=([0, 5, 6, 0, 0], 20.0))
    lost = RULE.safe_returns(scores)
    ours = lost[(lost["variant"] == "SafeMR") & (lost["metric"] == "eval_return")]
    assert list(ours["value"] == 0) == [False, False, True, False, False]


PRIMARY = f"highest_return[{TASK}]"


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, "confirmed"),
        ({"JointSIS": (CLEAN, 20.0)}, "inconclusive"),
        ({"JointSIS": (CLEAN, 25.0)}, "refuted"),
        ({"SafeMR": (DIRTY, 20.0)}, "refuted"),
        ({"SafeMR": (OPEN, 20.0)}, "inconclusive"),
        ({"CPO": (OPEN, 25.0)}, "inconclusive"),  # may be safe, and returns more
        ({"CPO": (OPEN, 15.0)}, "confirmed"),  # may be safe, and returns less
        ({"CPO": (DIRTY, 25.0)}, "confirmed"),
    ],
)
def test_the_primary_claim(changes, verdict):
    assert finding(PRIMARY, grid(**changes)).verdict == verdict


def test_the_primary_claim_is_corrected_for_its_four_tasks():
    scores = grid(JointSIS=(CLEAN, 17.7))
    gap = finding(PRIMARY, scores).estimate
    half = t.ppf(1 - 0.0125 / 2, 8) * np.sqrt(2 * SPREAD.var(ddof=1) / 5)
    assert gap.low == pytest.approx(2.3 - half)


@pytest.mark.parametrize(
    ("name", "changes", "verdict"),
    [
        ("unsafe[CPO]", {}, "confirmed"),
        ("unsafe[CPO]", {"CPO": (OPEN, 25.0)}, "inconclusive"),
        ("unsafe[CPO]", {"CPO": (CLEAN, 25.0)}, "refuted"),
        ("zero_violations", {}, "confirmed"),
        ("zero_violations", {"SafeMR": ([0, 0, 0, 0, 1], 20.0)}, "refuted"),
        ("safe_but_lower[JointSIS]", {}, "confirmed"),
        ("safe_but_lower[JointSIS]", {"JointSIS": (OPEN, 15.0)}, "inconclusive"),
        ("safe_but_lower[JointSIS]", {"JointSIS": (DIRTY, 15.0)}, "refuted"),
        ("safe_but_lower[FAC-phih]", {"FAC_phih": (DIRTY, 15.0)}, "refuted"),
        ("slowest_certificate", {}, "not testable"),
    ],
)
def test_verdicts(name, changes, verdict):
    assert finding(name, grid(**changes)).verdict == verdict


def test_every_claim_of_the_first_protocol_is_one_of_the_second():
    first, second = (claims.claims(protocol=protocol) for protocol in (1, 2))
    assert [claim.name for claim in first] == [claim.name for claim in second]
    other = {a.name for a, b in zip(first, second, strict=True) if a.judge is not b.judge}
    assert {PRIMARY, "unsafe[PPO-L]", "sensitivity_cost"} <= other
    with pytest.raises(TypeError, match="RateRule"):
        second[3].judge(Evidence(grid(), pd.DataFrame(), tasks=(TASK,), rule=tables.SafetyRule()))


def test_what_flights_decide_is_not_shown_by_curves_of_evaluations():
    for claim in claims.claims(protocol=2):
        if "flown" in claim.measure or "unseen" in claim.measure:
            assert claim.figure != "training_curves", claim.name


DRAWN = {
    path.stem: Path(yaml.safe_load(path.read_text())["results_root"]) / "tables/differences.md"
    for path in sorted(Path("config").glob("*.yaml"))
}
DRAWN = {name: table for name, table in DRAWN.items() if table.exists()}


@pytest.mark.parametrize("name", DRAWN)
def test_recorded_differences_say_what_was_compared(name):
    loaded = config.load(["config/config.yaml", f"config/{name}.yaml"])
    table = DRAWN[name]
    (caption, _) = table.read_text().split("\n", 1)
    assert ("unseen layouts" in caption) == (loaded.protocol == 2)
    assert ("final evaluations" in caption) == (loaded.protocol == 1)


def test_points_are_safe_by_their_rates():
    scores = grid()
    points = {"SafeMR": (0.35, 0.15), "CPO": (0.45, 0.15), "FAC-phi0": (0.35, 0.25)}
    empty = pd.DataFrame(columns=["task", "variant", "seed", "step", "metric", "value"])
    evidence = Evidence(scores, empty, tasks=(TASK,), rule=RULE, points=points)
    assert second_protocol.points_are_safe(evidence).verdict == "refuted"
    clean = replace(evidence, scores=grid(CPO=(CLEAN, 9.0), FAC_phi0=(CLEAN, 9.0)))
    assert second_protocol.points_are_safe(clean).verdict == "confirmed"


# --- what is judged ------------------------------------------------------------------------------


def test_flights_replace_evaluations_and_runs_that_were_not_flown_are_missing():
    flights = flown({"SafeMR": [0, 0]}, {"SafeMR": [20.0, 21.0]})
    logged = pd.DataFrame(
        [(TASK, "SafeMR", 0, "eval_return", 9.0), (TASK, "SafeMR", 0, "train_violations", 7.0),
         (TASK, "CPO", 0, "train_violations", 8.0), (TASK, "CPO", 0, "eval_return", 8.0)],
        columns=flights.columns,
    )  # fmt: skip
    judged = second_protocol.judged_scores(logged, flights)
    assert set(judged["variant"]) == {"SafeMR"}
    assert judged.loc[judged["metric"] == "train_violations", "value"].tolist() == [7.0]
    assert judged.loc[judged["metric"] == "eval_return", "value"].tolist() == [20.0, 21.0]


def test_no_two_seeds_share_a_layout():
    flights = [
        range(own_layouts(20_000, 100, s), own_layouts(20_000, 100, s + 1)) for s in range(9)
    ]
    assert len(set().union(*flights)) == 900
    assert flights[0][0] == 20_000


def test_the_second_protocol_needs_flights_and_layouts_need_numbers():
    with pytest.raises(UserError, match="judges flights on unseen layouts"):
        config.load(["config/config.yaml"], {"protocol": 2, "unseen_layouts": {}})
    with pytest.raises(UserError, match="would fly layouts up to"):
        config.load(
            ["config/config.yaml"],
            {"seeds": [100_000_000], "unseen_layouts": {"episodes": 100, "own": True}},
        )


def log(variant: str, steps: list[int], **metrics: list[float]) -> pd.DataFrame:
    rows = [
        (TASK, variant, 0, step, metric, value)
        for metric, values in metrics.items()
        for step, value in zip(steps, values, strict=True)
    ]
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "step", "metric", "value"])


def test_windows_average_the_last_evaluations():
    progress = pd.concat(
        [log("SafeMR", [1, 2, 3, 4], eval_return=[1.0, 2.0, 3.0, 6.0]),
         log("JointSIS", [1, 2, 3, 4], eval_return=[0.0, 0.0, 0.0, 1.0])]
    )  # fmt: skip
    flights = flown({"SafeMR": [0], "JointSIS": [0]}, {"SafeMR": [9.0], "JointSIS": [7.0]})
    data = sensitivity_of_protocol.windows(
        progress, flights, [TASK], "SafeMR", ["JointSIS"]
    ).data.set_index("final")["difference"]
    assert data["last 1"] == 5.0
    assert data["last 2"] == 4.0
    assert data["last 4"] == data["last 8"] == 2.75
    assert data["flown"] == 2.0


def test_violations_of_training_are_counted_to_the_end_of_the_shorter_family():
    progress = pd.concat(
        [log("SafeMR", [1000, 2000], train_cost_indicator=[3.0, 0.0], train_episodes=[1.0, 1.0]),
         log("CPO", [1500, 3000, 4500], train_cost_indicator=[2.0, 2.0, 1.0],
             train_episodes=[3.0, 3.0, 3.0])]
    )  # fmt: skip
    data = sensitivity_of_protocol.training_violations(progress).data.set_index("variant")
    assert data.loc["SafeMR", "violations"] == data.loc["SafeMR", "whole_violations"] == 3
    assert data.loc["CPO", "violations"] == pytest.approx(6 + 6 * 500 / 1500)
    assert data.loc["CPO", "whole_violations"] == 15


# --- power ---------------------------------------------------------------------------------------


def test_power_is_the_known_one_of_two_samples():
    # Two-sided 5% t test, 17 in each group, a difference of one standard deviation: 0.807.
    assert power.detection_power(1.0, 17, 0.95) == pytest.approx(0.807, abs=0.02)
    assert power.detection_power(0.0, 10, 0.95) == pytest.approx(0.025, abs=0.01)
    assert power.smallest_seen(17, 0.95) == pytest.approx(0.99, abs=0.05)
    assert power.seeds_to_see(1.0, 0.95) in (16, 17, 18)  # textbooks: 17
    assert power.seeds_to_see(100.0, 0.95) == 2
    assert power.seeds_to_see(0.0, 0.95) is None


def test_what_is_seen_scales_with_the_spread():
    table = power.of_returns(grid(), [TASK], "SafeMR", ["JointSIS", "FAC-phih"]).data
    assert table["pooled_sd"].to_numpy() == pytest.approx(SPREAD.std(ddof=1))
    unit = power.smallest_seen(5, second_protocol.PRIMARY_LEVEL)
    assert table["smallest_5"].to_numpy() == pytest.approx(unit * SPREAD.std(ddof=1))
    assert (table["smallest_10"] < table["smallest_5"]).all()


def test_labels_follow_the_true_rate():
    data = power.of_safety(grid(), [TASK], RULE).data.set_index(["rate", "seeds"])
    assert data.loc[(0.0, 5), "safe"] == 1.0
    assert data.loc[(0.2, 10), "not_safe"] > 0.9
    assert data.loc[(0.05, 10), ["safe", "not_safe"]].max() < 0.1  # at the limit: open
    assert (data[["safe", "not_decided", "not_safe"]].sum(axis=1) - 1).abs().max() < 1e-12
