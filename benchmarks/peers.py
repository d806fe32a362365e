"""Training here against training by other packages, in one run on one core.

    python -m benchmarks.peers [--parts epochs updates learning] [--cases 'SafeMR*' ...]
        [--omnisafe-python PATH] [--sb3-python PATH] [--output FILE.csv]
    python -m benchmarks.peers --show FILE.csv ...

epochs: PPO-Lagrangian of OmniSafe on SafetyPointGoal1 against ours on PointGoal1, with the same
networks, epochs, minibatches and passes, all of which are made (one case apart). CPU ms for 1,000
environment steps: steps and resets of the environment; acting, which includes storing (and, of
OmniSafe, advantages); learning, which includes ours; the rest. Shorter epochs (--epoch-steps) are
measured sooner and cost nearly the same a step: OmniSafe begins each with one more reset.

updates: a gradient step of Stable-Baselines3's soft actor-critic against one of ours, from a full
memory, with the same batch and networks. Ours has a third critic, of the cost, and a multiplier.
"every step" moves policy and multiplier in each gradient step and forms targets for one of them,
as Stable-Baselines3 does; "default" are the delays that our runs have. CPU ms for one.

learning: CPU minutes until the deterministic return on ten layouts of tuning first reaches a
threshold on Pillars-0.15-Goal, in which Stable-Baselines3 steps our scalar environment. Ours by
the default recipe and with other numbers of steps between two gradient steps. The time of the
evaluations themselves is left out; they come every few thousand steps, which is how exact the
figures are. A run ends at the threshold, or at the most steps or minutes that are allowed: then
"reached" is 0. "Settings like ours" are the learning rate, returns of five steps, and the first
temperature; observations are scaled here and raw there, and policies of ours move in every second
gradient step.

Blocks of epochs and updates take turns over all cases and tables show medians over them, so that
other users of the machine disturb all alike; the first block of each is not counted. The others'
packages are no dependencies: each has an environment of its own, made by the commands at the head
of benchmarks/peers_omnisafe.txt and benchmarks/peers_sb3.txt. What docs/speed.md tells is in
benchmarks/measured; --show prints the tables of such files.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from statistics import median
from typing import Any

import torch

from benchmarks.on_policy import OMNISAFE
from benchmarks.peers_cases import (
    SCHEDULED,
    Block,
    Case,
    Subject,
    checked,
    epoch_cases,
    learning_cases,
    update_cases,
)
from benchmarks.stopwatch import REST
from safemr.errors import UserError, reported_errors
from safemr.experiment.provenance import cpu_model, now

COLUMNS = ("part", "case", "seed", "quantity", "value", "blocks", "date", "cpu", "versions")
# Parts of a block in the order of the table.
ORDER = ("environment steps", "resets", "acting", "gathering", "update", "learning", REST)
PARTS = ("epochs", "updates", "learning")
SCALE = {"epochs": 1_000, "updates": 1}  # of what a time is given for


def interleaved(subjects: Mapping[str, Subject], rounds: int) -> dict[str, list[Block]]:
    """Blocks of all subjects in turn, after one of each that is not counted."""
    for subject in subjects.values():
        subject.block()
    found: dict[str, list[Block]] = {name: [] for name in subjects}
    for index in range(rounds):
        for name, subject in subjects.items():
            found[name].append(subject.block())
        print(f"round {index + 1} of {rounds}", file=sys.stderr, flush=True)
    return found


def per(block: Block, scale: float) -> dict[str, float]:
    """CPU milliseconds of a block for ``scale`` of what it counts: all, and part by part."""
    times = {part: 1e3 * scale * spent / block["count"] for part, spent in block["parts"].items()}
    total = sum(times.values())
    parts = {part: times[part] for part in ORDER if part in times}
    rest = {name: block[name] for name in block if name not in ("count", "parts")}
    return {"per second": 1e3 * scale / total, "ms": total, **parts, **rest}


def in_turn(part: str, cases: Sequence[Case], rounds: int) -> list[dict[str, Any]]:
    """Rows of medians over ``rounds`` blocks; "times as fast" is the median of each round's."""
    subjects: dict[str, Subject] = {}
    try:
        for case in cases:
            subjects[case.name] = case.start()
        blocks = interleaved(subjects, rounds)
    finally:
        for subject in subjects.values():
            subject.close()
    found = {name: [per(block, SCALE[part]) for block in each] for name, each in blocks.items()}
    rows = []
    for case in cases:
        mine, values = found[case.name], {}
        for quantity in dict.fromkeys(name for block in mine for name in block):
            values[quantity] = median(block.get(quantity, 0.0) for block in mine)
        if case.against in found:
            pairs = zip(found[case.against], mine, strict=True)
            values["times as fast"] = median(peer["ms"] / own["ms"] for peer, own in pairs)
        versions = subjects[case.name].versions
        rows += described(part, case.name, "", values, versions, rounds)
    return rows


def first_passage(curve: Iterable[Block], threshold: float) -> dict[str, float]:
    """Where a return first reaches a threshold, as far as the curve was asked for.

    curve: blocks of steps, CPU seconds and the return after them. Returns "steps", "core-minutes",
    "reached" (0 or 1) and the "best return"; where it was not reached, steps and minutes are those
    of the whole curve.
    """
    steps, seconds, best, reached = 0.0, 0.0, float("-inf"), False
    for block in curve:
        steps, seconds = steps + block["steps"], seconds + block["cpu_s"]
        best = max(best, block["return"])
        reached = block["return"] >= threshold
        told = f"  {steps:.0f} steps, {seconds / 60:.2f} min: {block['return']:.2f}"
        print(told, file=sys.stderr, flush=True)
        if reached:
            break
    found = {"reached": float(reached), "core-minutes": seconds / 60}
    return {**found, "steps": steps, "best return": best}


def limited(subject: Subject, steps: int, minutes: float) -> Iterable[Block]:
    """Blocks until so many steps or CPU minutes are over."""
    done, spent = 0.0, 0.0
    while done < steps and spent < 60 * minutes:
        block = subject.block()
        done, spent = done + block["steps"], spent + block["cpu_s"]
        yield block


def learned(case: Case, seed: int, options: argparse.Namespace) -> list[dict[str, Any]]:
    """The rows of a training run."""
    print(f"{case.name}, seed {seed}", file=sys.stderr, flush=True)
    subject = case.start(seed=seed)
    try:
        curve = limited(subject, options.max_steps, options.max_minutes)
        values = first_passage(curve, options.threshold)
    finally:
        subject.close()
    return described("learning", case.name, str(seed), values, subject.versions, 1)


def described(
    part: str,
    case: str,
    seed: str,
    values: Mapping[str, float],
    versions: Mapping[str, str],
    blocks: int,
) -> list[dict[str, Any]]:
    """Rows of COLUMNS, one a quantity."""
    told = " ".join(f"{name}={version}" for name, version in versions.items())
    about = {"part": part, "case": case, "seed": seed}
    measured = {"blocks": blocks, "date": now(), "cpu": cpu_model(), "versions": told}
    return [
        {**about, "quantity": quantity, "value": float(f"{value:.5g}"), **measured}
        for quantity, value in values.items()
    ]


def number(value: float) -> str:
    """Four digits that count."""
    return f"{float(f'{value:.4g}'):,.0f}" if abs(value) >= 1_000 else f"{value:.4g}"


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table a part: cases down, quantities across."""
    lines: list[str] = []
    for part in dict.fromkeys(row["part"] for row in rows):
        chosen = [row for row in rows if row["part"] == part]
        quantities = list(dict.fromkeys(row["quantity"] for row in chosen))
        cases: dict[tuple[str, str], dict[str, float]] = {}
        for row in chosen:
            cases.setdefault((row["case"], row["seed"]), {})[row["quantity"]] = row["value"]
        header = (part, *quantities)
        lines += ["", "| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
        for (case, seed), values in cases.items():
            label = f"{case}, seed {seed}" if seed else case
            cells = [number(values[name]) if name in values else "-" for name in quantities]
            lines.append("| " + " | ".join((label, *cells)) + " |")
    return "\n".join(lines)


def write(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)


def measured(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """The rows of files that `write` wrote, one after the other. Raises UserError for others."""
    rows: list[dict[str, Any]] = []
    for path in paths:
        try:
            with path.open(newline="") as file:
                found = list(csv.DictReader(file))
            rows += [{**row, "value": float(row["value"])} for row in found]
        except (OSError, KeyError, ValueError) as error:
            raise UserError(f"--show: {path} is no file of this program's ({error})") from None
    return rows


def selected(cases: Sequence[Case], patterns: Sequence[str]) -> list[Case]:
    """Those whose names match one of the patterns. Raises UserError where none does."""
    found = [case for case in cases if any(fnmatch(case.name, each) for each in patterns)]
    if not found:
        names = "; ".join(case.name for case in cases)
        raise UserError(f"--cases: none of this part's; they are: {names}")
    return found


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--cases", nargs="+", default=["*"], help="patterns of their names")
    parser.add_argument("--omnisafe-python", type=Path, help="of an environment with OmniSafe")
    parser.add_argument("--sb3-python", type=Path, help="of one with Stable-Baselines3")
    parser.add_argument("--rounds", type=int, default=5, help="blocks a case that are counted")
    parser.add_argument(
        "--epoch-steps", type=int, default=OMNISAFE["epoch_steps"], help="a multiple of 20"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 101], help="of learning")
    parser.add_argument("--threshold", type=float, default=15.0, help="return to be reached")
    parser.add_argument("--every", type=int, default=5_000, help="steps between two evaluations")
    parser.add_argument("--max-steps", type=int, default=SCHEDULED, help="of a training run")
    parser.add_argument("--max-minutes", type=float, default=15.0, help="its CPU minutes")
    parser.add_argument("--output", type=Path, help="write the rows as CSV, too")
    parser.add_argument("--show", type=Path, nargs="+", help="no measurement: tables of files")
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    options = parsed(arguments)
    if options.show:
        print(markdown(measured(options.show)))
        return 0
    torch.set_num_threads(1)
    made = {
        "epochs": epoch_cases(options.omnisafe_python, options.epoch_steps),
        "updates": update_cases(options.sb3_python),
        "learning": learning_cases(options.sb3_python, options.every),
    }
    chosen = {part: selected(made[part], options.cases) for part in options.parts}
    for package in {case.peer for cases in chosen.values() for case in cases} - {""}:
        checked(package, vars(options)[f"{package}_python"])
    rows: list[dict[str, Any]] = []

    def add(more: list[dict[str, Any]]) -> None:
        rows.extend(more)
        if options.output:  # after each, as learning takes hours
            write(rows, options.output)

    for part, cases in chosen.items():
        if part != "learning":
            add(in_turn(part, cases, options.rounds))
            continue
        for seed in options.seeds:
            for case in cases:
                add(learned(case, seed, options))
    print(markdown(rows))
    return 0


if __name__ == "__main__":
    with reported_errors():
        raise SystemExit(main())
