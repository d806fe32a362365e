"""How the cost of training grows with environments, obstacles, width, batch, length and runs.

    python -m benchmarks.scaling [--rounds N] [--output FILE.csv] [--figure STEM]

One factor is varied at a time around SafeMR's defaults on Pillars-0.15-Goal. Times are CPU
milliseconds per 1,000 environment steps in the middle of a run, medians of blocks taken in turn
over all cases, so that other users of the machine disturb every case alike. "runs" are that many
processes at once, each with one thread: there the time is wall time per 1,000 steps of one run.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing
import time
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.training import Run
from safemr.report.figures import style

TASK, HELD = "Pillars-0.15-Goal", 150_000
COLUMNS = ("factor", "value", "ms", "relative")
# factor -> (default, values, keyword of `Run` and the name in it)
FACTORS: Mapping[str, tuple[int, tuple[int, ...], tuple[str, str]]] = {
    "environments": (16, (4, 8, 16, 32, 64), ("hyperparameters", "num_envs")),
    "obstacles": (1, (1, 2, 4, 8), ("task_settings", "num_obstacles")),
    "width": (64, (32, 64, 128, 256), ("hyperparameters", "hidden")),
    "batch": (256, (64, 128, 256, 512, 1024), ("hyperparameters", "batch_size")),
    "steps in memory": (HELD, (10_000, 50_000, HELD, 450_000), ("held", "")),
}
PROCESSES = (1, 2, 4)


def run_of(factor: str, value: int) -> Run:
    """A run in its middle that differs from the defaults in one factor."""
    keyword, name = FACTORS[factor][2]
    if keyword == "held":
        return Run("safemr", TASK, value, "fused")
    settings: dict[str, Any] = {name: value}
    if name == "num_obstacles":  # eight keepout circles need more room than the task's square
        settings["extent"] = 3.0
    return Run("safemr", TASK, HELD, "fused", **{keyword: settings})


def single(rounds: int) -> list[dict[str, Any]]:
    """Rows for every factor of one process."""
    cases = [(factor, value) for factor, (_, values, _) in FACTORS.items() for value in values]
    times: dict[tuple[str, int], list[float]] = defaultdict(list)
    live = {case: run_of(*case) for case in cases}
    for _ in range(rounds):
        for case, run in live.items():
            times[case].append(sum(run.advance()[0].values()))
    rows = []
    for factor, value in cases:
        base = median(times[factor, FACTORS[factor][0]])
        spent = median(times[factor, value])
        rows.append(dict(zip(COLUMNS, (factor, value, spent, spent / base), strict=True)))
    return rows


def _worker(ready: Any, results: Any, rounds: int) -> None:
    run = Run("safemr", TASK, HELD, "fused")
    ready.wait()
    begun, before = time.perf_counter(), run.trainer.step
    for _ in range(rounds):
        run.advance()
    results.put(1e6 * (time.perf_counter() - begun) / (run.trainer.step - before))


def several(rounds: int) -> list[dict[str, Any]]:
    """Rows for the number of processes at once; "ms" is the mean over them."""
    context = multiprocessing.get_context("spawn")
    rows: list[dict[str, Any]] = []
    for count in PROCESSES:
        ready, results = context.Barrier(count), context.Queue()
        workers = [
            context.Process(target=_worker, args=(ready, results, rounds)) for _ in range(count)
        ]
        for worker in workers:
            worker.start()
        spent = sum(results.get() for _ in workers) / count
        for worker in workers:
            worker.join()
        base = rows[0]["ms"] if rows else spent
        rows.append(dict(zip(COLUMNS, ("runs at once", count, spent, spent / base), strict=True)))
    return rows


def markdown(rows: list[dict[str, Any]]) -> str:
    lines = ["| factor | value | ms per 1,000 steps | relative |", "|" + " --- |" * 4]
    for row in rows:
        cells = (row["factor"], f"{row['value']:,}", f"{row['ms']:.0f}", f"{row['relative']:.2f}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


@style.styled
def draw(rows: list[dict[str, Any]], stem: Path) -> None:
    """Relative cost against each factor, doubly logarithmic; dotted: proportional growth."""
    factors = list(dict.fromkeys(row["factor"] for row in rows))
    figure = style.new_figure(style.TEXT_WIDTH, 3.6)
    axes = figure.subplots(2, (len(factors) + 1) // 2, sharey=True)
    for ax, factor in zip(axes.flat, factors, strict=False):
        chosen = [row for row in rows if row["factor"] == factor]
        values, relative = ([row[name] for row in chosen] for name in ("value", "relative"))
        ax.plot(values, relative, "o-", ms=3, color=style.colour("SafeMR"))
        at_default = min(values, key=lambda v: abs(relative[values.index(v)] - 1.0))
        ax.plot(values, [value / at_default for value in values], ls=":", color="0.5")
        ax.set_xscale("log", base=10 if max(values) > 5000 else 2)
        ax.set_yscale("log", base=2)
        ax.set_ylim(0.4, 5)
        ax.set_yticks([0.5, 1, 2, 4], ["0.5", "1", "2", "4"])
        ax.set_xticks(values, [f"{v // 1000}k" if v >= 10_000 else str(v) for v in values])
        ax.set_xticks([], minor=True)
        ax.set_yticks([], minor=True)
        ax.set_xlabel(factor)
    for ax in axes.flat[len(factors) :]:
        ax.set_axis_off()
    for ax in axes[:, 0]:
        ax.set_ylabel("relative time per step")
    style.save(figure, stem)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.scaling", description=__doc__)
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--output", type=Path, help="CSV of the numbers")
    parser.add_argument("--figure", type=Path, help="PDF and PNG of this name")
    options = parser.parse_args(arguments)
    rows = single(options.rounds) + several(8 * options.rounds)
    print(markdown(rows))
    if options.output:
        with options.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    if options.figure:
        draw(rows, options.figure)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
