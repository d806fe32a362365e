"""The pipeline on a real Slurm cluster, two nodes on this machine: records as of local runs."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from kills import outcome, starts
from slurm_cluster import Job, SlurmCluster, lacking, until
from test_workflow import ROOT, Checkout

from safemr.experiment import config, planning
from safemr.experiment.checkpoints import read_attempts

PLUGINS = ("snakemake_executor_plugin_slurm", "snakemake_executor_plugin_cluster_generic")
ABSENT = [name for name in PLUGINS if importlib.util.find_spec(name) is None]
REASON = lacking() or (f'no {", ".join(ABSENT)}: pip install -e ".[cluster]"' if ABSENT else "")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(REASON), reason=REASON)]


class Head:
    """Snakemake on the cluster's head, as ``make.py cluster`` calls it, in a checkout."""

    def __init__(self, checkout: Checkout, cluster: SlurmCluster, *arguments: str) -> None:
        self.log = checkout.folder / "head.log"
        variables = {**cluster.environment, "OMP_NUM_THREADS": "1"}
        variables.pop("PYTHONPATH", None)
        with open(self.log, "a") as stream:
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", "snakemake", *arguments],
                cwd=checkout.folder,
                env=variables,
                stdout=stream,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
        checkout.started.append(self.process)

    def finish(self, seconds: float = 5400) -> str:
        """What it printed, after it succeeded."""
        status = self.process.wait(seconds)
        printed = self.log.read_text()
        assert status == 0, printed[-20_000:]
        return printed


PROFILE = ("--profile", "workflow/profiles/slurm")


@pytest.fixture
def checkout(tmp_path: Path) -> Iterator[Checkout]:
    (tmp_path / "shared").mkdir()
    copy = Checkout(tmp_path / "shared")
    yield copy
    for process in copy.started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[SlurmCluster]:
    with SlurmCluster(tmp_path / "slurm") as running:
        yield running


def attempts(root: Path, run: planning.Run) -> list[dict[str, Any]]:
    provenance = json.loads((root / run.path / "provenance.json").read_text())
    return [event for event in provenance["attempts"] if "started" in event]


def assert_equal_records(checkout: Checkout, runs: Sequence[planning.Run], *which: str) -> None:
    """The records are byte for byte those that local runs make; ``which``: the configuration."""
    root = "results/smoke" if which else "results"
    local = checkout.start("aggregate", *which, "--config", "results_root=local", log="local.log")
    assert local.wait(5400) == 0, (checkout.folder / "local.log").read_text()
    for run in runs:
        here, there = (checkout.folder / name for name in ("local", root))
        assert outcome(run, there) == outcome(run, here), run.path
        name = run.path / "config.json"
        assert (there / name).read_bytes() == (here / name).read_bytes()


def test_the_smoke_configuration_on_two_nodes(checkout: Checkout, cluster: SlurmCluster) -> None:
    """Every run is a job, every other rule local; a run says on which node it was."""
    smoke = ("--configfile", "config/smoke.yaml")
    printed = Head(checkout, cluster, *PROFILE, "all", *smoke).finish()
    files = [checkout.folder / f"config/{name}.yaml" for name in ("config", "smoke")]
    plan = planning.resolve(config.load(files))
    submitted = re.findall(r"submitted with SLURM jobid (\d+)", printed)
    assert len(submitted) == len(plan.trained)
    hosts, numbers = set(), set()
    for run in plan.trained:
        (attempt,) = attempts(checkout.folder / "results/smoke", run)
        hosts.add(attempt["host"])
        numbers.add(attempt["job"])
        assert attempt["cpu"]
    assert numbers == set(submitted)
    assert len(hosts) == (2 if cluster.separate else 1)
    assert checkout.scheduled(*smoke) == {}
    assert_equal_records(checkout, plan.runs, *smoke)


ROWS = 200


class Trial:
    """A grid on a cluster, watched from outside."""

    def __init__(self, checkout: Checkout, cluster: SlurmCluster) -> None:
        self.root, self.cluster = checkout.folder / "results", cluster
        self.runs = checkout.plan().runs

    def rows(self, run: planning.Run) -> int:
        """How many log points an unfinished run has behind it."""
        try:
            return (self.root / ".work" / run.digest / "progress.csv").read_text().count("\n") - 1
        except FileNotFoundError:
            return 0

    def begun(self, run: planning.Run) -> int:
        """How many attempts an unfinished run has behind it, the present one included."""
        try:
            return len(read_attempts(self.root / ".work" / run.digest))
        except FileNotFoundError:
            return 0

    def saved(self, run: planning.Run) -> bool:
        return (self.root / ".work" / run.digest / "checkpoint.pt").exists()

    def strike(self, what: str, ready: Callable[[planning.Run], bool]) -> tuple[planning.Run, Job]:
        """Wait for a run that trains and is ready to be struck; says which it is."""
        found: list[tuple[planning.Run, Job]] = []

        def is_found() -> bool:
            jobs = [job for job in self.cluster.jobs() if job.state == "RUNNING"]
            found[:] = [
                (run, job)
                for run in self.runs
                for job in jobs
                if run.digest in job.comment and ready(run)
            ]
            return bool(found)

        until(is_found, f"a run for {what}", 1800)
        (run, job), *_ = found
        print(f"{what}: {run.variant} seed {run.config['seed']}, job {job.number} on {job.node}, "
              f"after {self.rows(run)} of {ROWS} rows", flush=True)  # fmt: skip
        return run, job

    def ended(self, job: Job, state: str) -> None:
        """Wait until Slurm calls a job ended in this way."""
        same = (job.number, state)
        until(lambda: same in {j[:2] for j in self.cluster.jobs()}, f"{job}: {state}", 600)


def test_every_kind_of_kill(checkout: Checkout, cluster: SlurmCluster) -> None:
    """scancel, a node's death, a time limit and `kill -9` of Snakemake: records as of whole runs,
    and nothing trained twice but what no checkpoint held."""
    checkout.configure(budget={"off_policy": 120_000}, log_points=ROWS)
    head = Head(checkout, cluster, *PROFILE, "aggregate")
    trial = Trial(checkout, cluster)

    cancelled, job = trial.strike("scancel", lambda run: 5 < trial.rows(run) < ROWS / 2)
    cluster.tell("scancel", job.number)
    trial.ended(job, "CANCELLED")

    def may_be_lost(run: planning.Run) -> bool:
        behind = trial.rows(run)
        return run != cancelled and behind < 0.8 * ROWS and (trial.saved(run) or behind > ROWS / 2)

    lost, job = trial.strike("death of a node", may_be_lost)
    kept = trial.saved(lost)
    cluster.crash(job.node)
    trial.ended(job, "NODE_FAIL")
    cluster.start(job.node)

    _, job = trial.strike("time limit", lambda run: run == cancelled and trial.begun(run) == 2)
    cluster.tell("scontrol", "update", f"JobId={job.number}", "EndTime=now+5seconds")
    trial.ended(job, "TIMEOUT")

    trial.strike("kill -9 of Snakemake", lambda run: trial.rows(run) > 0)
    os.killpg(head.process.pid, signal.SIGKILL)
    head.process.wait()
    head = Head(checkout, cluster, *PROFILE, "aggregate")

    head.finish()
    for run in trial.runs:
        steps, jobs = starts(run, trial.root), {a["job"] for a in attempts(trial.root, run)}
        print(f"{run.variant} seed {run.config['seed']}: attempts from steps {steps}", flush=True)
        assert len(jobs) == len(steps)
        assert len(steps) == (3 if run == cancelled else 2 if run == lost else 1)
        assert all(step > 0 for step in steps[1:] if run != lost or kept)
    assert checkout.scheduled(targets=["aggregate"]) == {}
    assert_equal_records(checkout, trial.runs)


def test_any_scheduler_by_its_commands(checkout: Checkout, cluster: SlurmCluster) -> None:
    """The generic executor with the profile and the status script of docs/cluster.md; a job that
    is cancelled continues."""
    folder = checkout.folder / "workflow/profiles/generic"
    folder.mkdir()
    document = (ROOT / "docs/cluster.md").read_text()
    for name in ("config.yaml", "jobscript.sh", "status.sh"):
        _, _, rest = document.partition(f"<!-- generic: {name} -->\n```")
        (folder / name).write_text(rest.partition("\n")[2].partition("```")[0])
        (folder / name).chmod(0o755)
    checkout.configure(seeds=[100], budget={"off_policy": 20_000}, log_points=ROWS)
    head = Head(checkout, cluster, "--profile", "workflow/profiles/generic", "aggregate")
    trial = Trial(checkout, cluster)
    first, second = trial.runs
    until(lambda: trial.rows(first) > 5 and trial.rows(second) > 5, "both runs", 900)
    job = cluster.jobs()[0]
    cluster.tell("scancel", job.number)
    logs = trial.root / "logs/train"  # each try begins its log anew

    def is_told() -> bool:
        told = "stopped by SIGTERM at step"
        return any(told in path.read_text() for path in logs.glob("*.log"))

    until(is_told, "the last line of the cancelled job", 60)
    head.finish()
    events = [attempt for run in trial.runs for attempt in attempts(trial.root, run)]
    assert len({event["job"] for event in events}) == len(events) == 3
    assert max(event["step"] for event in events) > 0
    assert_equal_records(checkout, trial.runs)
