"""Training that diverges stops at once and says what, where and when; the others go on."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from safemr import inspection, train

TASK, SHORT = "Hazards-0.15-Push", ("task.max_episode_steps=50", "hidden=16")
DIVERGING = {
    "fac": ("critic_lr=1e25", "start_steps=100", "batch_size=32"),
    "safemr": ("policy_lr=1e30", "start_steps=100", "batch_size=32"),
    "ppo_lagrangian": ("value_lr=1e30", "epoch_steps=320"),
}


@pytest.mark.parametrize("name", DIVERGING)
def test_a_diverging_run_ends_in_one_line_and_is_named(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [word for value in (*SHORT, *DIVERGING[name]) for word in ("--set", value)]
    arguments = ["--task", TASK, "--algorithm", name, "--steps", "4000", "--eval-episodes", "1"]
    lines = []
    for _ in range(2):  # what is deterministic fails again in the same way
        assert train.main([*arguments, *settings, "--out", str(tmp_path)]) == 4
        lines.append(capsys.readouterr().err.splitlines()[-1])
    assert lines[0] == lines[1]
    assert re.fullmatch(
        rf"error: {name} {TASK} seed 100: (\w+) became (nan|-?inf) at step \d+; "
        r"last good log point: step \d+; no checkpoint yet",
        lines[0],
    )
    assert not list(tmp_path.glob("runs/*/*/*"))
    assert inspection.main([str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert f"{name} {TASK} seed 100" in printed
    assert "failed: " in printed
