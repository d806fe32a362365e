"""An implementation outside `safemr` whose records take part like any other."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from types import MappingProxyType, ModuleType

import numpy as np
import pandas as pd
import pytest

from safemr.experiment import records
from safemr.experiment.config import load
from safemr.experiment.planning import resolve
from safemr.report import compute, statistics, tables
from safemr.report.figures import curves

ROOT = Path(__file__).resolve().parents[1]
PROGRAM = ROOT / "examples/outside/cross_entropy.py"


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(results root, record folder) of one short run, made by the command of the rule."""
    outside = {
        "CEM": {
            "algorithm": "cross_entropy",
            "steps": 400,
            "hyperparameters": {"population": 4, "elites": 2},
        }
    }
    short = {"base": "Pillars-0.15-Goal", "settings": {"max_episode_steps": 50}}
    config = load(
        [ROOT / "config/smoke.yaml"],
        {"outside": outside, "tasks": ["Pillars-0.15-Goal", {"Short": short}]},
    )
    (run,) = [run for run in resolve(config).outside if run.task == "Short"][:1]
    root = tmp_path_factory.mktemp("results")
    command = [
        sys.executable, str(PROGRAM), "--config", run.resolved, "--variant", run.variant,
        "--out", str(root / run.path),
    ]  # fmt: skip
    subprocess.run(command, check=True, cwd=ROOT, env=_environment(), timeout=120)
    return root, run.path


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


def test_record_is_accepted_and_read_like_any_other(record):
    root, folder = record
    records.verify_record(root / folder)
    index, progress = records.read_records(root)
    assert index[["task", "variant", "seed", "algorithm", "steps"]].iloc[0].tolist() == [
        "Short",
        "CEM",
        100,
        "cross_entropy",
        400,
    ]
    metrics = set(progress["metric"])
    assert {"eval_return", "eval_cost", "eval_zero_violation_share", "train_return"} <= metrics
    assert progress["step"].max() >= 400
    lengths = progress.loc[progress["metric"] == "eval_length", "value"]
    assert set(lengths) == {50.0}


def test_program_is_independent_of_safemr():
    names = {
        name
        for node in ast.walk(ast.parse(PROGRAM.read_text()))
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert not any(name.split(".")[0] in ("safemr", "torch") for name in names)
    assert {"numpy", "gymnasium"} <= names


@pytest.mark.parametrize(
    ("file", "change", "complaint"),
    [
        ("progress.csv", lambda text: text.replace("eval_cost,", "evaluation_cost,"), "checksum"),
        ("config.json", lambda text: text.replace('"seed":100', '"seed":101'), "checksum"),
        ("provenance.json", lambda text: text.replace('"complete"', '"running"'), "complete"),
        ("provenance.json", lambda text: text.replace('"schema": 1', '"schema": 7'), "schema"),
        ("provenance.json", lambda text: text.replace('"digest"', '"hash"'), "lacks digest"),
    ],
)
def test_malformed_record_is_refused_with_its_fault(record, tmp_path, file, change, complaint):
    root, folder = record
    copy = tmp_path / folder
    copy.mkdir(parents=True)
    for name in records.REQUIRED_FILES:
        text = (root / folder / name).read_text()
        (copy / name).write_text(change(text) if name == file else text)
    with pytest.raises(records.RecordError, match=complaint) as caught:
        records.verify_record(copy)
    assert "\n" not in str(caught.value)


def test_curves_without_an_evaluation_are_refused(record, tmp_path):
    """Checksums in order, but a column that every table needs is missing."""
    root, folder = record
    config = json.loads((root / folder / records.CONFIG).read_text())
    rows = [{"step": 400, "eval_return": 1.0, "eval_zero_violation_share": 1.0}]
    records.write_record(tmp_path / folder, config, "CEM", rows, {})
    with pytest.raises(records.RecordError, match="no eval_cost"):
        records.verify_record(tmp_path / folder)


def test_unknown_hyperparameter_is_named(tmp_path, record):
    root, folder = record
    config = json.loads((root / folder / records.CONFIG).read_text())
    config["algorithm"]["hyperparameters"] = {"popluation": 3}
    command = [
        sys.executable, str(PROGRAM), "--config", records.canonical_json(config),
        "--variant", "CEM", "--out", str(tmp_path / "out"),
    ]  # fmt: skip
    done = subprocess.run(
        command, cwd=ROOT, env=_environment(), capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert "popluation" in done.stderr
    assert not (tmp_path / "out").exists()


def silent(root: Path, seed: int, origin: dict[str, object]) -> None:
    """A record of another seed of which the provenance says no more than ``origin``."""
    config = {
        "schema": 1, "task": {"name": "Pillars-0.15-Goal", "version": 1, "settings": {}},
        "algorithm": {"name": "cross_entropy", "version": 1, "hyperparameters": {}},
        "seed": seed, "steps": 400, "log_every": 10,
        "evaluation": {"every": 10, "episodes": 2, "seed": 10000},
    }  # fmt: skip
    row = {"step": 400, "time_wall_s": 30.0, "eval_return": 1.0, "eval_cost": 0.0,
           "eval_zero_violation_share": 1.0}  # fmt: skip
    folder = root / records.record_path(config, "CEM")
    records.write_record(folder, config, "CEM", [row], origin)


def computed(root: Path) -> tuple[tables.Table, pd.DataFrame]:
    """The table of compute and the clock of the curves, through the files that the rules write."""
    runs, progress = records.read_records(root)
    stored = root / "runs.csv"
    runs.to_csv(stored, index=False)
    assert (runs["cpu_s"] / 60).dtype == float, "what scripts/aggregate.py computes"
    again = pd.read_csv(stored)
    minutes = statistics.core_minutes(progress, again)
    returns = statistics.learning_curves(progress, "eval_return")
    curves.compute_curves(returns, minutes, ["Pillars-0.15-Goal"])
    table = compute.table(again)
    pd.testing.assert_frame_equal(compute.table(runs).display, table.display)
    return table, minutes


def test_a_record_that_does_not_say_what_it_cost_has_dashes(record):
    """The example's provenance says neither processor time nor memory nor processor."""
    root, _ = record
    table, minutes = computed(root)
    (row,) = table.display.to_dict("records")
    assert (row["core-minutes a run"], row["steps a core-second"], row["peak MB"]) == ("–",) * 3
    assert "0.0 core-hours" in table.caption
    assert "no record names its processor" in table.caption
    assert table.notes == ["Records that do not say their processor time: CEM on Short (1 of 1)."]
    for text in (table.markdown(), table.latex()):
        assert "inf" not in text
        assert "nan" not in text
    assert minutes.empty


def test_means_are_over_the_records_that_say_what_they_cost(tmp_path):
    silent(tmp_path, 0, {})
    silent(tmp_path, 1, {"wall_s": 60.0, "cpu_s": 120.0, "peak_rss_mb": 100, "cpu": "a processor"})
    silent(tmp_path, 2, {"wall_s": 0, "cpu_s": 0.0, "peak_rss_mb": None, "cpu": None})
    table, minutes = computed(tmp_path)
    (row,) = table.data.to_dict("records")
    assert (row["runs"], row["core_minutes"], row["steps_per_core_s"]) == (3, 2.0, 400 / 120)
    assert row["peak_mb"] == 100.0
    assert "(a processor)" in table.caption
    assert "(2 of 3)" in table.notes[0]
    assert minutes["minutes"].tolist() == [1.0]  # half a minute of wall time on two processors


@pytest.mark.parametrize(
    "origin", [{"cpu_s": "12"}, {"wall_s": -1.0}, {"peak_rss_mb": True}, {"cpu": 7}]
)
def test_a_provenance_of_another_type_is_refused(tmp_path, origin):
    silent(tmp_path, 0, origin)
    with pytest.raises(records.RecordError, match=next(iter(origin))):
        records.read_records(tmp_path)


def example() -> ModuleType:
    """The program as a module."""
    spec = importlib.util.spec_from_file_location("cross_entropy", PROGRAM)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Recorder:
    """Two worlds that cost 1 a control step and end after 7 and 5; it remembers the actions."""

    observation_layout = MappingProxyType({"velocimeter": slice(0, 3), "gyro": slice(3, 6)})

    def __init__(self) -> None:
        self.random, self.actions = np.random.default_rng(0), []

    def reset(self, seed):
        return self.random.standard_normal((2, 6)), {}

    def step(self, actions):
        self.actions.append(actions.copy())
        ended, ones = len(self.actions) == np.array([7, 5]), np.ones(2)
        infos = {"cost": ones, "cost_indicator": ones}
        return self.random.standard_normal((2, 6)), ones, ended, np.zeros(2, bool), infos


def test_the_program_holds_and_scales_its_actions_and_counts_control_steps():
    weights = np.random.default_rng(1).standard_normal((2, 4, 2))
    envs = Recorder()
    sums = example().play(envs, weights, 0, {"action_repeat": 3, "action_scale": [0.05, 1.0]})
    holds = [envs.actions[0:3], envs.actions[3:6], envs.actions[6:]]
    assert all(np.array_equal(action, hold[0]) for hold in holds for action in hold)
    assert not np.array_equal(holds[0][0], holds[1][0])
    assert np.abs(envs.actions)[..., 0].max() <= 0.05 < np.abs(envs.actions)[..., 1].max()
    assert sums["cost"].tolist() == sums["length"].tolist() == [7.0, 5.0]
    # As it is: a decision a control step, up to the limits of the action space.
    envs = Recorder()
    example().play(envs, weights, 0, {})
    assert len(np.unique(np.array(envs.actions)[:, 0, 1].round(9))) > 3
    assert np.abs(envs.actions)[..., 0].max() > 0.05


def test_budget_and_evaluation_of_the_program_are_in_control_steps(monkeypatch):
    program, seen = example(), []
    real = program.play
    monkeypatch.setattr(program, "play", lambda *given: seen.append(given[3]) or real(*given))
    entry = {"action_repeat": 7}
    config = {
        "task": {"name": "Pillars-0.15-Goal", "settings": {"max_episode_steps": 20}},
        "algorithm": {"hyperparameters": {"population": 4, "elites": 2}},
        "seed": 100, "steps": 240, "evaluation": {"every": 160, "episodes": 2, "seed": 1},
        "interface": entry,
    }  # fmt: skip
    rows = program.search(config)
    assert [row["step"] for row in rows] == [80, 160, 240]
    assert [row.get("eval_length") for row in rows] == [None, 20.0, 20.0]
    assert seen == [entry] * 5
