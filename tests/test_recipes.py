"""The recipes of docs/your-own.md: what they say to write is written, what to run is run."""

from __future__ import annotations

import re
import shlex
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from safemr import cli, foreign_check, packages
from safemr.certificates import families
from safemr.experiment import catalogue

TEXT = (Path(__file__).resolve().parents[1] / "docs/your-own.md").read_text()
# The same training, smaller.
LESS = ["--steps", "1200", "--log-points", "1", "--eval-episodes", "1", "--set", "hidden=16"]
OFF_POLICY = ["--set", "start_steps=160", "--set", "batch_size=32"]
ON_POLICY = ["--set", "num_envs=4", "--set", "epoch_steps=600"]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder to work in, with my_package in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "my_package").mkdir()
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] == "my_package"]:
        del sys.modules[name]
    gymnasium.registry.pop("MyTask-v0", None)
    for remembered in (
        catalogue.load_algorithm, catalogue.declared_certificate, packages.registered,
        foreign_check._examined, families.named,
    ):  # fmt: skip
        getattr(remembered, "cache_clear", lambda: None)()


def write(name: str) -> None:
    """The first block of Python after the file's name."""
    found = re.search(rf"`my_package/{name}`.*?```python\n(.*?) *```", TEXT, re.DOTALL)
    assert found is not None
    Path("my_package", name).write_text(textwrap.dedent(found[1]))


def commands(program: str, about: str) -> list[list[str]]:
    """The arguments of each ``safemr program ...`` within a line that has these words."""
    found = re.findall(rf"`safemr ({program}\s[^`]*)`", TEXT)
    return [shlex.split(text) for text in found if about in text]


def test_the_environment(capsys: pytest.CaptureFixture[str]) -> None:
    write("__init__.py")
    (check, *_), (train,) = commands("check", "MyTask"), commands("train", "MyTask")
    assert cli.main(check) == 0
    assert f"ready: safemr {shlex.join(train[:5])}" in capsys.readouterr().out
    assert cli.main([*train, *LESS, *OFF_POLICY]) == 0
    assert list(Path("results/runs/MyTask/safemr").glob("seed*/policy.npz"))
    # d moves by its rate, and the disc is where the cost is.
    env = gymnasium.make("MyTask-v0", wind=0.1)
    _, info = env.reset(seed=0)
    costs = []
    for _ in range(40):
        before = info["d"][0]
        _, _, _, _, info = env.step(np.array([0.7, 0.0], np.float32))
        if before > 0.2:
            assert info["d"][0] - before == pytest.approx(0.1 * info["d_dot"][0], abs=0.01)
        costs.append(info["cost"])
        assert info["cost"] == (info["d"][0] < 0.3)
    assert set(costs) == {0.0, 1.0}


def test_the_algorithm(capsys: pytest.CaptureFixture[str]) -> None:
    write("my_algorithm.py")
    (check,) = commands("check-algorithm", "my_package")
    assert cli.main([*check, "--steps", "1200"]) == 0
    (listed,) = commands("list", "my_package")
    assert cli.main(listed) == 0
    assert "the meaning of a field is the comment behind it" in capsys.readouterr().out
    (train,) = commands("train", "my_algorithm")
    assert cli.main([*train, *LESS, *ON_POLICY]) == 0
    assert list(Path("results/runs/Pillars-0.15-Goal").glob("*/seed*/policy.npz"))


def test_the_certificate() -> None:
    write("my_family.py")
    (train,) = commands("train", "my_family")
    assert cli.main([*train, *LESS, *OFF_POLICY]) == 0
    (progress,) = Path("results/runs/Pillars-0.15-Goal/safemr").glob("seed*/progress.csv")
    header = progress.read_text().splitlines()[0].split(",")
    assert {"sigma", "t"} <= set(header)
