"""The copy to Weights & Biases: what it receives, and that its failures never reach the run."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from safemr.experiment.wandb_log import Mirror

CONFIG = {"task": {"name": "Pillars-0.15-Goal"}, "seed": 100}


class Wandb(SimpleNamespace):
    """Stands in for the package: remembers calls, and fails where it is told to."""

    def __init__(self, fails: str = "") -> None:
        super().__init__(calls=[], fails=fails)

    def _call(self, name: str, /, **kwargs) -> None:
        self.calls.append((name, kwargs))
        if name == self.fails:
            raise RuntimeError(f"no {name}\nsecond line")

    def init(self, **kwargs) -> Wandb:
        self._call("init", **kwargs)
        return self

    def log(self, row, step) -> None:
        self._call("log", row=row, step=step)

    def finish(self, exit_code) -> None:
        self._call("finish", exit_code=exit_code)


@pytest.fixture
def session(tmp_path):
    return SimpleNamespace(
        work=tmp_path / ".work" / "abc", digest="abc", variant="SafeMR", rows=[{"step": 10.0}]
    )


def run(session, monkeypatch, fails: str = "", mode: str = "offline") -> Wandb:
    wandb = Wandb(fails)
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    with Mirror(CONFIG, session, {"mode": mode, "project": "p"}) as mirror:
        mirror.log({"step": 20.0, "eval_return": 1.5})
        mirror.log({"step": 30.0, "eval_return": 2.5})
    return wandb


def test_rows_are_mirrored_grouped_by_task_and_algorithm(session, monkeypatch):
    wandb = run(session, monkeypatch)
    names = [name for name, _ in wandb.calls]
    assert names == ["init", "log", "log", "log", "finish"]
    settings = wandb.calls[0][1]
    assert settings["group"] == "Pillars-0.15-Goal/SafeMR"
    assert (settings["mode"], settings["project"]) == ("offline", "p")
    # what is offline must outlive the run's working folder
    assert str(session.work) not in settings["dir"]
    assert [kwargs["step"] for name, kwargs in wandb.calls if name == "log"] == [10, 20, 30]


@pytest.mark.parametrize("fails", ["init", "log", "finish"])
def test_a_failure_is_told_once_and_stops_nothing(session, monkeypatch, capsys, fails):
    run(session, monkeypatch, fails)
    assert capsys.readouterr().err.splitlines() == [
        f"warning: wandb is off for this run: no {fails}"
    ]


def test_disabled_never_touches_the_package(session, monkeypatch):
    assert run(session, monkeypatch, mode="disabled").calls == []
