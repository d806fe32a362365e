"""Records are complete or absent, checkpoints survive, and no file can run code."""

from __future__ import annotations

import json
import math
import os
import pickle
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from safemr import checkpoints, inspection, records
from safemr.checkpoints import RunLock, RunLockedError, RunSession
from safemr.errors import UserError
from safemr.records import RecordError

ROOT = Path(__file__).resolve().parents[1]
CONFIG: dict[str, Any] = {
    "schema": 1,
    "task": {"name": "Pillars-0.15-Goal", "version": 1, "settings": {}},
    "algorithm": {"name": "fac", "version": 1, "hyperparameters": {"gamma": 0.99}},
    "seed": 100,
    "steps": 20,
    "log_every": 10,
    "evaluation": {"every": 10, "episodes": 2, "seed": 10000},
}
ROWS = [
    {"step": step, "eval_return": 0.1, "eval_cost": 0.0, "eval_zero_violation_share": 1.0}
    for step in (10, 20)
]
POLICY = {"weights": np.arange(6.0, dtype=np.float32).reshape(2, 3)}


def make_record(root: Path, **changes: Any) -> Path:
    config = {**CONFIG, **changes}
    folder = root / records.record_path(config, "FAC-phih")
    records.write_record(folder, config, "FAC-phih", ROWS, {}, POLICY)
    return folder


@pytest.fixture
def record(tmp_path: Path) -> Path:
    return make_record(tmp_path)


# --- what is written is what is read ------------------------------------------------------------


def test_digest_is_of_the_meaning_not_the_spelling() -> None:
    shuffled = dict(reversed(list(CONFIG.items())))
    assert records.config_digest(shuffled) == records.config_digest(CONFIG)
    assert records.config_digest({**CONFIG, "seed": 101}) != records.config_digest(CONFIG)
    with pytest.raises(ValueError, match="JSON"):
        records.canonical_json({"x": math.nan})


def test_variant_labels_become_plain_folder_names() -> None:
    assert records.folder_name("SafeMR[0.45,0.15]") == "SafeMR-0.45-0.15"
    assert records.folder_name("FAC-phi0") == "FAC-phi0"


values = st.floats(allow_nan=True, allow_infinity=True)
rows_of_metrics = st.lists(
    st.dictionaries(st.sampled_from(["a", "b", "time_wall_s"]), values), min_size=1, max_size=5
)


@given(rows_of_metrics)
def test_progress_round_trips_exactly(metrics: list[dict[str, float]]) -> None:
    rows = [{"step": 10 * index, **row} for index, row in enumerate(metrics)]
    text = records.format_progress(rows)
    parsed = records.parse_progress(text)
    columns = sorted({name for row in metrics for name in row})
    for row, again in zip(rows, parsed, strict=True):
        assert list(again) == ["step", *columns]
        for name in columns:
            np.testing.assert_equal(again[name], row.get(name, math.nan))
    assert records.format_progress(parsed) == text


def test_a_written_record_is_verified_and_read(record: Path, tmp_path: Path) -> None:
    records.verify_record(record)
    runs, progress = records.read_records(tmp_path)
    assert runs.loc[0, ["task", "variant", "seed"]].tolist() == [
        "Pillars-0.15-Goal",
        "FAC-phih",
        100,
    ]
    assert list(progress) == ["task", "variant", "seed", "step", "metric", "value"]
    assert len(progress) == 6
    np.testing.assert_array_equal(
        records.load_policy(record / "policy.npz")["weights"], POLICY["weights"]
    )


def test_a_record_without_its_policy_is_complete(record: Path) -> None:
    (record / "policy.npz").unlink()
    records.verify_record(record)


# --- what must not be believed -------------------------------------------------------------------


def edit(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / name
        path.write_text(change(path.read_text()))

    return apply


def reseal(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    """An edit by someone who also mends the checksum."""

    def apply(folder: Path) -> None:
        edit(name, change)(folder)
        provenance = json.loads((folder / "provenance.json").read_text())
        digest = records.hashlib.sha256((folder / name).read_bytes()).hexdigest()
        provenance["files"][name] = digest
        (folder / "provenance.json").write_text(json.dumps(provenance))

    return apply


def reprovenance(**changes: Any) -> Callable[[Path], None]:
    return edit("provenance.json", lambda text: json.dumps({**json.loads(text), **changes}))


def append_row(*cells: str) -> Callable[[str], str]:
    return lambda text: text + ",".join(cells) + "\n"


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no provenance": (lambda f: (f / "provenance.json").unlink(), "provenance.json is missing"),
    "no progress": (lambda f: (f / "progress.csv").unlink(), "progress.csv is missing"),
    "no config": (lambda f: (f / "config.json").unlink(), "config.json is missing"),
    "truncated progress": (edit("progress.csv", lambda t: t[: len(t) // 2]), "checksum"),
    "empty progress": (edit("progress.csv", lambda t: ""), "checksum"),
    "edited number": (edit("progress.csv", lambda t: t.replace("0.1", "9.9")), "checksum"),
    "edited config": (edit("config.json", lambda t: t.replace("0.99", "0.9")), "checksum"),
    "resealed config": (reseal("config.json", lambda t: t.replace("0.99", "0.9")), "digest"),
    "truncated provenance": (edit("provenance.json", lambda t: t[:40]), "not JSON"),
    "provenance is a list": (edit("provenance.json", lambda t: "[]"), "lacks"),
    "another schema": (reprovenance(schema=2), "schema"),
    "unfinished": (reprovenance(status="running"), "complete"),
    "another digest": (reprovenance(digest="0" * 12), "digest"),
    "another variant": (reprovenance(variant="SafeMR"), "belongs to"),
    "no files": (reprovenance(files={}), "checksum"),
    "files is a list": (reprovenance(files=[]), "complete"),
    "foreign policy": (lambda f: (f / "policy.npz").write_bytes(b"x"), "checksum"),
    "no header": (reseal("progress.csv", lambda t: t.partition("\n")[2]), "header"),
    "header only": (reseal("progress.csv", lambda t: t.partition("\n")[0] + "\n"), "no rows"),
    "short row": (reseal("progress.csv", append_row("30", "1")), "cells"),
    "text in a row": (reseal("progress.csv", append_row("30", "a", "1", "1")), "not a number"),
    "steps fall": (reseal("progress.csv", append_row("15", "1", "1", "1")), "do not increase"),
    "step repeated": (reseal("progress.csv", append_row("20", "1", "1", "1")), "do not increase"),
    "ends early": (
        reseal("progress.csv", lambda t: "\n".join(t.splitlines()[:2]) + "\n"),
        "ends at step 10 of 20",
    ),
    "no evaluation": (
        reseal("progress.csv", lambda t: t.replace("eval_return", "train_return")),
        "no eval_return",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_damaged_record_is_refused_with_path_and_repair(
    name: str, record: Path, tmp_path: Path
) -> None:
    damage, expected = FAULTS[name]
    damage(record)
    for read in (
        lambda: records.verify_record(record),
        lambda: records.read_records(tmp_path, [record.relative_to(tmp_path)]),
    ):
        with pytest.raises(RecordError) as caught:
            read()
        message = str(caught.value)
        assert expected in message
        assert str(record) in message
        assert f"rm -r '{record}' && snakemake" in message
        assert "\n" not in message


def test_a_record_in_the_wrong_place_is_refused(record: Path, tmp_path: Path) -> None:
    other = make_record(tmp_path, seed=101)
    shutil.rmtree(other)
    shutil.copytree(record, other)
    with pytest.raises(RecordError, match="belongs to"):
        records.verify_record(other)


def test_writing_again_after_a_crash_in_between(record: Path, tmp_path: Path) -> None:
    (record / "provenance.json").unlink()  # the crash came before the last file
    assert not records.is_complete(record)
    make_record(tmp_path)
    records.verify_record(record)


def test_inspection_names_faults_and_unfinished_runs(
    record: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert inspection.main([str(tmp_path)]) == 0
    with RunSession({**CONFIG, "seed": 101}, "FAC-phih", tmp_path) as session:
        session.resume()
        session.fail("critic_loss became inf at step 10")
    edit("progress.csv", lambda t: "")(record)
    assert inspection.main([str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert str(record) in printed
    assert "FAC-phih Pillars-0.15-Goal seed 101" in printed
    assert "critic_loss became inf" in printed


# --- full disks ----------------------------------------------------------------------------------


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
    records.atomic_write(path, b"old")
    full_disk(100)
    with pytest.raises(OSError, match="File too large"):
        records.atomic_write(path, bytes(1000))
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


# --- checkpoints ---------------------------------------------------------------------------------

arrays = hnp.arrays(
    st.sampled_from([np.float64, np.float32, np.int64, np.int32, np.uint64, np.uint8, np.bool_]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)
plain = st.none() | st.booleans() | st.integers(-(2**130), 2**130) | st.floats() | st.text()
states = st.recursive(
    plain | arrays,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text() | st.integers(), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(states)
def test_checkpoints_round_trip(tmp_path_factory: pytest.TempPathFactory, state: Any) -> None:
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.pt"
    checkpoints.save(path, {"state": state})
    np.testing.assert_equal(checkpoints.load(path)["state"], state)


def test_generator_states_survive(tmp_path: Path) -> None:
    """NumPy's states hold integers of 128 bits."""
    generator = np.random.default_rng(7)
    checkpoints.save(tmp_path / "c.pt", {"rng": generator.bit_generator.state})
    again = np.random.default_rng(0)
    again.bit_generator.state = checkpoints.load(tmp_path / "c.pt")["rng"]
    assert again.random() == generator.random()


def test_a_state_that_cannot_be_saved_is_named(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"state\['envs'\]\[1\] is a set"):
        checkpoints.save(tmp_path / "c.pt", {"envs": [1, {2}]})
    assert not list(tmp_path.iterdir())


class Malicious:
    """Unpickling this creates a file."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.target),))


def test_no_file_can_run_code(tmp_path: Path) -> None:
    target = tmp_path / "hacked"
    policy, checkpoint = tmp_path / "policy.npz", tmp_path / "checkpoint.pt"
    np.savez(policy, allow_pickle=True, weights=np.array([Malicious(target)], dtype=object))
    torch.save({"state": Malicious(target)}, checkpoint)
    with pytest.raises(UserError, match=r"policy\.npz is not a readable policy"):
        records.load_policy(policy)
    with pytest.raises(UserError, match=r"checkpoint\.pt is not a readable checkpoint"):
        checkpoints.load(checkpoint)
    policy.write_bytes(pickle.dumps(Malicious(target)))
    with pytest.raises(UserError):
        records.load_policy(policy)
    assert not target.exists()


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.9])
def test_a_truncated_checkpoint_starts_the_run_again(
    keep: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=0) as session:
        session.resume()
        session.record(ROWS[0])
        session.maybe_checkpoint(lambda: {"x": torch.zeros(1000)})
    path = session.work / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        assert session.resume() is None
        assert session.rows == []
    assert "starting again from step 0" in capsys.readouterr().err


def test_checkpoints_cost_at_most_two_per_cent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a clock where writing takes 3 s and an interval 1 s."""
    clock = [0.0]
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: clock[0])
    written = []

    def state() -> dict[str, float]:
        clock[0] += 3.0
        written.append(clock[0])
        return {}

    with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=10) as session:
        session.resume()
        for _ in range(3000):
            clock[0] += 1.0
            session.maybe_checkpoint(state)
    assert len(written) >= 15
    assert 3.0 * len(written) <= 0.02 * clock[0] + 3.0


def test_a_finished_run_leaves_only_its_record(tmp_path: Path) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=0) as session:
        session.resume()
        for row in ROWS:
            session.record(row)
            session.maybe_checkpoint(dict)
        session.finish(POLICY)
    records.verify_record(session.folder)
    assert not session.work.exists()
    provenance = json.loads((session.folder / "provenance.json").read_text())
    assert {"commit", "dirty", "started", "step"} <= provenance["attempts"][0].keys()
    assert provenance["peak_rss_mb"] > 10
    with RunSession(CONFIG, "FAC-phih", tmp_path) as again:
        assert again.complete


# --- one process a run ---------------------------------------------------------------------------

HOLDER = """
import sys, time
from pathlib import Path
from safemr.checkpoints import RunLock
RunLock(Path(sys.argv[1])).acquire(wait=False)
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
    with pytest.raises(RunLockedError, match=f"process {owner.pid}") as caught, session:
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
    with RunSession(CONFIG, "FAC-phih", tmp_path, wait=True):
        assert owner.wait(5) == -signal.SIGKILL
    os.waitpid(pid, 0)
    assert f"waiting for process {owner.pid}" in capsys.readouterr().err


def test_a_lock_whose_file_was_removed_does_not_count(tmp_path: Path) -> None:
    first, second = RunLock(tmp_path / "lock"), RunLock(tmp_path / "lock")
    first.acquire(wait=False)
    (tmp_path / "lock").unlink()
    second.acquire(wait=False)
    third = RunLock(tmp_path / "lock")
    with pytest.raises(RunLockedError):
        third.acquire(wait=False)
    first.release()
    second.release()
    third.acquire(wait=False)
    third.release()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_leads_to_a_checkpoint_and_an_exit(number: int, tmp_path: Path) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        session.resume()
        session.record(ROWS[0])
        os.kill(os.getpid(), number)
        with pytest.raises(SystemExit) as caught:
            session.maybe_checkpoint(lambda: {"x": 1})
    assert caught.value.code == 128 + number
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        assert session.resume() == {"x": 1}


def test_an_orphan_stops_with_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path, die_with_parent=True) as session:
        session.resume()
        session.record(ROWS[0])
        session.maybe_checkpoint(lambda: {"x": 1})  # the parent lives: nothing is due
        assert not (session.work / "checkpoint.pt").exists()
        monkeypatch.setattr(os, "getppid", lambda: 1)
        with pytest.raises(SystemExit):
            session.maybe_checkpoint(lambda: {"x": 2})
    assert checkpoints.load(session.work / "checkpoint.pt")["state"] == {"x": 2}
