"""The ``safemr`` command: one name for the programs of this package.

What is there?
safemr list ...       tasks, algorithms, configurations; `safemr list NAME`: what can be set of one
safemr records ...    the recorded runs as a table, those with a fault, those unfinished

Train
safemr config ...     check configuration files, each put over the ones before it
safemr train ...      train one run
safemr progress ...   how far the runs of a configuration are; --watch: again and again

Look at what was trained
safemr evaluate ...   fly a recorded policy on layouts that it was not evaluated on
safemr play RECORD .. draw an episode of a policy, with phi and the filter's interventions
safemr certify ...    look for states without a safe action under a learned energy function
safemr oracle ...     look for the least feasible certificate of a task

Bring your own (docs/your-own.md)
safemr check ID ...   what an environment from outside has and lacks
safemr check-algorithm NAME  check that an algorithm keeps to the contract of a trainer

For this repository
safemr documents ...  put the tables that the pipeline made into documents
safemr controllers .. score the scripted controllers
safemr slices FILE    compare the reachability solver with reference slices
safemr golden FILE .. replay recorded Safety Gym trajectories

A first run of a minute, and what became of it:
  safemr train --task Pillars-0.15-Goal --algorithm safemr --steps 40000 --out try
  safemr records try
  safemr evaluate try/runs/*/*/*
  safemr play try/runs/*/*/* --video episode.gif
All runs, tables and figures: python3 make.py all. What a command takes: safemr COMMAND --help.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence

from safemr.errors import reported_errors
from safemr.names import unknown

# Command -> module with main(arguments) -> exit status, imported only when it is called.
COMMANDS = {
    "list": "safemr.experiment.listing",
    "records": "safemr.report.recorded",
    "config": "safemr.experiment.config",
    "train": "safemr.experiment.train",
    "progress": "safemr.experiment.progress",
    "evaluate": "safemr.measure.evaluate",
    "play": "safemr.report.play",
    "certify": "safemr.report.certificates",
    "oracle": "safemr.report.sizes",
    "check": "safemr.experiment.check",
    "check-algorithm": "safemr.experiment.check_algorithm",
    "documents": "safemr.report.documents",
    "controllers": "safemr.measure.controllers",
    "slices": "safemr.aircraft.reachability.check",
    "golden": "envs.golden",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Dispatch ``safemr COMMAND ...`` to its module."""
    command, *rest = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    if command in ("-h", "--help"):
        print(__doc__)
        return 0
    with reported_errors():
        if command not in COMMANDS:
            raise unknown("command", command, COMMANDS)
        program: Callable[[Sequence[str]], int | None] = importlib.import_module(
            COMMANDS[command]
        ).main
        return program(rest) or 0
    return 2


if __name__ == "__main__":
    raise SystemExit(main())
