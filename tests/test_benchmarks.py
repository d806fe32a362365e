"""The benchmarks run: each is a program that nothing else calls, and so breaks unseen."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from benchmarks import peers, peers_cases, training
from safemr.errors import UserError

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("algorithm", ["safemr", "ppo_lagrangian"])
def test_the_parts_of_a_configured_run_are_timed(algorithm: str) -> None:
    task = "Hazards-0.30-Push"
    settings = training.settings_of(ROOT / "config" / "second_pilot.yaml", task)[algorithm]
    assert settings["interface"]["action_repeat"] == 5
    if algorithm == "ppo_lagrangian":
        short = {"epoch_steps": 800, "value_passes": 1, "policy_passes": 1}
        settings = settings | {"hyperparameters": settings["hyperparameters"] | short}
    settings = settings | {"decisions": 256}
    rows = training.measure(algorithm, task, 1, 2_000, settings)
    by_backend = training.cases(rows)
    assert {backend for _, backend in by_backend} == set(training.BACKENDS)
    for parts in by_backend.values():
        spent = {row["part"]: row["ms"] for row in parts}
        assert spent["environment"] > 0.0
        assert spent["critic step"] > 0.0
        assert sum(row["floor_ms"] for row in parts[:-1]) == parts[-1]["floor_ms"] > 0.0
    assert "| measured / floor |" in training.summary(rows)


class Stand:
    """A subject whose n-th block takes ``slow`` times n seconds for a hundred of something."""

    def __init__(self, name: str, slow: float, log: list[str]) -> None:
        self.versions = {"stand": "1"}
        self.name, self.slow, self.log, self.blocks = name, slow, log, 0

    def block(self) -> dict[str, Any]:
        self.blocks += 1
        self.log.append(self.name)
        spent = self.slow * self.blocks
        return {"count": 100, "parts": {"update": 0.75 * spent, "gathering": 0.25 * spent}}

    def close(self) -> None:
        self.log.append(f"{self.name} closed")


def test_blocks_take_turns_and_compare_within_a_round() -> None:
    log: list[str] = []

    def case(name: str, slow: float, against: str = "") -> peers_cases.Case:
        return peers_cases.Case(name, lambda: Stand(name, slow, log), against=against)

    rows = peers.in_turn("updates", [case("theirs", 0.8), case("ours", 0.1, "theirs")], 3)
    assert log == ["theirs", "ours"] * 4 + ["theirs closed", "ours closed"]
    ours = {row["quantity"]: row["value"] for row in rows if row["case"] == "ours"}
    # The first block is not counted; the median of the others is the third, 0.3 s for a hundred.
    assert ours == {
        "per second": pytest.approx(100 / 0.3, rel=1e-4),
        "ms": pytest.approx(3.0),
        "gathering": pytest.approx(0.75),
        "update": pytest.approx(2.25),
        "times as fast": pytest.approx(8.0),
    }
    lines = peers.markdown(rows).splitlines()
    assert lines[1] == "| updates | per second | ms | gathering | update | times as fast |"
    assert lines[4] == "| ours | 333.3 | 3 | 0.75 | 2.25 | 8 |"


def test_a_return_is_first_reached_and_the_run_ends_there_or_at_a_limit() -> None:
    class Learns(Stand):
        def block(self) -> dict[str, Any]:
            self.blocks += 1
            found = {1: 3.0, 2: 15.5, 3: 9.0}[self.blocks]
            return {"steps": 1_000, "cpu_s": 90.0, "return": found}

    def passage(threshold: float, steps: int = 3_000, minutes: float = 60.0) -> dict[str, float]:
        curve = peers.limited(Learns("", 0.0, []), steps, minutes)
        return peers.first_passage(curve, threshold)

    reached = {"reached": 1.0, "core-minutes": 3.0, "steps": 2_000, "best return": 15.5}
    assert passage(15.0) == reached
    never = {"reached": 0.0, "core-minutes": 4.5, "steps": 3_000, "best return": 15.5}
    assert passage(16.0) == never
    assert passage(15.0, steps=1_000) == passage(15.0, minutes=1.5)
    assert passage(15.0, steps=1_000)["best return"] == 3.0


@pytest.fixture
def stand_in(tmp_path: Path) -> Callable[[str], Path]:
    """Makes a program that stands for the Python of a peer."""

    def made(body: str) -> Path:
        path = tmp_path / "python"
        path.write_text(f"#!{sys.executable}\nimport json, sys\n{body}\n")
        path.chmod(0o755)
        return path

    return made


def test_a_peer_answers_block_by_block_and_its_failure_is_a_line(
    stand_in: Callable[[str], Path],
) -> None:
    answers = """
settings = json.loads(sys.argv[3])
print(json.dumps({"versions": {"theirs": settings["version"]}}), flush=True)
sys.stdin.readline()
print(json.dumps({"count": 2}), flush=True)
sys.stdin.readline()
print("they say why", file=sys.stderr)
"""
    peer = peers_cases.Peer("sb3", stand_in(answers), version="7")
    assert peer.versions == {"theirs": "7"}
    assert peer.block() == {"count": 2}
    with pytest.raises(UserError, match=r"^Stable-Baselines3 ended: they say why$"):
        peer.block()


@pytest.mark.parametrize("package", ["omnisafe", "sb3"])
def test_what_is_missing_is_said_with_how_to_make_it(
    package: str, stand_in: Callable[[str], Path], tmp_path: Path
) -> None:
    part = {"omnisafe": "epochs", "sb3": "learning"}[package]
    how = rf"; make an environment with .* of benchmarks/peers_{package}.txt, and give its bin/"
    with pytest.raises(UserError, match=f"^--{package}-python: is not given{how}"):
        peers.main(["--parts", part])
    for python in (tmp_path / "nothing", stand_in("sys.exit(1)")):
        with pytest.raises(UserError, match=f"^--{package}-python: {python}[: ].*{how}"):
            peers.main(["--parts", part, f"--{package}-python", str(python)])
    commands = (ROOT / "benchmarks" / f"peers_{package}.txt").read_text()
    assert peers_cases.DISTRIBUTIONS[package] in commands
    with pytest.raises(UserError, match=r"none of this part's; they are: .*update every 8"):
        peers.main(["--parts", "learning", "--cases", "no such"])


def test_what_was_measured_is_written(tmp_path: Path) -> None:
    rows = peers.described("updates", "ours", "", {"ms": 1 / 3}, {"torch": "2", "numpy": "3"}, 5)
    peers.write(rows, tmp_path / "rows.csv")
    with (tmp_path / "rows.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["value"] == "0.33333"
    assert row["versions"] == "torch=2 numpy=3"
    assert row["cpu"]
    assert row["date"][:2] == "20"
    assert peers.measured([tmp_path / "rows.csv"]) == [{**row, "value": 0.33333}]


@pytest.mark.parametrize("part", peers.PARTS)
def test_the_tables_of_what_was_measured_are_the_programs(
    part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = ROOT / "benchmarks/measured"
    assert peers.main(["--show", str(kept / f"peers_{part}.csv")]) == 0
    assert capsys.readouterr().out.strip() == (kept / f"peers_{part}.md").read_text().strip()


def test_what_is_no_file_of_measurements_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    for name in ("other.csv", "missing.csv"):
        with pytest.raises(UserError, match=f"--show: .*{name} is no file of this program's"):
            peers.main(["--show", str(tmp_path / name)])
