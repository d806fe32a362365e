"""The parallel trainer on Ray: kills of every kind of process, resuming, two nodes.

Where Ray is installed (``pip install -e ".[ray]"``), which `make.py` does not; what needs none is
in `test_pabal.py`. Each test starts a Ray of its own.
"""

from __future__ import annotations

import functools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from safemr.errors import UserError
from safemr.experiment import records
from safemr.experiment.catalogue import load_algorithm
from safemr.parallel.workers import BUFFER, LEARNER, SAMPLER
from safemr.tasks import make_envs

ray = pytest.importorskip("ray", reason="the extra `ray` is not installed")
pytestmark = pytest.mark.slow
ROOT = Path(__file__).resolve().parents[1]
TASK, STEPS = "Pillars-0.15-Goal", 3200
SMALL = {
    **{"num_envs": 8, "hidden": 16, "batch_size": 32, "start_steps": 400, "max_gradient_age": 3},
    **{"samplers": 2, "buffers": 1, "learners": 2},
}


@pytest.fixture(autouse=True)
def _no_ray_afterwards(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    yield
    ray.shutdown()


def trainer_of() -> Any:
    algorithm = load_algorithm("safemr.parallel.safemr")
    config = algorithm.hyperparameters(**SMALL)
    return algorithm.trainer(config, functools.partial(make_envs, TASK), 100, STEPS)


def process_of(trainer: Any, kind: int) -> int:
    return ray.get(trainer._workers[kind][0].present.remote())


def test_each_kind_of_process_is_killed() -> None:
    before = signal.getsignal(signal.SIGTERM)
    trainer = trainer_of()
    metrics = trainer.advance(800)
    assert signal.getsignal(signal.SIGTERM) is before
    assert (trainer.step, metrics["updates"], metrics["lost_tasks"]) == (800, 50, 0)
    for kind, until in ((SAMPLER, 1200), (LEARNER, 1600)):
        killed = process_of(trainer, kind)
        os.kill(killed, signal.SIGKILL)
        metrics = trainer.advance(until)
        assert metrics["lost_tasks"] >= 1
        assert metrics["gradient_age_max"] <= SMALL["max_gradient_age"]
        assert metrics["updates"] == (until - SMALL["start_steps"]) // 8
        assert process_of(trainer, kind) != killed
    state = trainer.state_dict()
    assert sum(ring["size"] for ring in state["rings"]) == 1600 // 4
    os.kill(process_of(trainer, BUFFER), signal.SIGKILL)
    with pytest.raises(UserError, match=r"buffer 0 of 1 is gone at step 1\d\d\d"):
        trainer.advance(2400)
    trainer.close()
    assert not ray.is_initialized()


def test_two_nodes_and_a_cluster_that_is_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 3, "object_store_memory": 100_000_000}
    head = {**node, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    try:
        monkeypatch.setenv("RAY_ADDRESS", cluster.address)
        with pytest.raises(UserError, match=r"has 3 CPUs, and .* are 5"):
            trainer_of().advance(800)
        cluster.add_node(wait=False, **node)
        cluster.wait_for_nodes(timeout=300)
        trainer = trainer_of()
        metrics = trainer.advance(800)
        assert (trainer.step, metrics["updates"]) == (800, 50)
        assert trainer.notes["ray_nodes"] == 2
        trainer.close()
    finally:
        cluster.shutdown()


def command(root: Path) -> subprocess.Popen[str]:
    small = SMALL | {"samplers": 1, "learners": 1}
    settings = [word for name, value in small.items() for word in ("--set", f"{name}={value}")]
    program = [sys.executable, "-P", "-m", "safemr.experiment.train", "--task", TASK]
    program += ["--algorithm", "safemr.parallel.safemr", "--steps", "9600", "--log-points", "12"]
    program += ["--eval-episodes", "1", "--out", str(root), *settings]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(program, cwd=root, env=environment, stderr=subprocess.PIPE, text=True)


def until_line(process: subprocess.Popen[str], pattern: str) -> str:
    assert process.stderr is not None
    for line in process.stderr:
        if re.search(pattern, line):
            return line
    raise AssertionError(f"ended with {process.wait()} before a line like {pattern}")


def step_in(line: str) -> int:
    found = re.search(r"at step (\d+)", line)
    assert found is not None
    return int(found[1])


def ended(pid: int, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.5)
    return False


def test_the_same_command_continues_and_records(tmp_path: Path) -> None:
    first = command(tmp_path)
    until_line(first, " 1600/9600 ")
    first.send_signal(signal.SIGTERM)
    said = until_line(first, "stopped by SIGTERM")
    assert first.wait(120) == 128 + signal.SIGTERM
    step = step_in(said)
    second = command(tmp_path)
    assert step_in(until_line(second, "continues")) == step
    until_line(second, "/9600 ")
    listed = subprocess.run(["ps", "-eo", "pid,ppid,args"], capture_output=True, text=True)
    raylets = [line.split()[0] for line in listed.stdout.splitlines()
               if line.split()[1] == str(second.pid)]  # fmt: skip
    second.kill()
    second.wait()
    assert raylets
    assert all(ended(int(pid), 60) for pid in raylets)
    third = command(tmp_path)  # the second may have had the time for a checkpoint
    assert step_in(until_line(third, "continues")) >= step
    until_line(third, "record in")
    assert third.wait(120) == 0
    (folder,) = tmp_path.glob("runs/*/*/*")
    provenance = json.loads((folder / records.PROVENANCE).read_text())
    assert provenance["deterministic"] is False
    assert len(provenance["attempts"]) == 3
    rows = records.parse_progress((folder / records.PROGRESS).read_text())
    ages = ("gradient_age", "gradient_age_max", "policy_age", "policy_age_max", "lost_tasks")
    assert {*ages, "workers_cpu_s"} <= rows[-1].keys()
    assert rows[-1]["updates"] == (9600 - SMALL["start_steps"]) // 8
    seconds = [row["workers_cpu_s"] for row in rows]
    assert seconds == sorted(seconds)
