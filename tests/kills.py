"""Kill training runs at known moments and compare what they end with: tools, and a count.

    python tests/kills.py --kills 100 safemr ppo_lagrangian

trains each algorithm with its default networks, kills it with SIGKILL after checkpoints that are
known to be on the disk until it was killed that often, and says how many of the runs ended as the
uninterrupted one did.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import os
import random
import select
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT)]

from safemr.experiment import checkpoints, planning, records  # noqa: E402
from safemr.experiment.checkpoints import RunSession  # noqa: E402
from safemr.experiment.train import train  # noqa: E402

Outcome = tuple[list[dict[str, str]], bytes]


class TooLateError(Exception):
    """A run was finished before it was killed."""


# Runs of seconds with the default networks, batches and numbers of environments: an off-policy
# run learns from early on, an on-policy run has twelve epochs. -> hyperparameters, steps.
SHORT: dict[str, tuple[dict[str, Any], int]] = {
    "off_policy": ({"start_steps": 480}, 3_840),
    "on_policy": ({"epoch_steps": 1_000}, 12_000),
}
SETTINGS = {"Hazards-0.15-Push": {"max_episode_steps": 50}}
LOG_POINTS = 12  # in each of them


def short_run(
    name: str, task: str = "Pillars-0.15-Goal", overrides: dict[str, Any] | None = None
) -> planning.Run:
    """A run of an algorithm with its default networks, ``overrides`` apart."""
    algorithm = planning.load_algorithm(name)
    short, steps = SHORT[algorithm.family]
    return make_run(name, task, {**short, **(overrides or {})}, steps, LOG_POINTS, LOG_POINTS // 4)


def make_run(
    name: str, task: str, overrides: dict[str, Any], steps: int, points: int, evaluations: int
) -> planning.Run:
    """A run with ``points`` rows, of which ``evaluations`` are of an evaluated policy."""
    algorithm = planning.load_algorithm(name)
    return planning.make_run(
        planning.describe_task(task, SETTINGS.get(task, {})),
        algorithm,
        planning.hyperparameters(algorithm, overrides, name),
        variant=name,
        seed=100,
        steps=steps,
        log_every=steps // points,
        evaluation={"every": steps // evaluations, "episodes": 1, "seed": 10_000},
    )


def attempt(run: planning.Run, root: Path, saved: int | None = None) -> int:
    """Train in a forked process, which need not import anything; returns its process id.

    ``saved``: a descriptor to which the process writes each checkpoint's step when it is durably
    on the disk; there is then one at every log point.
    """
    pid = os.fork()
    if pid:
        return pid
    status = 1
    try:
        if saved is not None:
            checkpoints.SHARE = math.inf
            save = checkpoints.save

            def save_and_tell(path: Path, content: Any) -> None:
                save(path, content)
                os.write(saved, f"{int(content['rows'][-1]['step'])}\n".encode())

            checkpoints.save = save_and_tell
        with open(os.devnull, "w") as quiet:
            sys.stderr = quiet
            with RunSession(run.config, run.variant, root, minimum_interval=0.0) as session:
                if not session.complete:
                    train(run.config, session, stream=quiet)
            status = 0
    finally:
        os._exit(status)


def outcome(run: planning.Run, root: Path) -> Outcome:
    """Progress without the time columns, and the policy file."""
    folder = root / run.path
    records.verify_record(folder)
    rows = list(csv.DictReader(io.StringIO((folder / "progress.csv").read_text())))
    kept = [{k: v for k, v in row.items() if not k.startswith("time_")} for row in rows]
    return kept, (folder / "policy.npz").read_bytes()


def starts(run: planning.Run, root: Path) -> list[int]:
    """The step from which each attempt at a finished run went on."""
    provenance = json.loads((root / run.path / "provenance.json").read_text())
    return [event["step"] for event in provenance["attempts"] if "step" in event]


def finish(run: planning.Run, root: Path) -> Outcome:
    """Train without an interruption, from the checkpoint if there is one."""
    _, status = os.waitpid(attempt(run, root), 0)
    assert status == 0
    return outcome(run, root)


def kill_after(
    run: planning.Run, root: Path, step: int, delay: float, number: int = signal.SIGKILL
) -> int:
    """Start or continue a run and kill it ``delay`` seconds after a checkpoint at ``step`` or
    later is on the disk. Returns the step of the last checkpoint that it told of."""
    reader, writer = os.pipe()
    pid = attempt(run, root, writer)
    os.close(writer)
    told = -1
    with os.fdopen(reader) as stream:
        while told < step:
            line = stream.readline()
            assert line, f"the run ended before a checkpoint at step {step}"
            told = int(line)
        time.sleep(delay)
        os.kill(pid, number)
        _, status = os.waitpid(pid, 0)
        if not os.WIFSIGNALED(status):
            raise TooLateError
        while select.select([stream], [], [], 0)[0] and (line := stream.readline()):
            told = int(line)
    return told


def killed(run: planning.Run, root: Path, steps: Sequence[int], delays: Sequence[float]) -> Outcome:
    """Kill a run after checkpoints at ``steps``, then let it finish; every attempt but the first
    must have gone on from a checkpoint."""
    expected = [0]
    for step, delay in zip(steps, delays, strict=True):
        expected.append(kill_after(run, root, step, delay))
    result = finish(run, root)
    assert starts(run, root) == expected
    return result


def equal_rows(result: Outcome, whole: Outcome) -> int:
    """How many log points are equal in everything."""
    return sum(mine == other for mine, other in zip(result[0], whole[0], strict=True))


def count(name: str, kills: int, task: str, seed: int, root: Path) -> bool:
    """Kill runs of an algorithm until ``kills`` is reached; whether all of them ended equal."""
    run, generator = short_run(name, task), random.Random(seed)
    begun = time.monotonic()
    whole = finish(run, root / "whole")
    interval = (time.monotonic() - begun) / LOG_POINTS
    points = range(1, LOG_POINTS - 1)
    done = number = equal = 0
    while done < kills:
        steps = sorted(generator.sample(points, min(4, kills - done)))
        folder = root / f"killed{number}"
        delays = [generator.uniform(0.0, 0.7 * interval) for _ in steps]
        try:
            after = [point * run.config["log_every"] for point in steps]
            result = killed(run, folder, after, delays)
            done, number, equal = done + len(steps), number + 1, equal + (result == whole)
            print(
                f"{name} {task}: {done} kills, {equal} of {number} runs equal; the last: "
                f"{equal_rows(result, whole)} of {len(whole[0])} rows, killed after {after}",
                flush=True,
            )
        except TooLateError:  # the machine is faster than before: not counted, and struck earlier
            interval *= 0.7
        shutil.rmtree(folder)
    return equal == number


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("algorithms", nargs="+")
    parser.add_argument("--kills", type=int, default=100, help="of each algorithm")
    parser.add_argument("--task", default="Pillars-0.15-Goal")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    all_equal = True
    for name in options.algorithms:
        with tempfile.TemporaryDirectory() as folder:
            all_equal &= count(name, options.kills, options.task, options.seed, Path(folder))
    return 0 if all_equal else 1


if __name__ == "__main__":
    raise SystemExit(main())
