"""The pipeline: what is scheduled, what is never trained again, and what happens after a kill."""

from __future__ import annotations

import base64
import fcntl
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from safemr import config, inspection, records, runs
from safemr.locks import ProcessLock

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("Snakefile", "config", "envs", "safemr", "workflow")
TASK = "Pillars-0.15-Goal"
GRID: dict[str, Any] = {
    "tasks": ["Pillars-0.15-Goal"],
    "algorithms": {
        "SafeMR": {"algorithm": "safemr", "start_steps": 200},
        "FAC-phi0": {"algorithm": "fac", "sigma": 0.0, "k": 0.0, "n": 1.0, "start_steps": 200},
    },
    "seeds": [100, 101],
    "budget": {"off_policy": 2000},
    "log_points": 20,
    "evaluation": {"points": 2, "episodes": 1},
    "task_overrides": {},
    "sensitivity": None,
    "aircraft": None,
}


class Checkout:
    """A temporary copy of the repository's sources, with a small grid as its default."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[subprocess.Popen[str]] = []
        for name in SOURCES:
            source, target = ROOT / name, folder / name
            if source.is_dir():
                shutil.copytree(source, target)  # compiled code too: it saves half a minute
            else:
                shutil.copy(source, target)

    def configure(self, **changes: Any) -> None:
        (self.folder / "config/config.yaml").write_text(
            yaml.safe_dump({**GRID, **changes}, sort_keys=False)
        )

    def plan(self) -> runs.Plan:
        """The plan of the checkout, by this repository's own sources."""
        return runs.resolve(config.load([self.folder / "config/config.yaml"]))

    def start(self, *arguments: str, log: str | None = None) -> subprocess.Popen[str]:
        """Snakemake in a process group of its own, as a terminal would start it."""
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        environment.pop("PYTHONPATH", None)
        with open(self.folder / log if log else os.devnull, "a") as stream:
            process = subprocess.Popen(
                [sys.executable, "-m", "snakemake", "-j2", *arguments],
                cwd=self.folder,
                env=environment,
                text=True,
                stdout=stream if log else subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self.started.append(process)
        return process

    def snakemake(self, *arguments: str, check: bool = True) -> str:
        process = self.start(*arguments)
        printed, _ = process.communicate(timeout=600)
        assert (process.returncode == 0) == check, printed
        return printed

    def scheduled(self, *arguments: str) -> dict[str, int]:
        """Rule -> number of jobs of a dry run."""
        printed = self.snakemake("-n", "all", *arguments)
        table = printed.partition("Job stats:")[2].partition("total")[0]
        return {name: int(count) for name, count in re.findall(r"^(\w+) +(\d+)$", table, re.M)}

    def fill_in_records(self, root: Path | None = None) -> None:
        """A record for every run of the plan, without training."""
        for run in self.plan().runs:
            rows = [
                {
                    **{"step": step, "eval_return": 1.0, "eval_cost": 0.0},
                    **{"eval_cost_indicator": 0.0, "eval_zero_violation_share": 1.0},
                }
                for step in (run.config["steps"] // 2, run.config["steps"])
            ]
            folder = (root or self.folder / "results") / run.path
            records.write_record(folder, run.config, run.variant, rows, {"cpu_s": 60.0})


@pytest.fixture
def checkout(tmp_path: Path) -> Iterator[Checkout]:
    copy = Checkout(tmp_path)
    copy.configure()
    yield copy
    for process in copy.started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def test_the_shipped_default_schedules_every_run_once(tmp_path: Path) -> None:
    copy = Checkout(tmp_path)
    assert copy.scheduled()["train"] == len(copy.plan().trained)


def test_a_fresh_clone_trains_only_what_changed(checkout: Checkout) -> None:
    """Git sets modification times in any order, and a clone has no Snakemake metadata."""
    checkout.fill_in_records()
    generator = random.Random(3)
    for path in checkout.folder.rglob("*"):
        os.utime(path, (generator.uniform(1e9, 1.7e9),) * 2)
    assert "train" not in checkout.scheduled()

    other = {**GRID["algorithms"]["SafeMR"], "gamma": 0.98}
    changed = {**GRID["algorithms"], "SafeMR": other}
    checkout.configure(algorithms=changed)
    assert checkout.scheduled()["train"] == 2
    checkout.configure()
    assert checkout.scheduled("--config", "seeds=[100,102]")["train"] == 2
    # A version bump of the algorithm that others build on touches only those who share its file.
    module = checkout.folder / "safemr/algorithms/fac.py"
    module.write_text(re.sub(r"(?m)^VERSION = \d+$", "VERSION = 999", module.read_text()))
    assert checkout.scheduled()["train"] == 2


def test_what_is_recorded_can_be_drawn_without_training(checkout: Checkout) -> None:
    allow = ("--config", "allow_missing=true")
    assert "none of the configured runs" in checkout.snakemake("-n", "all", *allow, check=False)
    checkout.fill_in_records()
    lost = checkout.plan().runs[0]
    shutil.rmtree(checkout.folder / "results" / lost.path)
    assert checkout.scheduled()["train"] == 1
    checkout.snakemake("table_1", *allow)
    table = (checkout.folder / "results/tables/table1.md").read_text()
    assert f"Runs missing: {lost.variant} on {lost.task} (seed" in table


def test_adding_a_baseline_is_one_file_and_one_line(checkout: Checkout) -> None:
    checkout.fill_in_records()
    algorithms = checkout.folder / "safemr/algorithms"
    (algorithms / "my_baseline.py").write_text((algorithms / "fac.py").read_text())
    path = checkout.folder / "config/config.yaml"
    line = "algorithms:\n  Mine: {algorithm: my_baseline, gamma: 0.97, start_steps: 200}\n"
    path.write_text(path.read_text().replace("algorithms:\n", line))
    jobs = checkout.scheduled()
    assert jobs["train"] == len(GRID["tasks"]) * len(GRID["seeds"])


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"sedes": [1]}, "unknown key 'sedes' in the config; did you mean 'seeds'?"),
        ({"algorithms": {"X": {"algorithm": "safmr"}}}, "did you mean 'safemr'?"),
    ],
)
def test_a_wrong_config_stops_snakemake_with_one_line(
    changes: dict[str, Any], expected: str, checkout: Checkout
) -> None:
    checkout.configure(**changes)
    before = set(checkout.folder.iterdir())
    (line,) = checkout.snakemake("-n", "all", check=False).splitlines()
    assert line.startswith("error: ")
    assert expected in line
    assert set(checkout.folder.iterdir()) - before <= {checkout.folder / ".snakemake"}


def test_every_rule_states_log_and_threads() -> None:
    for path in sorted((ROOT / "workflow/rules").glob("*.smk")):
        for rule in re.split(r"(?m)^(?=rule )", path.read_text())[1:]:
            name = rule.partition(":")[0]
            assert re.search(r"(?m)^    log:", rule), f"{path.name}: {name} has no log"
            assert re.search(r"(?m)^    threads: ", rule), f"{path.name}: {name} has no threads"


def marker(checkout: Checkout, output: str) -> Path:
    """Snakemake's mark that an output was being written."""
    folder = checkout.folder / ".snakemake/incomplete"
    folder.mkdir(parents=True, exist_ok=True)
    name = base64.urlsafe_b64encode(output.encode()).decode()
    parts = [name[i : i + 254] for i in range(0, len(name), 254)]
    path = folder.joinpath(*(f"@{part}" for part in parts[:-1]), parts[-1])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('{"external_jobid": null}')
    return path


def lock_outputs(checkout: Checkout) -> None:
    """The lock that a killed Snakemake leaves."""
    folder = checkout.folder / ".snakemake/locks"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "0.output.lock").write_text("results/summary/runs.csv\n")


def test_what_a_killed_snakemake_leaves_needs_no_manual_step(checkout: Checkout) -> None:
    checkout.fill_in_records()
    record = checkout.plan().runs[0].path
    provenance = f"results/{record}/provenance.json"
    half_written = checkout.folder / "results/summary/runs.csv"
    half_written.parent.mkdir()
    half_written.write_text("half")
    lock_outputs(checkout)
    marks = [marker(checkout, provenance), marker(checkout, "results/summary/runs.csv")]
    before = (checkout.folder / provenance).read_bytes()
    checkout.snakemake("aggregate")
    assert not any(mark.exists() for mark in marks)
    assert (checkout.folder / provenance).read_bytes() == before
    assert half_written.read_text().startswith("task,")


def test_a_live_snakemake_keeps_its_lock(checkout: Checkout) -> None:
    checkout.fill_in_records()
    lock_outputs(checkout)
    with open(checkout.folder / ".snakemake/alive", "w") as stream:
        fcntl.flock(stream, fcntl.LOCK_SH)
        assert "cannot be locked" in checkout.snakemake("aggregate", check=False)


def test_a_record_that_cannot_be_believed_stops_the_aggregation(checkout: Checkout) -> None:
    checkout.fill_in_records()
    folder = Path("results") / checkout.plan().runs[1].path
    progress = checkout.folder / folder / "progress.csv"
    progress.write_text(progress.read_text().replace("1.0", "9.0"))
    printed = checkout.snakemake("aggregate", check=False)
    fault = f"error: record {folder}: progress.csv does not have the checksum"
    assert sum(line.startswith(fault) for line in printed.splitlines()) == 1
    assert "Traceback" not in printed
    assert not (checkout.folder / "results/summary/runs.csv").exists()


def begun(checkout: Checkout) -> bool:
    """Whether a run has written its first progress and none has finished."""
    return bool(list(checkout.folder.glob("results/.work/*/progress.csv")))


def wait_until(condition: Any, *arguments: Any, seconds: float = 240) -> None:
    end = time.monotonic() + seconds
    while not condition(*arguments):
        assert time.monotonic() < end, f"{condition.__name__} did not come true"
        time.sleep(0.05)


def test_from_nothing_to_figures_across_a_kill(checkout: Checkout) -> None:
    """SIGKILL to Snakemake in the middle of training; the same command ends with every figure."""
    checkout.configure(seeds=[100])
    started = checkout.start("all", log="first.log")
    wait_until(begun, checkout)
    started.kill()
    started.wait()
    checkout.snakemake("all")
    for run in checkout.plan().runs:
        records.verify_record(checkout.folder / "results" / run.path)
    assert not list(checkout.folder.glob("results/.work/*/*"))
    for name in ("paper_figures/training_curves.pdf", "results/tables/table1.md"):
        assert (checkout.folder / name).stat().st_size > 500
    # Nothing is left to do, also when the training rule's text or the mirror changes.
    rule = checkout.folder / "workflow/rules/train.smk"
    rule.write_text(rule.read_text().replace("--wait", "--wait "))
    checkout.configure(seeds=[100], wandb={"mode": "offline"})
    assert checkout.scheduled() == {}


def test_a_second_snakemake_waits_for_the_first(checkout: Checkout) -> None:
    checkout.fill_in_records()
    root = checkout.folder / "results"
    first = ProcessLock(root / ".work/snakemake.lock", "holds the results")
    first.acquire(wait=False)
    second = checkout.start("aggregate", log="second.log")
    log = checkout.folder / "second.log"
    wait_until(lambda: "makes the files under results" in log.read_text())
    assert "train" not in checkout.scheduled()  # a dry run touches nothing and need not wait
    assert not (root / "summary").exists()
    first.release()
    assert second.wait(240) == 0
    assert log.read_text().startswith(f"waiting for process {os.getpid()} on ")
    assert (root / "summary/runs.csv").exists()


@pytest.mark.slow
def test_two_snakemakes_at_once_train_every_run_once(checkout: Checkout) -> None:
    checkout.configure(seeds=[100])
    both = [checkout.start("aggregate", log=f"{name}.log") for name in ("first", "second")]
    assert [process.wait(600) for process in both] == [0, 0]
    logs = [(checkout.folder / f"{name}.log").read_text() for name in ("first", "second")]
    assert sum(log.startswith("waiting for process") for log in logs) == 1
    assert sum("Nothing to be done" in log for log in logs) == 1
    for run in checkout.plan().runs:
        folder = checkout.folder / "results" / run.path
        records.verify_record(folder)
        assert len(json.loads((folder / "provenance.json").read_text())["attempts"]) == 1


def test_roots_outside_the_repository(tmp_path: Path) -> None:
    """Records, lock, logs and tables lie under ../..., figures under an absolute path."""
    (tmp_path / "here").mkdir()
    checkout = Checkout(tmp_path / "here")
    checkout.configure(
        results_root="../away/results", figures_root=f"{tmp_path}/drawn", seeds=[100], tasks=[TASK]
    )
    away = tmp_path / "away/results"
    assert checkout.scheduled()["train"] == 2
    checkout.fill_in_records(away)
    assert "train" not in checkout.scheduled()
    checkout.snakemake("../away/results/tables/results.md", f"{tmp_path}/drawn/training_curves.png")
    assert "SafeMR" in (away / "tables/results.md").read_text()
    assert (tmp_path / "drawn/training_curves.png").stat().st_size > 1000
    assert (away / ".work/snakemake.lock").exists()
    assert (away / "logs/aggregate.log").exists()
    assert not (checkout.folder / "results").exists()
    assert not (checkout.folder / "paper_figures").exists()


@pytest.mark.slow
def test_a_diverging_run_stops_alone(checkout: Checkout) -> None:
    """The rest of the grid goes on, the failure is not tried again, and the summary names it."""
    diverging = {"algorithm": "safemr", "target_entropy": 1.386, "temperature_lr": 1.0}
    diverging["start_steps"] = 200
    checkout.configure(seeds=[100], algorithms={"Lost": diverging, **GRID["algorithms"]})
    printed = checkout.snakemake("all", "--keep-going", check=False)
    recorded = {run.variant for run in checkout.plan().runs
                if records.is_complete(checkout.folder / "results" / run.path)}  # fmt: skip
    assert recorded == set(GRID["algorithms"])
    assert printed.count("error: Lost Pillars-0.15-Goal seed 100: ") == 1
    (line,) = inspection.unfinished(checkout.folder / "results")
    assert line.startswith("Lost Pillars-0.15-Goal seed 100")
    assert "failed: " in line


KILLS = {
    **{number.name: number for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)},
    "Ctrl-C": -signal.SIGINT,  # to the whole process group, as a terminal does
}


@pytest.mark.slow
@pytest.mark.parametrize("number", KILLS.values(), ids=KILLS)
def test_many_kills_of_snakemake(number: int, checkout: Checkout) -> None:
    """Kills at random moments, the orphans included in what may go wrong."""
    checkout.configure(seeds=[100], budget={"off_policy": 10_000})
    generator, begun = random.Random(number), time.monotonic()
    checkout.scheduled()
    unit = time.monotonic() - begun  # how long Snakemake needs to begin, on this machine now
    kills = 0
    while kills < 6:
        process = checkout.start("aggregate", log="killed.log")
        try:
            assert process.wait(generator.uniform(0.5, 4.0) * unit) == 0
            break  # it was faster than the kills
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, -number) if number < 0 else process.send_signal(number)
            process.wait(1200)
            kills += 1
    assert kills > 0
    checkout.snakemake("aggregate")
    for run in checkout.plan().runs:
        records.verify_record(checkout.folder / "results" / run.path)
    assert not list(checkout.folder.glob("results/.work/*/*"))
