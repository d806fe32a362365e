"""A full disk: the previous state stays usable, and training goes on where it can."""

from __future__ import annotations

import json
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from sample_record import CONFIG, ROWS

from safemr import files
from safemr.errors import UserError
from safemr.experiment import records, train
from safemr.experiment.checkpoints import RunSession


@pytest.fixture
def full_disk() -> Iterator[Callable[[int], None]]:
    """Makes every write beyond so many bytes of a file fail, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, handler)


def test_a_failed_write_leaves_the_old_file(
    tmp_path: Path, full_disk: Callable[[int], None]
) -> None:
    path = tmp_path / "file"
    files.write(path, b"old")
    full_disk(100)
    with pytest.raises(OSError, match="File too large"):
        files.write(path, bytes(1000))
    assert path.read_bytes() == b"old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_keeps_the_previous_checkpoint_and_the_run_alive(
    tmp_path: Path, full_disk: Callable[[int], None], capsys: pytest.CaptureFixture[str]
) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=0) as session:
        session.resume()
        session.record(ROWS[0])
        session.maybe_checkpoint(lambda: {"x": torch.zeros(4)})
        session._due = 0.0
        full_disk(20_000)
        session.record(ROWS[1])
        session.maybe_checkpoint(lambda: {"x": torch.zeros(100_000)})
        message = capsys.readouterr().err
        assert "no new checkpoint" in message
        assert "File too large" in message
        full_disk(50)
        with pytest.raises(UserError, match="cannot write the record"):
            session.finish(None)
        full_disk(resource.RLIM_INFINITY)
    assert not session.complete
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        state = session.resume()
        assert state is not None
        assert state["x"].shape == (4,)
        assert [row["step"] for row in session.rows] == [10]


def test_a_disk_full_from_the_start_is_one_line(
    tmp_path: Path,
    full_disk: Callable[[int], None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(train, "train", lambda config, session, **_: session.resume())
    full_disk(0)
    arguments = ["--resolved", json.dumps(CONFIG), "--root", str(tmp_path)]
    assert train.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: cannot write under {tmp_path}: ")
    assert "File too large" in line
    full_disk(resource.RLIM_INFINITY)
    assert train.main(arguments) == 0


def test_a_full_disk_in_the_middle_of_a_record_leaves_it_absent_not_wrong(
    tmp_path: Path, full_disk: Callable[[int], None]
) -> None:
    """The policy is the first file too large: config and progress are there, the seal is not."""
    policy = {"weights": np.random.default_rng(0).normal(size=10_000)}
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        session.resume()
        session.rows = list(ROWS)
        full_disk(20_000)
        with pytest.raises(UserError, match="make room and repeat the command"):
            session.finish(policy)
        assert {path.name for path in session.folder.iterdir()} == {"config.json", "progress.csv"}
        assert not records.is_complete(session.folder)
        full_disk(resource.RLIM_INFINITY)
        session.finish(policy)
    records.verify_record(session.folder)
