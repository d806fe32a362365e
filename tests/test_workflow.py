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
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from safemr.experiment import config, overview, planning, records
from safemr.experiment.locks import ProcessLock

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

    def plan(self) -> planning.Plan:
        """The plan of the checkout, by this repository's own sources."""
        return planning.resolve(config.load([self.folder / "config/config.yaml"]))

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

    def scheduled(self, *arguments: str, targets: Sequence[str] = ("all",)) -> dict[str, int]:
        """Rule -> number of jobs of a dry run."""
        printed = self.snakemake("-n", *targets, *arguments)
        table = printed.partition("Job stats:")[2].partition("total")[0]
        return {name: int(count) for name, count in re.findall(r"^(\w+) +(\d+)$", table, re.M)}

    def fill_in_records(self, root: Path | None = None) -> None:
        """A record for every run of the plan, without training."""
        for run in self.plan().runs:
            rows = [
                {
                    **{"step": step, "eval_return": 1.0, "eval_cost": 0.0},
                    **{"eval_cost_indicator": 0.0, "eval_zero_violation_share": 1.0},
                    **({"sigma": 0.3, "k": 1.0, "n": 2.0} if run.variant == "SafeMR" else {}),
                }
                for step in (run.config["steps"] // 2, run.config["steps"])
            ]
            folder = (root or self.folder / "results") / run.path
            records.write_record(folder, run.config, run.variant, rows, {"cpu_s": 60.0})


@pytest.fixture
def checkout(tmp_path: Path) -> Iterator[Checkout]:
    copy = Checkout(tmp_path)
    copy.configure()
    return copy
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


def test_a_record_that_came_after_the_plan_is_kept(checkout: Checkout) -> None:
    """A job that waited while another made its record (the orphan of a killed Snakemake on a
    cluster, a person) finds it: what begins then is this call, as of any job on a cluster."""
    checkout.fill_in_records()
    record = checkout.folder / "results" / checkout.plan().trained[0].path
    before = {path.name: path.read_bytes() for path in record.iterdir()}
    wanted = str((record / records.PROGRESS).relative_to(checkout.folder))
    printed = checkout.snakemake("--force", wanted)
    assert "already recorded" in printed
    assert {path.name: path.read_bytes() for path in record.iterdir()} == before
    assert "train" not in checkout.scheduled()


def test_a_record_of_an_outside_program_that_came_after_the_plan_is_kept(
    checkout: Checkout,
) -> None:
    checkout.configure(outside={"CEM": {"algorithm": "cross_entropy", "steps": 4000}})
    checkout.fill_in_records()
    record = checkout.folder / "results" / checkout.plan().outside[0].path
    before = {path.name: path.read_bytes() for path in record.iterdir()}
    checkout.snakemake("--force", str((record / records.PROGRESS).relative_to(checkout.folder)))
    assert {path.name: path.read_bytes() for path in record.iterdir()} == before


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


def test_an_edit_makes_again_what_depends_on_it_and_only_that(checkout: Checkout) -> None:
    checkout.fill_in_records()
    made = ("table_1", "curves", "illustrations")
    checkout.snakemake(*made)

    def edited(*sources: str) -> dict[str, int]:
        """What is scheduled after an edit, which is taken back."""
        paths = [checkout.folder / source for source in sources]
        before = [(path, path.read_text(), path.stat().st_mtime) for path in paths]
        for path, text, _ in before:
            path.write_text(text + "# edited\n")
        jobs = checkout.scheduled(targets=made)
        for path, text, time_ in before:
            path.write_text(text)
            os.utime(path, (time_, time_))
        return jobs

    algorithms = (
        "safemr/algorithms/fac.py",
        "safemr/learning/off_policy.py",
        "safemr/report/claims.py",
    )
    assert edited(*algorithms) == {}
    drawing = ("safemr/report/figures/certificate.py", "safemr/report/differences.py")
    assert edited(*drawing) == {"illustrations": 1, "table_1": 1}
    of_records = dict.fromkeys(("aggregate", "controllers", "table_1", "curves"), 1)
    assert edited("safemr/experiment/records.py") == of_records
    assert checkout.scheduled(targets=made) == {}


def test_a_policy_that_comes_or_goes_is_noticed(checkout: Checkout) -> None:
    """policy.npz is optional in a record and hence no input of what flies it."""
    checkout.fill_in_records()
    record = next(run for run in checkout.plan().runs if run.variant == "SafeMR")
    policy = checkout.folder / "results" / record.path / records.POLICY
    target = "results/summary/rollouts/Pillars-0.15-Goal.npz"
    checkout.snakemake(target)
    assert checkout.scheduled(targets=[target]) == {}
    policy.write_bytes(b"")
    assert checkout.scheduled(targets=[target]) == {"rollouts": 1}
    policy.unlink()
    assert checkout.scheduled(targets=[target]) == {}


def test_a_clone_draws_everything_once_and_then_nothing(checkout: Checkout) -> None:
    """Without Snakemake's memory it cannot be known that a tracked picture is current.

    As `git clone` and an archive have it: the scripts are not older than any output.
    """
    checkout.fill_in_records()
    made = ("table_1", "curves")
    checkout.snakemake(*made)
    shutil.rmtree(checkout.folder / ".snakemake")
    tracked = [*checkout.folder.glob("results/**/*"), *checkout.folder.glob("paper_figures/*")]
    for path in [*tracked, *checkout.folder.rglob("*.py")]:
        os.utime(path, (1.7e9, 1.7e9))
    before = {path: path.read_bytes() for path in tracked if path.suffix in (".md", ".png", ".csv")}
    (checkout.folder / "results/summary/progress.csv.gz").unlink()  # is not tracked
    everything = {"aggregate": 1, "controllers": 1, **dict.fromkeys(made, 1)}
    assert checkout.scheduled(targets=made) == everything
    checkout.snakemake(*made)
    assert {path: path.read_bytes() for path in before} == before
    assert checkout.scheduled(targets=made) == {}


def test_another_configuration_that_is_not_made_is_told_before_anything_is_trained(
    checkout: Checkout,
) -> None:
    """`sizes.beside`: the rule that reads its files comes last, after hours of training."""
    protocol = {"unseen_layouts": {"episodes": 4, "seed": 12345}, "results_root": "results/here"}
    checkout.configure(**protocol, sizes={"beside": "results/there"})
    file = Path("results/there/summary/unseen_layouts", f"{TASK}.csv")
    (checkout.folder / file.parent).mkdir(parents=True)
    (checkout.folder / "results/there/summary/sizes.csv").touch()
    said = f"warning: sizes.beside: {file} is missing; make the results under results/there first"
    assert said in checkout.snakemake("-n", "all")
    (checkout.folder / file).touch()
    assert "sizes.beside" not in checkout.snakemake("-n", "all")


def test_adding_a_baseline_is_one_file_and_one_line(checkout: Checkout) -> None:
    checkout.fill_in_records()
    algorithms = checkout.folder / "safemr/algorithms"
    (algorithms / "my_baseline.py").write_text((algorithms / "fac.py").read_text())
    path = checkout.folder / "config/config.yaml"
    line = "algorithms:\n  Mine: {algorithm: my_baseline, gamma: 0.97, start_steps: 200}\n"
    path.write_text(path.read_text().replace("algorithms:\n", line))
    jobs = checkout.scheduled()
    assert jobs["train"] == len(GRID["tasks"]) * len(GRID["seeds"])
    # The tests take it as it is; once it has records, its behaviour must be on record too.
    shutil.copytree(ROOT / "tests", checkout.folder / "tests")
    command = [sys.executable, "-m", "pytest", "-q", "tests/test_fingerprints.py", "-k", "my_base"]
    (record, *_) = (checkout.folder / "results/runs").glob("*/FAC-phi0/seed*/config.json")
    for content, outcome in (
        (record.read_text(), "1 skipped"),
        (json.dumps({"algorithm": {"name": "my_baseline"}}), "runs of my_baseline are recorded"),
    ):
        record.write_text(content)
        done = subprocess.run(command, cwd=checkout.folder, capture_output=True, text=True)
        assert outcome in done.stdout, done.stdout + done.stderr


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


def test_on_a_cluster_training_alone_is_a_job() -> None:
    """What makes records asks for memory and time, and is tried again when the user says so."""
    text = "".join(path.read_text() for path in sorted((ROOT / "workflow/rules").glob("*.smk")))
    rules = {rule.partition(":")[0][5:]: rule for rule in re.split(r"(?m)^(?=rule )", text)[1:]}
    jobs = {name for name, rule in rules.items() if "{RECORD}/" in rule}
    listed = (ROOT / "Snakefile").read_text().partition("localrules:\n")[2].partition("\n\n")[0]
    assert set(re.findall(r"\w+", listed)) == rules.keys() - jobs | {"all"}
    assert jobs == {"train", "cross_entropy"}
    for name in jobs:
        assert re.search(r"(?m)^    resources:\n        \*\*TRAINING,$", rules[name]), name
    assert "retries:" not in text


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


def names_of(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


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


def test_what_another_workflow_left_in_the_same_folder_stays(checkout: Checkout) -> None:
    """Recovery clears what this workflow makes; other files and locks are their owners'."""
    checkout.fill_in_records()
    own = checkout.folder / "mapped/reads.bam"
    own.parent.mkdir()
    own.write_text("days of work")
    mark = marker(checkout, "mapped/reads.bam")
    lock_outputs(checkout)
    lock = checkout.folder / ".snakemake/locks/1.output.lock"
    lock.write_text("mapped/reads.bam\n")
    checkout.snakemake("aggregate", "-n")
    assert names_of(lock.parent) == {"1.output.lock"}, "ours is cleared, theirs is not"
    checkout.snakemake("aggregate")  # which clears all locks at its own end
    assert own.read_text() == "days of work"
    assert mark.exists()
    assert (checkout.folder / "results/summary/runs.csv").exists()


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
    # Nothing is left to do, also when the training rule's text or the copy to wandb changes.
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
    """The rest of the grid goes on, the failure is not tried again, not with --retries either,
    until a new Snakemake is started; and the summary names it."""
    diverging = {"algorithm": "safemr", "target_entropy": 1.386, "temperature_lr": 1.0}
    diverging["start_steps"] = 200
    checkout.configure(seeds=[100], algorithms={"Lost": diverging, **GRID["algorithms"]})
    printed = checkout.snakemake("all", "--keep-going", "--retries", "2", check=False)
    assert printed.count("error: Lost Pillars-0.15-Goal seed 100 diverged before") == 2
    recorded = {run.variant for run in checkout.plan().runs
                if records.is_complete(checkout.folder / "results" / run.path)}  # fmt: skip
    assert recorded == set(GRID["algorithms"])
    assert printed.count("error: Lost Pillars-0.15-Goal seed 100: ") == 1
    (line,) = overview.unfinished(checkout.folder / "results")
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


@pytest.fixture
def odd(tmp_path: Path) -> Checkout:
    """A checkout in a path that needs quotes."""
    folder = tmp_path / 'it\'s "a" $HOME é\\d'
    folder.mkdir()
    copy = Checkout(folder)
    copy.configure()
    return copy


def test_a_path_that_needs_quotes(odd: Checkout) -> None:
    """Tables are drawn by scripts, runs are trained by a shell command."""
    odd.configure(seeds=[100], log_points=2)
    odd.fill_in_records()
    shutil.rmtree(odd.folder / "results" / odd.plan().runs[0].path)
    odd.snakemake("aggregate")
    assert (odd.folder / "results/summary/runs.csv").read_text().count("\n") == 3


@pytest.mark.parametrize("name", ["a b", "it's", "$HOME", "a;b"])
def test_an_interpreter_that_needs_quotes_is_refused_at_once(
    name: str, checkout: Checkout, monkeypatch: pytest.MonkeyPatch
) -> None:
    environment = checkout.folder / name
    environment.symlink_to(sys.prefix)
    monkeypatch.setattr(sys, "executable", str(environment / "bin/python"))
    (line,) = checkout.snakemake("-n", "all", check=False).splitlines()
    assert line.startswith(f"error: Snakemake cannot call an interpreter in {environment}: ")
    assert not (checkout.folder / "results").exists()


def test_a_colon_in_the_path_is_one_line(tmp_path: Path) -> None:
    folder = tmp_path / "a:b"
    folder.mkdir()
    copy = Checkout(folder)
    (line,) = copy.snakemake("-n", "all", check=False).splitlines()
    assert line == f"error: PYTHONPATH cannot hold {folder}: move it to a path without ':'"


@pytest.mark.parametrize(
    ("blocked", "arguments"), [(".snakemake", ("-n", "all")), ("results/.work", ("aggregate",))]
)
def test_what_cannot_be_written_is_one_line(
    blocked: str, arguments: tuple[str, ...], checkout: Checkout
) -> None:
    """A file in place of the folder: nobody can write there, the superuser neither."""
    checkout.fill_in_records()
    (checkout.folder / blocked).touch()
    (line,) = checkout.snakemake(*arguments, check=False).splitlines()
    assert line.startswith(f"error: cannot write in {checkout.folder}, ")
    assert blocked in line


def test_a_run_finds_its_own_packages_in_any_folder(checkout: Checkout) -> None:
    checkout.configure(seeds=[100], log_points=2)
    elsewhere = checkout.folder / "elsewhere"
    for name in ("envs", "safemr"):
        (elsewhere / name).mkdir(parents=True)
        (elsewhere / name / "__init__.py").write_text("raise ImportError('not that one')\n")
    run = checkout.plan().runs[0]
    target = f"results/{run.path}/provenance.json"
    checkout.snakemake("--directory", str(elsewhere), target)
    records.verify_record(elsewhere / "results" / run.path)
