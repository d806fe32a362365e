"""Algorithms of other packages: named, checked, trained and recorded without an edit here."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml

from safemr import cli, packages
from safemr.errors import UserError
from safemr.experiment import catalogue, check_algorithm, config, planning, train
from safemr.experiment.plan_cache import plan_for
from safemr.experiment.record import Record

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples/pid_lagrangian"
NAME = "pid_lagrangian.ppo"
SMALL = {"num_envs": 4, "hidden": 16, "epoch_steps": 600, "value_batch": 200}


def forget() -> None:
    """What is remembered of packages and algorithms."""
    catalogue.load_algorithm.cache_clear()
    catalogue.declared_certificate.cache_clear()
    packages.registered.cache_clear()
    importlib.invalidate_caches()


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a package `mine` on the path of this process."""
    folder = tmp_path / "packages/mine"
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(folder.parent))
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "mine"]:
        del sys.modules[name]
    forget()


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    yield importlib.import_module(NAME)
    forget()


def test_the_controller_by_hand(example: Any) -> None:
    """Costs 10, 20, 0 with a limit of 5: errors 5, 15, -5, integrals 5, 20, 15."""
    settings = example.Config(k_p=1.0, k_i=0.1, k_d=10.0, smoothing=0.0, multiplier_max=116.0)
    controller, values = example.Controller(settings), []
    for cost in (10.0, 20.0, 0.0):
        controller.update(cost, 5.0)
        values.append(controller.value)
    assert values == pytest.approx([5.0 + 0.5, 116.0, 0.0])  # 15 + 2 + 100 is capped, -5 + 1.5 not
    assert controller.integral == 15.0
    smooth = example.Controller(example.Config(k_p=1.0, k_i=0.0, k_d=10.0, smoothing=0.5))
    for cost in (10.0, 20.0):
        smooth.update(cost, 5.0)
    assert smooth.value == pytest.approx((5.0 + 15.0) / 2 + 10.0 * (15.0 - 10.0))


def test_the_example_keeps_the_contract(example: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check-algorithm", NAME, "--steps", "1200"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["ok"] * 6 + [f"{NAME},"]
    with pytest.raises(UserError, match="ppo does not use multiplier_lr"):
        catalogue.hyperparameters(catalogue.load_algorithm(NAME), {"multiplier_lr": 0.1}, "it")


def test_it_keeps_the_contract_on_an_environment_from_outside_too(
    example: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whose episodes a resumed run begins anew, and whose normalisation is in its state."""
    monkeypatch.syspath_prepend(str(ROOT / "examples/unicycle"))
    task = "unicycle_discs:UnicycleDiscs-v1"
    found = list(check_algorithm.check(NAME, task, SMALL, steps=1200))
    assert [checked.fault for checked in found] == [""] * 6


def test_a_run_says_where_its_algorithm_comes_from(example: Any, tmp_path: Path) -> None:
    settings = [f"--set={name}={value}" for name, value in SMALL.items()]
    status = train.main(
        ["--task", "Aircraft", "--algorithm", NAME, "--variant", "PID", "--steps", "1200",
         "--log-points", "2", "--eval-episodes", "1", "--out", str(tmp_path), *settings]
    )  # fmt: skip
    assert status == 0
    (folder,) = tmp_path.glob("runs/Aircraft/PID/*")
    record = Record.open(folder)
    said = record.config["algorithm"]
    assert (said["name"], said["version"], said["package"]) == (NAME, 1, "pid_lagrangian")
    assert "k_p" in said["hyperparameters"]
    origin = record.provenance["algorithm"]
    assert origin["module"] == NAME
    assert origin["sources"] == packages.digest(NAME)
    assert record.rows[-1]["multiplier"] >= 0.0
    with pytest.raises(UserError, match="has no energy function"):
        record.certificate()
    assert record.policy().transform.dim > 0


def test_a_configuration_names_it_and_notices_its_edits(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = 'from safemr.algorithms.fac import VERSION, Config, Trainer\nCERTIFICATE = "energy"\n'
    (package / "own.py").write_text(source)
    raw = yaml.safe_load((ROOT / "config/config.yaml").read_text())
    raw |= {"tasks": ["Aircraft"], "seeds": [0], "sensitivity": None, "aircraft": None}
    raw |= {"task_overrides": {}, "unseen_layouts": None, "protocol": 1, "sizes": False}
    monkeypatch.chdir(tmp_path)

    def plan(algorithms: dict[str, Any]) -> planning.Plan:
        catalogue.load_algorithm.cache_clear()
        return plan_for(config.parse({**raw, "algorithms": algorithms}))

    own, ours = {"algorithm": "mine.own"}, {"algorithm": "fac"}
    (run, here) = plan({"Own": own, "FAC": ours}).trained
    assert run.config["algorithm"] == {
        **here.config["algorithm"], "name": "mine.own", "package": "mine",
    }  # fmt: skip
    assert "package" not in here.config["algorithm"]
    assert catalogue.declared_certificate("mine.own") == "energy"
    (package / "own.py").write_text(source + "VERSION = 2\n")
    del sys.modules["mine.own"]
    assert plan({"Own": own, "FAC": ours}).trained[0].config["algorithm"]["version"] == 2
    # An entry point is another way to write the same run.
    point = metadata.EntryPoint("shorter", "mine.own", packages.ALGORITHMS)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [point])
    packages.registered.cache_clear()
    (shorter,) = plan({"Own": {"algorithm": "shorter"}}).trained
    assert shorter.digest == plan({"Own": own}).trained[0].digest
    monkeypatch.undo()


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("mine.nothing", None, "there is no module mine.nothing.*install its package.*PYTHONPATH"),
        ("yours.own", None, "there is no module yours, of which yours.own is asked for"),
        ("mine.broken", "1 / 0", "mine.broken does not import: ZeroDivisionError"),
        ("mine.needs", "import absent_package", "mine.needs does not import: ModuleNotFound.*abse"),
        ("mine.empty", "", "mine.empty must define VERSION"),
        ("mine.text", "VERSION, Config, Trainer = '1', 0, 0", "mine.text: VERSION must be an int"),
        ("mine.plain", "VERSION, Config, Trainer = 1, 0, 0", "mine.plain: Config must be a datacl"),
        ("zzz", None, "unknown algorithm 'zzz'.*one of yours is named by its module"),
        ("sfaemr", None, "did you mean 'safemr'.$"),
    ],
)
def test_what_is_wrong_with_a_module_is_one_line(
    package: Path, name: str, text: str | None, says: str
) -> None:
    if text is not None:
        (package / f"{name.partition('.')[2]}.py").write_text(text)
    with pytest.raises(UserError, match=says) as caught:
        catalogue.load_algorithm(name, "algorithms.Mine")
    assert "\n" not in str(caught.value)


def test_ours_have_one_name() -> None:
    assert catalogue.load_algorithm("safemr.algorithms.fac").name == "fac"
    assert catalogue.load_algorithm("fac").package is None


def test_the_package_of_a_record_may_be_missing(tmp_path: Path) -> None:
    algorithm = {"name": "gone.own", "version": 1, "package": "gone", "hyperparameters": {}}
    record = Record(tmp_path, {"algorithm": algorithm}, {}, [{"step": 1}])
    with pytest.raises(UserError, match="there is no module gone"):
        record.certificate()


BROKEN = {
    "draw from generators": """
    def update_policy(self, batch):
        self.actor.network.parameters.data += 1e-3 * torch.rand(())
        return super().update_policy(batch)
""",
    "its state lacks something": """
    def update_policy(self, batch):
        self.count = getattr(self, "count", 0) + 1
        self.actor.network.parameters.data += 1e-3 * self.count
        return super().update_policy(batch)
""",
    "add infos": """
    def _collect(self):
        found = super()._collect()
        self.step += self.config.num_envs * (self.interface.action_repeat > 1)
        return found
""",
    "a checkpoint cannot hold": """
    def state_dict(self):
        return {**super().state_dict(), "odd": object()}
""",
    "x: say its interval in RANGES": """
@dataclass(frozen=True)
class Config(ppo_lagrangian.Config):
    x: float = 1.0  # a number
""",
}


@pytest.mark.parametrize("says", BROKEN)
def test_a_broken_promise_is_found_and_explained(package: Path, says: str) -> None:
    (package / "own.py").write_text(
        "from dataclasses import dataclass\nimport torch\n"
        "from safemr.algorithms import ppo_lagrangian\n"
        "from safemr.algorithms.ppo_lagrangian import Config\nVERSION = 1\n"
        f"class Trainer(ppo_lagrangian.Trainer):\n    pass\n{BROKEN[says]}"
    )
    *kept, last = check_algorithm.check("mine.own", settings={"value_batch": 200}, steps=1200)
    assert says in last.fault
    assert not any(checked.fault for checked in kept)
    assert "\n" not in last.fault


def test_provenance_names_what_is_installed() -> None:
    found = packages.provenance("yaml.nodes")
    assert found["distributions"].keys() == {"PyYAML"}
    assert json.dumps(found)
