"""One process a run: live owners are respected, dead ones forgotten."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sample_record import CONFIG

from safemr.experiment import checkpoints, records
from safemr.experiment.checkpoints import RunSession
from safemr.experiment.locks import LockedError, ProcessLock

ROOT = Path(__file__).resolve().parents[1]
HOLDER = """
import sys, time
from pathlib import Path
from safemr.experiment.locks import ProcessLock
ProcessLock(Path(sys.argv[1]), "works").acquire(wait=False)
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that holds the lock of the run."""
    lock = tmp_path / ".work" / records.config_digest(CONFIG) / checkpoints.LOCK
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(lock)], stdout=subprocess.PIPE, text=True, cwd=ROOT
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_live_owner_is_respected_and_a_dead_one_forgotten(
    owner: subprocess.Popen[str], tmp_path: Path
) -> None:
    session = RunSession(CONFIG, "FAC-phih", tmp_path)
    with pytest.raises(LockedError, match=f"process {owner.pid}") as caught, session:
        raise AssertionError("two processes train the same run")
    assert caught.value.exit_code == 3
    owner.kill()  # SIGKILL: nothing is cleaned up
    owner.wait()
    with session:
        assert not session.complete


def test_waiting_for_the_owner(
    owner: subprocess.Popen[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pid = os.fork()
    if pid == 0:  # ends the owner while this process waits
        time.sleep(0.3)
        os.kill(owner.pid, signal.SIGKILL)
        os._exit(0)
    with RunSession(CONFIG, "FAC-phih", tmp_path, wait=True) as session:
        assert session.elapsed()["wall_s"] < 0.3  # its own time: the owner's checkpoints have that
        assert owner.wait(5) == -signal.SIGKILL
    os.waitpid(pid, 0)
    assert f"waiting for process {owner.pid}" in capsys.readouterr().err


def test_a_lock_whose_file_was_removed_does_not_count(tmp_path: Path) -> None:
    first, second, third = (ProcessLock(tmp_path / "lock", "works") for _ in range(3))
    first.acquire(wait=False)
    (tmp_path / "lock").unlink()
    second.acquire(wait=False)
    with pytest.raises(LockedError):
        third.acquire(wait=False)
    first.release()
    second.release()
    third.acquire(wait=False)
    third.release()


def test_an_owner_that_removes_its_folder_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A finished run takes its folder away, at any moment of another process's attempt."""
    path = tmp_path / "run" / "lock"
    lock, calls = ProcessLock(path, "works"), []
    real = os.open

    def open_after_removal(*arguments: Any, **keywords: Any) -> int:
        calls.append(arguments)
        if len(calls) == 1:
            path.parent.rmdir()
        return real(*arguments, **keywords)

    monkeypatch.setattr(os, "open", open_after_removal)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    lock.acquire(wait=True)
    assert len(calls) == 2
    lock.release()


def test_a_lock_that_cannot_be_written_is_no_endless_wait(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("a file where a folder should be")
    with pytest.raises(OSError, match="run"):
        ProcessLock(tmp_path / "run" / "lock", "works").acquire(wait=True)
