"""How far a grid is: what is recorded, in training, stopped and failed, and how long it takes."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from test_forecast import record, run

from safemr.errors import UserError
from safemr.experiment import config, locks, planning, progress
from safemr.experiment.begun import begun
from safemr.experiment.checkpoints import RunSession
from safemr.experiment.locks import ProcessLock, is_held

ROW = {"eval_return": 3.0, "eval_cost_indicator": 0.25, "train_return": 2.0}


def begin(root: Path, planned: planning.Run, step: int, wall_s: float) -> RunSession:
    session = RunSession(planned.config, planned.variant, root)
    session.__enter__()
    session.resume()
    session.record({"step": step, "time_wall_s": wall_s, **ROW})
    session.record({"step": 2 * step, "time_wall_s": 2 * wall_s, "train_return": 4.0})
    return session


def test_a_grid_in_all_its_states(tmp_path: Path) -> None:
    runs = [run("fac", seed=seed) for seed in range(5)] + [run("fac", "Pillars-0.30-Goal")]
    record(tmp_path, runs[0], 600.0)
    live = begin(tmp_path, runs[1], 1500, 30.0)
    begin(tmp_path, runs[2], 600, 12.0).__exit__(None, None, None)
    failed = begin(tmp_path, runs[3], 300, 6.0)
    failed.fail("policy_loss became inf at step 601")
    failed.__exit__(None, None, None)
    begin(tmp_path, run("fac", seed=9), 300, 6.0).__exit__(None, None, None)
    grid = progress.Grid(tmp_path, runs)
    text = "\n".join(grid.lines())
    head = f"{tmp_path}: 1 of 6 runs recorded, 1 in training, 1 stopped, 1 failed, 2 not begun"
    assert text.splitlines()[0] == head
    (matrix,) = (line.split() for line in text.splitlines() if line.startswith("FAC "))
    assert matrix == ["FAC", "1/5", "0/1"]
    # The newest evaluation, and in brackets the newest of exploration; a minute for half of it.
    (row,) = (line.split() for line in text.splitlines() if line.startswith("Pillars-0.15-Goal "))
    assert row[1:] == ["FAC", "1", "3,000", "6,000", "3.00", "(4.00)", "0.25", "(-)", "1:00"]
    assert "Failed: FAC Pillars-0.15-Goal seed 3 at step 600: policy_loss became inf" in text
    assert "not of this configuration: 1 " in text
    # 60 s in training, 96 and 108 by the pace of those begun, 600 by the record, none on 0.30.
    assert "Left: about 14 core-minutes and 1 run of unknown length" in text
    live.__exit__(None, None, None)
    for planned in runs[1:]:
        record(tmp_path, planned, 60.0)
    assert grid.lines()[0] == f"{tmp_path}: 6 of 6 runs recorded"
    assert not grid.missing


def test_the_time_left_is_shared_by_what_trains_now(tmp_path: Path) -> None:
    runs = [run("fac", seed=seed) for seed in range(3)]
    record(tmp_path, runs[0], 7200.0)
    session = begin(tmp_path, runs[1], 1500, 3600.0)
    assert progress.Grid(tmp_path, runs).lines()[-1] == (
        "Left: about 4.0 core-hours; 4.0 hours, 1 at a time as now"
    )
    session.__exit__(None, None, None)


def test_a_watch_ends_with_its_reader(tmp_path: Path) -> None:
    chosen = {"results_root": str(tmp_path / "results"), "sensitivity": None, "aircraft": None}
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(chosen))
    command = [sys.executable, "-m", "safemr.cli", "progress", "--watch", "0.1"]
    reading, writing = os.pipe()
    watch = subprocess.Popen(
        [*command, "--configfile", str(tmp_path / "c.yaml")], stdout=writing, stderr=subprocess.PIPE
    )
    os.close(writing)
    assert b"0 of " in os.read(reading, 4096)
    os.close(reading)
    _, said = watch.communicate(timeout=300)
    assert (watch.returncode, said) == (0, b"")


def test_a_watch_ends_with_the_last_record(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = {
        "tasks": ["Pillars-0.15-Goal"], "algorithms": {"FAC": {"algorithm": "fac"}}, "seeds": [100],
        "budget": {"off_policy": 6000}, "log_points": 1, "task_overrides": {},
        "evaluation": {"points": 1, "episodes": 1}, "results_root": str(tmp_path / "results"),
        "sensitivity": None, "aircraft": None,
        "unseen_layouts": None, "protocol": 1, "sizes": False,
    }  # fmt: skip
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(chosen))
    (planned,) = planning.resolve(config.load([progress.DEFAULT, tmp_path / "c.yaml"])).runs
    waited = []

    def sleep(seconds: float) -> None:
        waited.append(seconds)
        record(tmp_path / "results", planned, 60.0)

    monkeypatch.setattr(time, "sleep", sleep)
    assert progress.main(["--configfile", str(tmp_path / "c.yaml"), "--watch", "7"]) == 0
    assert waited == [7.0]
    printed = capsys.readouterr().out
    assert "0 of 1 run recorded, 1 not begun" in printed
    assert "1 of 1 run recorded" in printed
    with pytest.raises(UserError, match="--watch"):
        progress.main(["--watch", "0"])


def test_a_look_at_a_lock_keeps_nobody_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "lock"
    assert not is_held(path)
    assert not path.exists()
    lock = ProcessLock(path, "works")
    lock.acquire(wait=False)
    assert is_held(path)
    lock.release()
    assert not is_held(path)
    # Somebody looks at the very moment at which it is taken, and has looked a moment later.
    look = os.open(path, os.O_RDONLY)
    fcntl.flock(look, fcntl.LOCK_SH)
    looked: Callable[[float], None] = lambda seconds: os.close(look)  # noqa: E731
    monkeypatch.setattr(locks.time, "sleep", looked)
    lock.acquire(wait=False)
    assert is_held(path)
    lock.release()


def test_what_vanishes_or_is_torn_is_left_out(tmp_path: Path) -> None:
    work = tmp_path / ".work" / "0123456789ab"
    work.mkdir(parents=True)
    assert list(begun(tmp_path)) == []
    (work / "attempts.jsonl").write_text('\n{"run": "FAC X seed 0", "step": 0}\n{"ru')
    (work / "progress.csv").write_text("step,a\n1")
    (found,) = begun(tmp_path)
    assert (found.label, found.step, found.running, found.failure) == (
        "FAC X seed 0",
        0,
        False,
        None,
    )
    assert found.last("a") != found.last("a")
