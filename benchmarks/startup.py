"""Processor time before anything is learned or drawn: imports, a run's first step, a redraw.

    python -m benchmarks.startup            # medians of three processes each
    python -m benchmarks.startup --redraw   # also every table and figure, in a fresh clone

CPU seconds, user and system, of a process and its children. They vary with what else the machine
does, by a factor of two and more where all of its cores are taken: compare what was measured in
one call, with ``import torch`` as the measure. The caches (`__pycache__`) are warm but for the
redraw's, whose clone has none.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FIRST_STEP = """
import sys, tempfile
from safemr.experiment import train
from safemr.learning.soft_actor_critic import SoftActorCritic

update = SoftActorCritic.update

def first(*arguments, **options):
    update(*arguments, **options)
    sys.exit()

SoftActorCritic.update = first
settings = ["--steps", "8000", "--log-points", "1", "--set", "start_steps=160"]
settings += ["--set", f"backend={sys.argv[1]}", "--root", tempfile.mkdtemp()]
train.main(["--task", "Pillars-0.15-Goal", "--algorithm", "safemr", *settings])
"""
SNAKEMAKE = ("-P", "-m", "snakemake", "-j1", "--keep-going", "all")
CASES: dict[str, tuple[str, ...]] = {
    "python": ("-c", ""),
    "import torch": ("-c", "import torch"),
    "import torch and its compiler": ("-c", "import torch._dynamo"),
    "safemr --help": ("-m", "safemr.cli", "--help"),
    "first gradient step, fused": ("-c", FIRST_STEP, "fused"),
    "first gradient step, torch": ("-c", FIRST_STEP, "torch"),
    "snakemake -n all": (*SNAKEMAKE, "-n", "--quiet"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.startup",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--repeats", type=int, default=3, help="processes a case")
    parser.add_argument("--redraw", action="store_true", help="clone and draw everything: minutes")
    options = parser.parse_args(arguments)
    print("| case | CPU seconds |\n| --- | --- |")
    taken: dict[str, list[float]] = {name: [] for name in CASES}
    for _ in range(options.repeats):  # in turn, so that a busy minute is everybody's
        for name, command in CASES.items():
            taken[name].append(cpu_seconds(ROOT, command))
    for name, values in taken.items():
        print(f"| {name} | {statistics.median(values):.2f} |")
    if options.redraw:
        with tempfile.TemporaryDirectory() as folder:
            clone = Path(folder, "clone")
            subprocess.run(["git", "clone", "--quiet", ROOT, clone], check=True)
            begun = time.perf_counter()
            seconds = cpu_seconds(clone, SNAKEMAKE)
            wall = time.perf_counter() - begun
            print(f"| redraw at -j1 ({wall:.0f} s by the clock) | {seconds:.1f} |")
            changed = subprocess.run(
                ["git", "status", "--short"], cwd=clone, capture_output=True, text=True, check=True
            ).stdout
        if changed:
            sys.exit(f"error: the redraw changed what is committed:\n{changed}")
    return 0


def cpu_seconds(folder: Path, arguments: Sequence[str]) -> float:
    """Of a Python process that runs the sources in ``folder``, and of its children.

    Raises subprocess.CalledProcessError where it fails.
    """
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, check=True, **quiet)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    raise SystemExit(main())
