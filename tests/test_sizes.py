"""The table and the pictures of what certificates of other sizes are worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from safemr import cli
from safemr.errors import UserError
from safemr.measure.oracle import COLUMNS
from safemr.report import sizes
from safemr.report.figures.filters import behind_filters
from safemr.report.figures.sizes import against_size

TASK = "Pillars-0.15-Goal"


def certificates() -> pd.DataFrame:
    """The oracle, and two variants of which one has a run that is not feasible."""

    def row(name: str, area: float, infeasible: int = 0, variant: str | None = None,
            seed: int | None = None) -> tuple[object, ...]:  # fmt: skip
        worst = 0.01 * infeasible if infeasible else np.nan
        made = None if variant is None else variant == "A"
        return TASK, name, variant, seed, 0.1, 1.0, 2.0, area, 1000, infeasible, worst, made

    rows = [row("oracle", 0.5), row("phi_h", 1.5, 2)]
    rows += [row(f"A (seed {seed})", 1.0 + seed, seed == 2, "A", seed) for seed in range(3)]
    rows += [row("B (seed 0)", 0.75, 0, "B", 0)]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def test_the_table_has_a_row_a_variant_and_the_oracle_as_its_unit() -> None:
    data = sizes.table(certificates()).data.set_index("certificate")
    assert list(data.index) == ["oracle", "phi_h", "A", "B"]
    assert data["ratio"].tolist() == pytest.approx([1.0, 3.0, 4.0, 1.5])
    assert data["feasible"].tolist() == [1, 0, 2, 1]
    assert data.loc["A", "infeasible_share"] == pytest.approx(0.001)
    assert data.loc["A", "runs"] == 3
    assert np.isnan(data.loc["B", "area_low"])  # one run has no interval


def scores(path: Path) -> Path:
    rows = [
        (TASK, variant, seed, metric, value)
        for variant, seed in [("A", 0), ("A", 1), ("A", 2), ("B", 0), ("PPO-L", 0)]
        for metric, value in [("eval_return", 10.0 + seed), ("eval_cost_indicator", 0.1 * seed)]
    ]
    pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"]).to_csv(path)
    return path


def test_runs_meet_their_flights(tmp_path: Path) -> None:
    points = sizes.merged(certificates(), pd.read_csv(scores(tmp_path / "flown.csv")))
    assert len(points) == 4  # PPO-L has no certificate, phi_h no flight
    assert points.set_index(["variant", "seed"]).loc[("A", 2), "return"] == 12.0
    assert points["feasible"].tolist() == [True, True, False, True]
    assert points["regularized"].tolist() == [True, True, True, False]
    figure = against_size(points, [TASK], {TASK: 0.5})
    upper = figure.axes[0]
    drawn = [line for line in upper.lines if line.get_marker() not in ("None", None, "")]
    assert sum(len(line.get_xdata()) for line in drawn) == 4
    hollow = [line for line in drawn if line.get_markerfacecolor() == "none"]
    assert [line.get_xdata().tolist() for line in hollow] == [[3.0]]


def beside(folder: Path, area: float = 0.5, gain: float = 0.0) -> list[Path]:
    """The files of another configuration: two runs of A, of which one is ours, and two of C."""
    folder.mkdir(exist_ok=True)
    theirs = certificates().head(2).copy()
    theirs["area"] = [area, 1.5]
    runs = [("A", 7), ("A", 0), ("C", 0), ("C", 1)]
    rows = [(TASK, f"{v} (seed {s})", v, s, 0.1, 1.0, 2.0, 0.3, 1000, 0, np.nan, True)
            for v, s in runs]  # fmt: skip
    pd.concat([theirs, pd.DataFrame(rows, columns=list(COLUMNS))]).to_csv(
        folder / "sizes.csv", index=False
    )
    flown = [(TASK, v, s, metric, 10.0 + gain)
             for v, s in runs for metric in ("eval_return", "eval_cost_indicator")]  # fmt: skip
    columns = ["task", "variant", "seed", "metric", "value"]
    pd.DataFrame(flown, columns=columns).to_csv(folder / "flown.csv", index=False)
    return [folder / "sizes.csv", folder / "flown.csv"]


@pytest.fixture
def flown(tmp_path: Path) -> pd.DataFrame:
    return pd.read_csv(scores(tmp_path / "ours.csv"))


def test_certificates_of_another_configuration_stand_beside_these(
    tmp_path: Path, flown: pd.DataFrame
) -> None:
    ours = certificates()
    others = sizes.Others.read(*beside(tmp_path / "summary"), ours=ours, flown=flown)
    assert others.told == "A (seeds 7), C (seeds 0, 1)"  # one run of A is in both: it is ours
    made = sizes.table(ours, others)
    assert made.data.set_index("certificate")["runs"].to_dict() == {
        "oracle": 0, "phi_h": 0, "A": 4, "B": 1, "C": 2
    }  # fmt: skip
    assert made.caption.endswith(
        f"Of another configuration's runs (under {tmp_path}): {others.told}."
    )
    points = sizes.merged(others.sizes, others.flown)
    shown = points[["variant", "seed", "return"]].to_numpy().tolist()
    assert shown == [["A", 7, 10.0], ["C", 0, 10.0], ["C", 1, 10.0]]


def test_a_variant_of_both_must_have_flown_alike(tmp_path: Path, flown: pd.DataFrame) -> None:
    """Its runs are then of one algorithm; else only the label is the same."""
    files = beside(tmp_path / "summary")
    both = certificates().assign(variant=lambda rows: rows["variant"].replace("B", "C"))
    both.loc[both["variant"] == "C", "seed"] = 9
    with pytest.raises(UserError, match=r"C has runs on .* none with the same seed"):
        sizes.Others.read(*files, ours=both, flown=flown)


def test_seeds_are_told_only_where_they_differ(tmp_path: Path, flown: pd.DataFrame) -> None:
    files = beside(tmp_path / "summary")
    kept = pd.read_csv(files[0]).query("seed != 7 and seed != 1")
    kept.to_csv(files[0], index=False)
    assert sizes.Others.read(*files, ours=certificates(), flown=flown).told == "C"


@pytest.mark.parametrize(
    ("spoilt", "said"),
    [
        ({"area": 0.6}, "0.5000 here and 0.6000 under .*: give the task the same interface"),
        ({"gain": 0.1}, "no run on Pillars-0.15-Goal has the same return here"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    spoilt: dict[str, float], said: str, tmp_path: Path, flown: pd.DataFrame
) -> None:
    with pytest.raises(UserError, match=said):
        sizes.Others.read(*beside(tmp_path / "s", **spoilt), ours=certificates(), flown=flown)


def test_what_is_missing_of_another_configuration_is_named(
    tmp_path: Path, flown: pd.DataFrame
) -> None:
    ours = certificates()
    first, second = beside(tmp_path / "summary")
    with pytest.raises(UserError, match="does not have Other-Task"):
        sizes.Others.read(first, second, ours=ours.assign(task="Other-Task"), flown=flown)
    pd.read_csv(first).drop(columns="regularized").to_csv(first, index=False)
    with pytest.raises(UserError, match="has no column 'regularized'; make the results under"):
        sizes.Others.read(first, second, ours=ours, flown=flown)
    second.unlink()
    with pytest.raises(UserError, match=r"flown.csv is missing; make the results under"):
        sizes.Others.read(first, second, ours=ours, flown=flown)


def test_the_filters_figure_shows_every_flight() -> None:
    rows = [
        (TASK, policy, name, seed, metric, value)
        for policy in ("PPO-L", "CPO")
        for name in (None, "phi_h", "SafeMR")
        for seed in (0, 1)
        for metric, value in [("return", 1.0 + seed), ("zero_violation_share", 0.5)]
    ]
    columns = ["task", "variant", "filter", "seed", "metric", "value"]
    figure = behind_filters(pd.DataFrame(rows, columns=columns))
    left, right = figure.axes
    small = [line for line in left.lines if len(line.get_xdata()) == 2 and line.get_alpha()]
    assert len(small) == 6
    assert [text.get_text() for text in left.get_yticklabels()] == ["PPO-L", "CPO"]
    dirty = {float(x) for line in right.lines if line.get_alpha() for x in line.get_xdata()}
    assert dirty == {50.0}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--sigma", "0.1"], "belong together"),
        (["--set", "task.d_min=1"], "only decisions have settings here"),
        (["--set", "interface.action_repeat=0"], "action_repeat must be"),
        (["--set", "interface.action_scale=[0.05]"], "action_scale"),  # of two components
        (["--task", "Pillars-0.2-Goal"], "did you mean"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["oracle", *arguments])
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert said in printed
    assert printed.count("\n") == 1
