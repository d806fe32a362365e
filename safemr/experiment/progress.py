"""``safemr progress``: how far the runs of a configuration are, on one screen.

safemr progress                                        the paper's grid, once
safemr progress --configfile config/second_pilot.yaml  another configuration, as for make.py
safemr progress --watch                                again every 5 seconds, until all is recorded
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from safemr.errors import UserError
from safemr.experiment import config
from safemr.experiment.begun import Begun, begun
from safemr.experiment.forecast import costs, counted, duration, estimate, opened_at
from safemr.experiment.overview import aligned, number
from safemr.experiment.plan_cache import plan_for
from safemr.experiment.planning import Run
from safemr.experiment.record import Record
from safemr.files import REPOSITORY

DEFAULT = REPOSITORY / "config" / "config.yaml"
_CLEAR = "\x1b[H\x1b[2J"  # of a terminal


@dataclass
class Grid:
    """The runs of a configuration and what stands of them under its results root."""

    root: Path
    runs: Sequence[Run]
    recorded: dict[Path, Record] = field(default_factory=dict)  # opened once, by their folders

    def look(self) -> tuple[dict[str, Begun], list[Begun]]:
        """Open what is new among the records; the runs that were begun, by digest, and others'."""
        found = {run.work.name: run for run in begun(self.root)}
        for (
            run
        ) in self.runs:  # after the work folders: a run that ends meanwhile counts as recorded
            if run.path not in self.recorded and (record := opened_at(self.root / run.path)):
                self.recorded[run.path] = record
        missing, planned = ({run.digest for run in runs} for runs in (self.missing, self.runs))
        ours = {digest: run for digest, run in found.items() if digest in missing}
        return ours, [run for digest, run in found.items() if digest not in planned]

    @property
    def missing(self) -> list[Run]:
        """The runs without a record."""
        return [run for run in self.runs if run.path not in self.recorded]

    def lines(self) -> list[str]:
        """Everything, as lines of text."""
        ours, others = self.look()
        live = {digest: run for digest, run in ours.items() if run.running}
        failed = [run for run in ours.values() if not run.running and run.failure is not None]
        stopped = len(ours) - len(live) - len(failed)
        idle = len(self.missing) - len(ours)
        counts = {"in training": len(live), "stopped": stopped, "failed": len(failed)}
        states = [f"{len(self.recorded)} of {counted(len(self.runs), 'run')} recorded"]
        states += [f"{count} {state}" for state, count in counts.items() if count]
        states += [f"{idle} not begun"] * bool(idle)
        lines = [f"{self.root}: {', '.join(states)}", "", *aligned(self._matrix(), 1)]
        if live:
            lines += ["", "In training (evaluation; exploring in brackets):"]
            lines += aligned(self._table(live), 2)
        lines += [""] * bool(failed) + [
            f"Failed: {run.label} at step {run.step}: {run.failure}" for run in failed
        ]
        if others:
            lines += ["", f"Begun, and not of this configuration: {len(others)} (safemr records)"]
        if self.missing:
            lines += ["", self._left(ours, len(live))]
        return lines

    def _matrix(self) -> list[list[str]]:
        """A row a variant, a column a task: how many runs are recorded, of how many."""
        tasks = list(dict.fromkeys(run.task for run in self.runs))
        rows = [["recorded", *tasks]]
        for variant in dict.fromkeys(run.variant for run in self.runs):
            cells = []
            for task in tasks:
                runs = [run for run in self.runs if (run.variant, run.task) == (variant, task)]
                done = sum(run.path in self.recorded for run in runs)
                cells.append(f"{done}/{len(runs)}" if runs else "")
            rows.append([variant, *cells])
        return rows

    def _table(self, live: Mapping[str, Begun]) -> list[list[str]]:
        """A row a run in training, with its newest evaluation and its pace."""
        rows = [["task", "variant", "seed", "step", "of", "return", "violating steps", "left"]]
        for run in self.runs:
            if (state := live.get(run.digest)) is None:
                continue
            steps = run.config["steps"]
            shown = [
                f"{number(state.last(f'eval_{name}'))} ({number(state.last(f'train_{name}'))})"
                for name in ("return", "cost_indicator")
            ]
            left = (steps - state.step) * state.seconds_per_step
            rows.append(
                [run.task, run.variant, str(run.seed), f"{state.step:,}", f"{steps:,}", *shown,
                 "-" if math.isnan(left) else f"{int(left) // 60}:{int(left) % 60:02d}"]
            )  # fmt: skip
        return rows

    def _left(self, ours: Mapping[str, Begun], at_once: int) -> str:
        """How long the missing runs take: by their own pace, or else by the records here."""
        known = list(costs(self.recorded.values()))
        seconds, unknown = [], 0
        for run in self.missing:
            state = ours.get(run.digest)
            if state is not None and not math.isnan(state.seconds_per_step):
                seconds.append((run.config["steps"] - state.step) * state.seconds_per_step)
            elif (whole := estimate(run, known)) is not None:
                seconds.append(whole)
            else:
                unknown += 1
        text = f"Left: about {duration(sum(seconds))}" if seconds else "Left:"
        if unknown:
            joined = " and" if seconds else ""
            text += f"{joined} {counted(unknown, 'run')} of unknown length"
        if at_once and not unknown:
            hours = max(sum(seconds) / at_once, max(seconds)) / 3600
            text += f"; {hours:.1f} hours, {at_once} at a time as now"
        return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Print how far a configuration's runs are, once or again and again.

    Raises:
        UserError: the configuration has a fault.
    """
    parser = argparse.ArgumentParser(
        "safemr progress", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--configfile",
        nargs="+",
        action="extend",
        default=[],
        type=Path,
        metavar="FILE",
        help="each is put over the ones before it; first comes config/config.yaml",
    )
    parser.add_argument(
        "--watch", nargs="?", type=float, const=5.0, metavar="SECONDS", help="again and again"
    )
    options = parser.parse_args(arguments)
    if options.watch is not None and not 0.1 <= options.watch < math.inf:
        raise UserError("--watch must be 0.1 seconds or more")
    chosen = config.load([DEFAULT, *options.configfile])
    grid = Grid(chosen.results_root, plan_for(chosen).runs)
    try:
        while True:
            text = "\n".join(grid.lines())
            clear = _CLEAR if options.watch is not None and sys.stdout.isatty() else ""
            print(clear + text, flush=True)
            if options.watch is None or not grid.missing:
                return 0
            time.sleep(options.watch)
    except KeyboardInterrupt:
        return 0
    except BrokenPipeError:  # whoever read has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nor will the exit flush
        return 0
