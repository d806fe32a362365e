"""Accuracy, time and memory of the reachability solver: ``python benchmarks/reachability.py``.

Each row is solved in a process of its own, so that its memory is its own. Columns: processor
seconds without compilation, peak memory of the process, volume of the unsafe set on 2^19 Sobol
points of the environment's box, IoU with the finest grid of the table, sign disagreements with and
least IoU over the reference slices, the lowest value on the analytic barrier, and, for constant
traffic, the largest distance between boundary and barrier over five slices.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from safemr.aircraft.reachability import CASES, Grid, Solution, solve
from safemr.aircraft.reachability.barrier import boundary_error, sheets
from safemr.aircraft.reachability.check import compare, intersection_over_union, read_references
from safemr.aircraft.unsafe_sets import Truth

SHAPES = ((66, 66, 48), (131, 131, 96), (197, 197, 120), (261, 261, 144), (391, 391, 240))
SLICES = Path(__file__).parents[1] / "tests" / "golden" / "aircraft" / "slices.npz"


def measure(case: str, shape: tuple[int, int, int], store: Path) -> dict[str, Any]:
    """One row; the unsafe flags of the sample are left in ``store`` for the IoU."""
    solve(CASES[case], Grid(shape=(8, 8, 6)), 0.1)  # compilation
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    solution = solve(CASES[case], Grid(shape=shape))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    truth = Truth.sample(solution)
    np.save(store, truth.unsafe)
    (reference,) = [each for each in read_references(SLICES) if each.name == f"{case}_dp"]
    results = compare(solution, reference)
    return {
        "case": case,
        "grid": "x".join(map(str, shape)),
        "seconds": round(solution.seconds, 1),
        "memory_mb": round(peak / 1024),
        "solution_mb": round((peak - before) / 1024),
        "volume": round(truth.volume, 2),
        "disagreements": sum(result.disagreements for result in results),
        "least_iou_reference": round(min(result.iou for result in results), 4),
        "barrier_minimum": round(barrier_minimum(solution), 4),
        "boundary_error": round(boundary_error(solution), 3) if case == "A" else None,
    }


def barrier_minimum(solution: Solution) -> float:
    """The lowest value over all sheets, where they are on the grid."""
    states = np.concatenate(list(sheets(solution.dynamics, angles=720, times=100).values()))
    return float(solution(states[solution.grid.contains(states)]).min())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", type=Path, default=Path("results/benchmarks"))
    parser.add_argument("--row", nargs=2, metavar=("CASE", "GRID"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.store.mkdir(parents=True, exist_ok=True)
    if options.row:
        case, grid = options.row
        nx, ny, npsi = map(int, grid.split("x"))
        print(json.dumps(measure(case, (nx, ny, npsi), options.store / f"{case}-{grid}.npy")))
        return
    for case in CASES:
        rows = []
        for shape in SHAPES:
            command = [sys.executable, __file__, "--store", str(options.store)]
            command += ["--row", case, "x".join(map(str, shape))]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            rows.append(json.loads(done.stdout))
        finest = np.load(options.store / f"{case}-{rows[-1]['grid']}.npy")
        for row in rows:
            unsafe = np.load(options.store / f"{case}-{row['grid']}.npy")
            row["iou_finest"] = round(intersection_over_union(unsafe, finest), 4)
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
