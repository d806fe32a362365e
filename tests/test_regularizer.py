"""Whether the regularizer or the size explains a difference: a fit whose truth is known."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from safemr.report import regularizer
from safemr.report.figures.regularizer import at_equal_size
from safemr.report.statistics import Estimate

AREAS = {
    **{"SafeMR": 1.0, "SafeMR-literal": 0.9, "SafeMR-released": 1.1, "SafeMR-guarded": 0.6},
    **{"JointSIS": 1.3, "JointSIS-literal": 1.0, "FAC-phih": 1.4, "FAC-oracle": 0.5},
}


def runs(added: float, noise: float = 0.0, seed: int = 0, seeds: int = 5) -> pd.DataFrame:
    """Returns 30 - 9 A - A^2, and ``added`` where [a, b] are in the loss; phi_0 apart from that."""
    random = np.random.default_rng(seed)
    rows = [
        ("T", variant, number, 1.0, area + 0.01 * number, variant.startswith("SafeMR"))
        for variant, area in AREAS.items()
        for number in range(seeds)
    ]
    points = pd.DataFrame(rows, columns=["task", "variant", "seed", "k", "area", "regularized"])
    points["return"] = (
        30 - 9 * points["area"] - points["area"] ** 2 + added * points["regularized"]
    ) + noise * random.normal(size=len(points))
    phi_0 = points.head(1).assign(variant="FAC-phi0", k=0.0, area=0.0, **{"return": 500.0})
    return pd.concat([points, phi_0], ignore_index=True)


@pytest.mark.parametrize("added", [0.0, 1.5, -2.0])
def test_what_is_added_at_equal_size_is_found(added: float) -> None:
    found = regularizer.at_equal_size(runs(added).query("k > 0"))
    assert found.mean == pytest.approx(added, abs=1e-8)


@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_the_interval_covers_the_truth(spread: float) -> None:
    """Also where certificates of equal area do not return alike: ``spread`` between them."""
    covered, random = 0, np.random.default_rng(1)
    for seed in range(400):
        points = runs(0.7, noise=1.0, seed=seed).query("k > 0")
        own = dict(zip(AREAS, spread * random.normal(size=len(AREAS)), strict=True))
        points = points.assign(**{"return": points["return"] + points["variant"].map(own)})
        found = regularizer.at_equal_size(points)
        covered += found.low <= 0.7 <= found.high
    assert covered / 400 == pytest.approx(0.95, abs=0.03)


def test_the_pair_is_the_papers_where_both_were_flown() -> None:
    both = runs(0.0)
    assert regularizer.pair(both, "Mine", "Mine-without") == ("SafeMR", "JointSIS")
    without = both[both["variant"] != "JointSIS"]
    assert regularizer.pair(without, "SafeMR", "JointSIS-literal") == ("SafeMR", "JointSIS-literal")


GAP, NAN = Estimate(3.0, 1.0, 5.0, 5), float("nan")


@pytest.mark.parametrize(
    ("gap", "ends", "said"),
    [
        (GAP, (-1.4, 1.4), "the size"),
        (GAP, (0.2, 1.4), "the size"),  # it adds, and less than half of what is to be explained
        (GAP, (0.2, 1.6), "the regularizer, too"),
        (GAP, (-1.6, -0.2), "less than the size promises"),
        (GAP, (-0.2, 1.6), "not decided"),
        (Estimate(1.0, -0.1, 2.1, 5), (0.5, 0.6), "no difference shown"),
        (GAP, (NAN, NAN), "–"),
        (Estimate(3.0, NAN, NAN, 1), (0.5, 0.6), "–"),
    ],
)
def test_the_answer_follows_the_rule(gap: Estimate, ends: tuple[float, float], said: str) -> None:
    assert regularizer.answer(gap, Estimate(sum(ends) / 2, *ends, 8)) == said
    assert regularizer.answer(gap, Estimate(sum(ends) / 2, *ends, 7)) == "–"


def test_the_table_leaves_out_what_has_no_speed_term() -> None:
    made = regularizer.table(runs(0.0, noise=0.2), ["T"], "SafeMR", "JointSIS")
    row = made.data.iloc[0]
    assert (row["runs"], row["certificates"], row["regularized"]) == (40, 8, 20)
    assert row["answer"] == "the size"
    assert made.display.iloc[0, 1] == "40 of 8"


def test_single_runs_are_shown_without_intervals() -> None:
    few = runs(0.0, seeds=1)
    few = few[few["variant"].isin(["SafeMR", "JointSIS"])]
    row = regularizer.table(few, ["T"], "SafeMR", "JointSIS").display.iloc[0]
    assert row.tolist()[3:] == ["3.39", "–", "–"]  # 9 x 0.3 + 1.3^2 - 1


def test_nothing_is_answered_while_runs_are_missing() -> None:
    points = pd.concat([runs(0.0, noise=0.2), runs(0.0, noise=0.2).assign(task="U")])
    made = regularizer.table(points, ["T", "U"], "SafeMR", "JointSIS", incomplete={"U"})
    assert made.data["answer"].tolist() == ["the size", "missing"]


def test_the_curves_are_the_fit() -> None:
    areas = np.array([0.5, 1.0, 1.4])
    without, with_ab = regularizer.curves(runs(1.5).query("k > 0"), areas)
    assert without == pytest.approx(30 - 9 * areas - areas**2, abs=2e-3)  # of means over runs
    assert with_ab - without == pytest.approx([1.5] * 3)


def test_the_figure_shows_a_mark_a_certificate_and_two_curves() -> None:
    few, absent = runs(0.0).assign(task="U").query("area > 0.95"), runs(0.0).assign(task="W")
    points, tasks = pd.concat([runs(1.5, noise=0.1), few, absent]), ["T", "U", "V", "W"]
    made = regularizer.table(points, tasks, "SafeMR", "JointSIS", incomplete={"W"})
    figure = at_equal_size(points, tasks, made)
    said = [ax.get_title().partition("\n")[2] for ax in figure.axes]
    assert said[0].startswith("with [a, b] minus without, at equal size: 1.")
    assert said[1:] == ["", "", "runs are missing"]  # too few certificates, none, not all runs
    marks = [sum(len(line.get_xdata()) for line in ax.lines if line.get_marker() in ("o", "s"))
             for ax in figure.axes]  # fmt: skip
    assert marks == [8, 5, 0, 8]
    curves = [sum(len(line.get_xdata()) == 60 for line in ax.lines) for ax in figure.axes]
    assert curves == [2, 0, 0, 0]
    assert "no record" in figure.axes[2].texts[0].get_text()
