"""Checkpoints hold the whole state, cost little, run no code, and are there when a run stops."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import socket
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from sample_record import CONFIG, POLICY, ROWS

from safemr import files
from safemr.errors import UserError
from safemr.experiment import checkpoints, provenance, records
from safemr.experiment.checkpoints import RunSession
from safemr.experiment.train import Progress

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


@settings(deadline=None)
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
        files.policy_arrays(policy)
    with pytest.raises(UserError, match=r"checkpoint\.pt is not a readable checkpoint"):
        checkpoints.load(checkpoint)
    policy.write_bytes(pickle.dumps(Malicious(target)))
    with pytest.raises(UserError):
        files.policy_arrays(policy)
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
    assert 3.0 * len(written) <= 0.02 * clock[0]


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy], ids=["array", "tensor"])
def test_the_order_in_memory_survives(kind: Any, tmp_path: Path) -> None:
    """A resumed run's products round as before only if their operands lie as before."""
    cube = np.arange(24.0).reshape(2, 3, 4)
    states = {
        "C": np.array(cube),
        "Fortran": np.asfortranarray(cube),
        "axes exchanged": cube.transpose(1, 0, 2).copy(order="K"),
        "columns of a row": np.arange(5.0)[None][:, [1, 3]],
        "one column": np.asfortranarray(np.ones((4, 1))),
    }
    checkpoints.save(tmp_path / "c.pt", {name: kind(array) for name, array in states.items()})
    again = checkpoints.load(tmp_path / "c.pt")
    for name, array in states.items():
        found = np.asarray(again[name])
        assert found.strides == array.strides, name
        assert np.array_equal(found, array), name


def test_parts_of_arrays_keep_the_order_of_their_axes(tmp_path: Path) -> None:
    table = np.asfortranarray(np.arange(40.0).reshape(8, 5))
    parts = {"rows": table[::2], "backwards": table[::-1]}
    checkpoints.save(tmp_path / "c.pt", parts)
    again = checkpoints.load(tmp_path / "c.pt")
    assert again["rows"].strides == (8, 32)
    assert again["backwards"].strides == (8, 64)
    for name, array in again.items():
        assert np.array_equal(array, parts[name])


def test_a_checkpoint_of_another_format_is_not_continued(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Those of earlier versions lost the order of arrays in memory."""
    with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=0) as session:
        session.resume()
        content = {"rows": ROWS, "elapsed": {"wall_s": 1.0, "cpu_s": 1.0}, "state": {}}
        torch.save(checkpoints.encode(content), session.work / "checkpoint.pt")
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        assert session.resume() is None
    assert "step 0: " in (told := capsys.readouterr().err)
    assert "was written by another version of this program" in told


def test_a_part_of_a_large_tensor_is_saved_as_small_as_it_is(tmp_path: Path) -> None:
    """torch saves all the memory behind a slice: a replay buffer that is nearly empty, for one."""
    large = torch.arange(1_000_000.0)
    checkpoints.save(tmp_path / "c.pt", {"part": large[:10], "columns": large.view(1000, -1)[:2].T})
    assert (tmp_path / "c.pt").stat().st_size < 20_000
    again = checkpoints.load(tmp_path / "c.pt")
    assert again["part"].equal(large[:10])
    assert again["columns"].equal(large.view(1000, -1)[:2].T)


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


@pytest.mark.parametrize("variable", ["SLURM_JOB_ID", "PBS_JOBID", "LSB_JOBID"])
def test_each_attempt_says_where_it_ran(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The processor always; host and job only of a scheduler's job, since records are published."""
    for name in ("SLURM_JOB_ID", "PBS_JOBID", "LSB_JOBID"):
        monkeypatch.delenv(name, raising=False)
    for number in (None, "71", "72"):
        if number:
            monkeypatch.setenv(variable, number)
        with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
            session.resume()
    here, *jobs = checkpoints.read_attempts(session.work)
    assert here["cpu"] == provenance.cpu_model()
    assert not {"host", "job"} & here.keys()
    assert [(job["job"], job["host"]) for job in jobs] == [
        (number, socket.gethostname()) for number in ("71", "72")
    ]


def test_a_failure_is_told_until_the_next_attempt(tmp_path: Path) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        assert session.failure() is None
        session.resume()
        assert session.failure() is None
        session.fail("the loss is nan")
        assert session.failure() == "the loss is nan"
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        assert session.failure() == "the loss is nan"
        session.resume()
        assert session.failure() is None


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


def test_a_gone_reader_does_not_stop_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C also reaches the `tee` behind standard error, which then is a broken pipe."""
    reader, writer = os.pipe()
    os.close(reader)
    with contextlib.suppress(BrokenPipeError), os.fdopen(writer, "w") as gone:
        with pytest.raises(BrokenPipeError):
            print("anybody?", file=gone, flush=True)
        monkeypatch.setattr(sys, "stderr", gone)
        with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
            session.resume()
            os.kill(os.getpid(), signal.SIGINT)
            session.record(ROWS[0])
            Progress("run", 20, gone).show({**ROWS[0], "time_steps_per_s": 1.0})
            with pytest.raises(SystemExit) as caught:
                session.maybe_checkpoint(lambda: {"x": 1})
    assert caught.value.code == 128 + signal.SIGINT
    assert checkpoints.load(session.work / "checkpoint.pt")["state"] == {"x": 1}


def test_a_torn_note_of_an_attempt_spoils_only_itself(tmp_path: Path) -> None:
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        session.resume()
    notes = session.work / checkpoints.ATTEMPTS
    notes.write_text(notes.read_text()[:30])
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        session.resume()
        assert [event["step"] for event in checkpoints.read_attempts(session.work)] == [0]
        session.rows = list(ROWS)
        session.finish(None)
    provenance = json.loads((session.folder / "provenance.json").read_text())
    assert provenance["started"] == provenance["attempts"][0]["started"]


def test_a_kill_in_the_middle_of_a_checkpoint(tmp_path: Path) -> None:
    """What a killed write leaves is removed by the next attempt: two checkpoints at most."""
    with RunSession(CONFIG, "FAC-phih", tmp_path, minimum_interval=0) as session:
        session.resume()
        session.record(ROWS[0])
        session.maybe_checkpoint(lambda: {"x": torch.zeros(100)})
    pid = os.fork()
    if pid == 0:
        with (
            RunSession(CONFIG, "FAC-phih", tmp_path),
            files.replacing(session.work / "checkpoint.pt") as stream,
        ):
            stream.write(b"half")
            stream.flush()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)
    (leftover,) = session.work.glob("*.tmp")
    assert leftover.read_bytes() == b"half"
    with RunSession(CONFIG, "FAC-phih", tmp_path) as session:
        state = session.resume()
        assert state is not None
        assert state["x"].shape == (100,)
        assert not list(session.work.glob("*.tmp"))
