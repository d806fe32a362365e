"""Golden parity: recorded Safety Gym trajectories are reproduced step by step."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from envs.golden import ERRORS, GoldenFileError, load, main, passes, replay

COPIED = Path(__file__).parent / "data" / "golden"
FULL_SET = Path(
    os.environ.get("SAFEMR_GOLDEN") or Path(__file__).parents[2] / "shared" / "golden"
).resolve()


def trajectories() -> list[Path]:
    """The copied recordings, and all others of the full set where that is present."""
    files = {path.name: path for path in FULL_SET.rglob("*-*-*_seed*.npz")}
    files |= {path.name: path for path in COPIED.glob("*_seed*.npz")}
    return [files[name] for name in sorted(files)]


@pytest.mark.parametrize("path", trajectories(), ids=lambda path: path.stem)
def test_replay_reproduces_the_recording(path: Path) -> None:
    errors = replay(load(path))
    assert errors["goal_met"] == 0
    assert {name: errors[name] for name in ERRORS if not errors[name] <= 1e-9} == {}
    assert errors["state"] == 0.0  # the physics agrees to the last bit


def test_the_copied_recordings_hold_every_kind_of_event() -> None:
    recordings = [load(path) for path in sorted(COPIED.glob("*_seed*.npz"))]
    assert len(recordings) == 4
    events = ("goal_met", "cost_authors", "n_sphere_pillar", "n_arrow_pillar", "n_arrow_box")
    for event in events:
        assert sum(np.count_nonzero(recording[event]) for recording in recordings) > 0, event


def test_sleep_keeps_the_physics() -> None:
    errors = replay(load(COPIED / "Hazards-0.15-Push_seed01.npz"), sleep=True)
    assert errors["goal_met"] == 0
    assert 0 < errors["observation"] < 1e-7
    assert errors["reward"] < 1e-7


@pytest.mark.parametrize("quantity", ["qpos", "obs", "reward", "cost_authors", "sis", "goal_met"])
def test_a_falsified_recording_is_noticed(quantity: str) -> None:
    recording = load(COPIED / "Pillars-0.15-Goal_seed07.npz")
    recording = {name: array[:20] if len(array.shape) and len(array) == 300 else array
                 for name, array in recording.items()}  # fmt: skip
    assert passes(replay(recording))
    falsified = recording[quantity].copy()
    falsified[10] = ~falsified[10] if falsified.dtype == bool else falsified[10] + 1
    assert not passes(replay(recording | {quantity: falsified}))


def test_nan_does_not_pass() -> None:
    errors = dict.fromkeys((*ERRORS, "goal_met"), 0.0)
    assert passes(errors)
    assert not passes(errors | {"reward": float("nan")})


def test_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    file = str(COPIED / "Pillars-0.30-Goal_seed05.npz")
    assert main([file, str(COPIED / "layouts.npz")]) == 0
    assert "passed" in capsys.readouterr().out
    assert main([file, "--tolerance", "1e-30"]) == 1
    assert "FAILED" in capsys.readouterr().out


def test_unusable_files_give_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truncated = tmp_path / "truncated.npz"
    shutil.copy(COPIED / "Pillars-0.30-Goal_seed05.npz", truncated)
    truncated.write_bytes(truncated.read_bytes()[:50_000])
    incomplete = tmp_path / "incomplete.npz"
    np.savez(incomplete, action=np.zeros((3, 2)))
    for path in (tmp_path / "absent.npz", truncated, incomplete, tmp_path):
        assert main([str(path)]) == 2
        message = capsys.readouterr().err
        assert message.startswith("error: ")
        assert str(path) in message
        assert message.count("\n") == 1
    with pytest.raises(GoldenFileError, match="no such file"):
        load(tmp_path / "absent.npz")
