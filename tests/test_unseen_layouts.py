"""Final policies on unseen layouts: of records, through the command, and as a table."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from sample_record import CONFIG, ROWS, make_record
from scipy import stats

from safemr import cli
from safemr.errors import UserError
from safemr.experiment import records
from safemr.experiment.record import Record
from safemr.experiment.train import make_envs
from safemr.learning import evaluation
from safemr.learning.networks import StackedMLP
from safemr.learning.observation import ObservationTransform
from safemr.learning.policies import Policy
from safemr.measure import evaluate, unseen_layouts
from safemr.measure.store import Measurements
from safemr.report import statistics
from safemr.report.unseen_layouts import table

TASK = "Pillars-0.15-Goal"


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record whose policy has random weights."""
    envs = make_envs(CONFIG["task"], 1)
    size = envs.single_observation_space.shape[0]
    envs.close()
    network = StackedMLP(1, [size, 8, 4], "relu")
    values = np.random.default_rng(0).normal(0, 0.3, network.parameters.numel())
    network.load(values.astype(np.float32))
    transform = ObservationTransform(np.arange(size), np.ones(size), np.full(size, np.inf))
    policy = Policy(transform, network, squash=True)
    folder = tmp_path_factory.mktemp("results") / records.record_path(CONFIG, "FAC-phih")
    records.write_record(folder, CONFIG, "FAC-phih", ROWS, {}, policy.arrays())
    return folder


def test_a_record_flies_like_its_policy_and_is_measured_once(record: Path, tmp_path: Path) -> None:
    kept = Measurements(tmp_path)
    scores = unseen_layouts.measured_scores(kept, [record], episodes=2, seed=20_000)
    found = scores.set_index("metric")["value"]
    envs = make_envs(CONFIG["task"], 2)
    from safemr.learning.policies import load_policy

    alone = evaluation.evaluate(load_policy(record), envs, 20_000)
    envs.close()
    assert found["eval_return"] == alone["return"]
    assert found["eval_cost_indicator"] == alone["cost_indicator"]
    assert found["eval_episodes"] == 2
    assert set(zip(scores["task"], scores["variant"], scores["seed"], strict=True)) == {
        (TASK, "FAC-phih", 100)
    }
    (path,) = (kept.folder / "unseen_layouts").iterdir()
    before = path.stat().st_mtime_ns
    again = unseen_layouts.measured_scores(kept, [record], episodes=2, seed=20_000)
    pd.testing.assert_frame_equal(again, scores)
    assert path.stat().st_mtime_ns == before


def test_what_was_measured_outlives_the_policy(record: Path, tmp_path: Path) -> None:
    """A policy that is left out for its size takes no row from the tables."""
    kept, folder = Measurements(tmp_path), tmp_path / Path(*record.parts[-4:])
    shutil.copytree(record, folder)
    before = unseen_layouts.measured_scores(kept, [folder], episodes=1, seed=20_000)
    (folder / "policy.npz").unlink()
    after = unseen_layouts.measured_scores(kept, [folder], episodes=1, seed=20_000)
    pd.testing.assert_frame_equal(after, before)
    assert unseen_layouts.measured_scores(kept, [folder], episodes=2, seed=20_000).empty
    (path,) = (tmp_path / "measurements/unseen_layouts").iterdir()
    path.write_text(path.read_text().replace("return", "retrun"))
    with pytest.raises(UserError, match="is damaged"):
        unseen_layouts.measured_scores(kept, [folder], episodes=1, seed=20_000)


def test_the_command_prints_a_line_a_record(
    record: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["evaluate", str(record), "--episodes", "1", "--exploring"]) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"{record}: return ")
    assert "over 1 layouts" in out


def test_a_record_without_a_policy_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_record(tmp_path)
    with pytest.raises(UserError, match="not a policy"):
        evaluate.evaluate_record(Record.open(folder), episodes=1)
    (folder / "policy.npz").unlink()
    scores = unseen_layouts.measured_scores(Measurements(tmp_path), [folder], episodes=1, seed=0)
    assert scores.empty
    assert str(folder) in capsys.readouterr().out


@pytest.mark.parametrize("arguments", [["--episodes", "0"], ["--seed", "-1"]])
def test_impossible_numbers_end_in_one_line(arguments, capsys) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["evaluate", "somewhere", *arguments])
    assert end.value.code == 2
    assert capsys.readouterr().err.startswith("error: --episodes must be")


def score_table(**values: list[float]) -> pd.DataFrame:
    rows = [
        (TASK, variant, seed, metric, value)
        for variant, returns in values.items()
        for seed, value in enumerate(returns)
        for metric, value in (
            ("eval_return", value),
            ("eval_cost_indicator", 0.5 * (variant == "CPO")),
            ("eval_zero_violation_share", 1.0 - 0.1 * seed * (variant == "CPO")),
        )
    ]
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"])


def test_the_table_counts_episodes_with_violations() -> None:
    flown = score_table(SafeMR=[10.0, 11.0, 12.0], CPO=[20.0, 20.0, 20.0])
    before = score_table(SafeMR=[9.0, 9.0, 9.0])
    data = table(flown, before, episodes=20).data.set_index("variant")
    ours, cpo = data.loc["SafeMR"], data.loc["CPO"]
    assert (ours["violating_episodes"], ours["episodes"], ours["safe"]) == (0, 60, True)
    assert (cpo["violating_episodes"], cpo["episodes"], cpo["safe"]) == (6, 60, False)
    assert ours["change"] == pytest.approx(2.0)
    assert math.isnan(cpo["change"])
    assert ours["upper_bound"] == pytest.approx(1 - 0.05 ** (1 / 60))  # the rule of three
    assert stats.binom.cdf(6, 60, cpo["upper_bound"]) == pytest.approx(0.05)
    assert cpo["behind"] == pytest.approx(-9.0)
    assert math.isnan(ours["behind"])
    interval = statistics.mean_interval(np.array([10.0, 11.0, 12.0]))
    assert (ours["return_low"], ours["return_high"]) == interval[1:3]


def test_a_change_is_that_of_the_runs_that_were_flown() -> None:
    flown = score_table(SafeMR=[10.0, 11.0, 12.0, 13.0])
    before = score_table(SafeMR=[9.0, 9.0, 9.0, 99.0])
    data = table(flown[flown["seed"] < 3], before, episodes=20).data
    assert data["change"].tolist() == pytest.approx([2.0])
