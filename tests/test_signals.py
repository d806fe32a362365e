"""Signals: a checkpoint before the end, the last line in the log, nothing lost at any moment."""

from __future__ import annotations

import ast
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from kills import make_run
from sample_record import CONFIG, POLICY, ROWS

from safemr.errors import tell
from safemr.experiment import checkpoints, planning, records
from safemr.experiment.checkpoints import RunSession
from safemr.experiment.locks import ProcessLock
from safemr.experiment.signals import StoppedError

ROOT = Path(__file__).resolve().parents[1]
TERM, INT, HUP = signal.SIGTERM, signal.SIGINT, signal.SIGHUP


def send(*numbers: int) -> None:
    for number in numbers:
        os.kill(os.getpid(), number)


def stop(session: RunSession, state: Any = lambda: {"x": 1}) -> int:
    """The exit status with which a log point ends the process."""
    with pytest.raises(SystemExit) as caught:
        session.maybe_checkpoint(state)
    return int(caught.value.code or 0)


def saved(session: RunSession) -> Any:
    return checkpoints.load(session.work / "checkpoint.pt")["state"]


@pytest.mark.parametrize("numbers", [(TERM,), (INT,), (HUP,), (TERM, TERM), (INT, TERM, HUP)])
def test_signals_lead_to_a_checkpoint_and_an_exit(numbers: tuple[int, ...], tmp_path: Path) -> None:
    """Slurm sends SIGTERM twice within 30 ms: what comes within 2 s is one request."""
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        session.resume()
        session.record(ROWS[0])
        send(*numbers)
        assert stop(session) == 128 + numbers[0]
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        assert session.resume() == {"x": 1}


def test_a_second_signal_after_two_seconds_ends_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        session.resume()
        send(TERM)
        clock[0] = 1.9
        send(TERM)
        clock[0] = 2.1
        with pytest.raises(StoppedError) as caught:
            send(INT)
    assert caught.value.code == 128 + INT


def test_an_ignored_signal_stays_ignored(tmp_path: Path) -> None:
    """`nohup` ignores SIGHUP, a shell SIGINT for what it runs in the background."""
    before = signal.signal(HUP, signal.SIG_IGN)
    try:
        with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=0) as session:
            session.resume()
            session.record(ROWS[0])
            send(HUP)
            session.maybe_checkpoint(lambda: {"x": 1})
            assert signal.getsignal(HUP) is signal.SIG_IGN
            assert signal.getsignal(TERM) is not signal.SIG_DFL
        assert signal.getsignal(TERM) is signal.SIG_DFL
    finally:
        signal.signal(HUP, before)


def test_a_signal_before_training_ends_at_once(tmp_path: Path) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path), pytest.raises(StoppedError) as caught:
        send(TERM)
    assert caught.value.code == 128 + TERM


def test_a_signal_whose_exception_is_swallowed_still_counts(tmp_path: Path) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        with pytest.raises(SystemExit):
            send(TERM)
        with pytest.raises(StoppedError):
            session.resume()


def test_a_signal_while_a_checkpoint_is_written_needs_no_second_one(tmp_path: Path) -> None:
    written = []

    def state() -> dict[str, int]:
        send(TERM)
        written.append(1)
        return {"x": 2}

    with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=0) as session:
        session.resume()
        session.record(ROWS[0])
        assert stop(session, state) == 128 + TERM
    assert written == [1]
    assert saved(session) == {"x": 2}


def test_a_signal_while_the_record_is_written_does_not_spoil_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, write = [0.0], records.write_record
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])

    def write_and_send(*arguments: Any) -> None:
        send(TERM)
        write(*arguments)

    monkeypatch.setattr(records, "write_record", write_and_send)
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        session.resume()
        session.rows = list(ROWS)
        session.finish(POLICY)
        clock[0] = 10.0
        send(TERM, INT)  # Snakemake would remove the record of a process that these end
    records.verify_record(session.folder)
    assert not session.work.exists()


def test_where_a_run_continues_is_told_truly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a full disk there is no new checkpoint."""
    with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=0) as session:
        session.resume()
        session.record(ROWS[0])
        session.maybe_checkpoint(lambda: {"x": 1})
        session.record(ROWS[1])

        def full(*arguments: Any) -> None:
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(checkpoints, "save", full)
        send(TERM)
        stop(session)
    first, second = (int(row["step"]) for row in ROWS[:2])
    last = capsys.readouterr().err.splitlines()[-1]
    assert (
        last == f"stopped by SIGTERM at step {second}; the same command continues at step {first}"
    )


class Quoted(str):
    """Snakemake's ``{value:q}``."""

    def __format__(self, form: str) -> str:
        return shlex.quote(self) if form == "q" else str(self)


def rule_line(run: planning.Run, root: Path, log: Path) -> str:
    """The command of the rule `train`, as Snakemake would give it to bash."""
    text = (ROOT / "workflow/rules/train.smk").read_text().partition("    shell:\n")[2]
    command: str = ast.literal_eval(f"({text.partition(chr(10) * 2)[0]})")
    filled = command.format(
        sys=SimpleNamespace(executable=Quoted(sys.executable)),
        params=SimpleNamespace(
            resolved=Quoted(run.resolved), variant=Quoted(run.variant), root=Quoted(root)
        ),
        CONFIG=SimpleNamespace(wandb_mode=Quoted("disabled"), wandb_project=Quoted("none")),
        log=Quoted(log),
        resources=SimpleNamespace(attempt=1),
    )
    return f"set -euo pipefail; {filled}"


@pytest.fixture
def started(tmp_path: Path) -> Iterator[Any]:
    """Starts the training rule's line in a process group of its own, as Slurm's step is one."""
    processes: list[subprocess.Popen[str]] = []
    fields = {"start_steps": 100, "hidden": 16, "batch_size": 32}
    run = make_run("safemr", "Pillars-0.15-Goal", fields, 400_000, points=400, evaluations=1)

    def start() -> tuple[subprocess.Popen[str], Path]:
        log = tmp_path / "run.log"
        process = subprocess.Popen(
            ["bash", "-c", rule_line(run, tmp_path / "root", log)],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        processes.append(process)
        return process, log

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_for(log: Path, text: str, seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while not log.exists() or text not in log.read_text():
        assert time.monotonic() < end, f"{text!r} did not come"
        time.sleep(0.02)


def test_the_last_line_reaches_the_log(started: Any) -> None:
    """Two SIGTERM to the whole group, 30 ms apart; then SIGHUP and SIGINT to the next attempt."""
    for number, numbers in enumerate([(TERM, TERM), (HUP, INT)]):
        process, log = started()
        wait_for(log, " continues at step " if number else "/400000 | ")
        for signal_number in numbers:
            os.killpg(process.pid, signal_number)
            time.sleep(0.03)
        # Both pipes are closed when the trainer and `tee` have ended.
        _, shown = process.communicate(timeout=240)
        assert process.returncode == 128 + numbers[0]
        last = log.read_text().splitlines()[-1]
        assert last.startswith(f"stopped by {numbers[0].name} at step ")
        assert last.endswith("; the same command continues here")
        assert shown.splitlines()[-1] == last


@pytest.mark.parametrize("number", [TERM, INT])
def test_a_process_that_waits_ends_at_once_with_one_line(number: int, tmp_path: Path) -> None:
    arguments = ["--task", "Pillars-0.15-Goal", "--algorithm", "fac", "--steps", "8000", "--wait"]
    from safemr.experiment import train

    config, _ = train.resolve(train._parse(arguments))
    owner = ProcessLock(
        tmp_path / ".work" / records.config_digest(config) / checkpoints.LOCK, "holds the run"
    )
    owner.acquire(wait=False)
    with subprocess.Popen(
        [sys.executable, "-m", "safemr.experiment.train", *arguments, "--out", str(tmp_path)],
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("waiting for process ")
        process.send_signal(number)
        (line,) = process.stderr.read().splitlines()
    assert line.startswith(f"stopped at once by {signal.Signals(number).name}; the same command ")
    assert process.returncode == 128 + number
    owner.release()


def test_an_orphan_does_not_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    session = RunSession(CONFIG, "FAC-phih", tmp_path, wait=True, die_with_parent=True)
    owner = ProcessLock(session.work / checkpoints.LOCK, "holds the run")
    owner.acquire(wait=False)
    monkeypatch.setattr(os, "getppid", lambda: 1)
    with pytest.raises(SystemExit), session:
        tell("never reached")
    owner.release()
    assert capsys.readouterr().err.splitlines()[-1] == (
        "stopped by the end of its parent process while it waited"
    )
