"""The copy to Weights & Biases: what it receives, and that its failures never reach the run."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from safemr.experiment.wandb_log import WandbLog

ROOT = Path(__file__).resolve().parents[1]
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
    with WandbLog(CONFIG, session, {"mode": mode, "project": "p"}) as log:
        log.log({"step": 20.0, "eval_return": 1.5})
        log.log({"step": 30.0, "eval_return": 2.5})
    return wandb


def test_rows_are_copied_grouped_by_task_and_algorithm(session, monkeypatch):
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


@pytest.mark.parametrize("mode", ["online", "offline"])
def test_a_missing_package_is_one_line_with_the_remedy(session, monkeypatch, capsys, mode):
    monkeypatch.setitem(sys.modules, "wandb", None)  # as where it is not installed
    with WandbLog(CONFIG, session, {"mode": mode, "project": "p"}) as log:
        log.log({"step": 20.0})
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: wandb is off for this run: the package is missing")
    assert 'pip install "safemr[wandb]"' in line


def test_a_broken_package_is_not_called_missing(session, monkeypatch, tmp_path, capsys):
    (tmp_path / "wandb.py").write_text("import a_module_that_nobody_has")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    with WandbLog(CONFIG, session, {"mode": "offline", "project": "p"}):
        pass
    assert "a_module_that_nobody_has" in capsys.readouterr().err


def test_the_package_is_an_extra_and_the_pipeline_installs_it():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert not [need for need in project["dependencies"] if need.startswith("wandb")]
    (need,) = project["optional-dependencies"]["wandb"]
    assert need.startswith("wandb>=")
    assert "\nwandb==" in (ROOT / "requirements.lock").read_text()
