"""The example of an environment of one's own: it means what it says, and can be trained on."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest

import safemr
from safemr import cli

FOLDER = Path(__file__).resolve().parents[1] / "examples/unicycle"
ID = "unicycle_discs:UnicycleDiscs-v1"


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(FOLDER))


def test_distances_have_their_rates_and_contacts_their_cost() -> None:
    env = gymnasium.make(ID)
    _, info = env.reset(seed=0)
    for _ in range(149):
        before = info["d"]
        observation, _, _, _, info = env.step(np.array([1.0, 0.3]))
        # One step of 0.1 s: the rate is that of the step that led here, where no disc turned.
        straight = (np.abs(env.unwrapped.discs) < 1.97).all(1)  # type: ignore[attr-defined]
        moved = (info["d"] - before)[straight]
        np.testing.assert_allclose(moved, 0.1 * info["d_dot"][straight], atol=0.02)
        assert observation.shape == env.observation_space.shape
        assert info["cost"] == (info["d"].min() < 0.35)
    assert 2 <= len(info["d"]) <= 4


def test_it_knows_nothing_of_safemr() -> None:
    assert "import safemr" not in (FOLDER / "unicycle_discs.py").read_text()


def test_it_is_ready_and_trains(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", ID]) == 0
    assert f"ready: safemr train --task {ID}" in capsys.readouterr().out
    record = safemr.train(
        ID, steps=640, out=tmp_path, log_points=2, eval_episodes=2, quiet=True,
        start_steps=160, batch_size=32, hidden=16, interface={"action_repeat": 2},
    )  # fmt: skip
    assert record.rows[-1]["eval_length"] == 150
    assert record.provenance["exact_resume"] is False
    assert record.policy().act(np.zeros(19)).shape == (2,)
