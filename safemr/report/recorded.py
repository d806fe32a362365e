"""``safemr records``: what is recorded, what of it cannot be believed, and what is unfinished."""

from __future__ import annotations

import argparse
import fnmatch
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from safemr.experiment.overview import aligned, number, opened, unfinished
from safemr.experiment.record import Record
from safemr.names import unknown
from safemr.report.statistics import final_scores

METRICS = ("eval_return", "eval_cost_indicator", "eval_zero_violation_share")
HEADINGS = (
    *("task", "variant", "seed", "digest"),
    *("steps", "return", "violating steps", "clean episodes", "minutes", "revision"),
)


def table(recorded: Sequence[Record]) -> list[list[str]]:
    """A row a record: its final performance, as tables have it, its wall time and its revision.

    A revision with ``*`` is one whose sources were edited.
    """
    # A run is its folder here: a task may have several of one label and seed, in other settings.
    logged = [
        ("", record.folder.as_posix(), 0, row["step"], metric, row[metric])
        for record in recorded
        for row in record.rows
        for metric in METRICS
        if metric in row
    ]
    columns = ["task", "variant", "seed", "step", "metric", "value"]
    progress = pd.DataFrame(logged, columns=columns)
    finals = final_scores(progress).set_index(["variant", "metric"])["value"].to_dict()
    rows = [list(HEADINGS)]
    for record in recorded:
        value, violating, clean = (
            finals.get((record.folder.as_posix(), metric), float("nan")) for metric in METRICS
        )
        source = record.provenance.get("source") or {}
        revision = (source.get("commit") or "-")[:7] + "*" * bool(source.get("dirty"))
        rows.append(
            [
                *(record.task["name"], record.variant, str(record.seed)),
                *(record.provenance["digest"], f"{record.config['steps']:,}"),
                *(number(value), number(violating), f"{number(100 * clean, 1)}%"),
                number((record.provenance.get("wall_s") or float("nan")) / 60, 1),
                revision,
            ]
        )
    return rows


def chosen(recorded: Sequence[Record], task: Sequence[str], variant: Sequence[str],
           seed: Sequence[int]) -> list[Record]:  # fmt: skip
    """Those of some tasks, variants and seeds; what is empty asks nothing.

    Raises:
        UserError: a name or pattern that fits no record.
    """
    names = {
        "task": {record.task["name"] for record in recorded},
        "variant": {record.variant for record in recorded},
    }
    allowed = {}
    for kind, patterns in (("task", task), ("variant", variant)):
        allowed[kind] = set() if patterns else names[kind]
        for pattern in patterns:
            # First as it is: labels like SafeMR[0.45,0.15] have the brackets of patterns.
            fits = {pattern} & names[kind] or set(fnmatch.filter(names[kind], pattern))
            if not fits:
                raise unknown(kind, pattern, names[kind], "these records")
            allowed[kind] |= fits
    return [
        record
        for record in recorded
        if record.task["name"] in allowed["task"]
        and record.variant in allowed["variant"]
        and (not seed or record.seed in seed)
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the records, every fault and every unfinished run; status 1 where there is a fault."""
    parser = argparse.ArgumentParser("safemr records", description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path("results"))
    for name, what in (("task", "of these tasks"), ("variant", "with these labels")):
        parser.add_argument(
            f"--{name}", nargs="+", action="extend", default=[], metavar="NAME",
            help=f"only those {what}; * stands for anything",
        )  # fmt: skip
    parser.add_argument(
        "--seed", nargs="+", action="extend", default=[], type=int, help="only those of these seeds"
    )
    options = parser.parse_args(arguments)
    found = list(opened(options.root))
    recorded = [record for record in found if isinstance(record, Record)]
    faults = [record for record in found if not isinstance(record, Record)]
    shown = chosen(recorded, options.task, options.variant, options.seed)
    if shown:
        print(*aligned(table(shown), 2), "", sep="\n")
    for line in (*map(str, faults), *unfinished(options.root)):
        print(line)
    counts = f"{len(recorded)} records verified, {len(faults)} refused"
    print(f"{len(shown)} shown; {counts}" if len(shown) < len(recorded) else counts)
    return 1 if faults else 0
