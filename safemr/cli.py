"""The ``safemr`` command: one name for the programs of this package.

safemr train ...      train one run
safemr evaluate ...   evaluate a recorded policy
safemr certify ...    check a learned energy function
safemr oracle ...     look for the least feasible certificate of a task
safemr play RECORD .. draw an episode of a policy, with phi and the filter's interventions
safemr records ...    verify the records under a results root and say what is unfinished
safemr check-algorithm NAME  check that an algorithm keeps to the contract of a trainer
safemr check ID ...   what an environment from outside has and lacks (docs/your-own.md)
safemr list ...       tasks, algorithms and hyperparameters (`safemr list ALGORITHM`)
safemr config ...     check configuration files, each put over the ones before it
safemr documents ...  put the tables that the pipeline made into documents
safemr controllers .. score the scripted controllers
safemr slices FILE    compare the reachability solver with reference slices
safemr golden FILE .. replay recorded Safety Gym trajectories
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence

from safemr.errors import reported_errors
from safemr.names import unknown

# Command -> module with main(arguments) -> exit status, imported only when it is called.
COMMANDS = {
    "train": "safemr.experiment.train",
    "evaluate": "safemr.measure.evaluate",
    "certify": "safemr.report.certificates",
    "oracle": "safemr.report.sizes",
    "play": "safemr.report.play",
    "records": "safemr.experiment.overview",
    "check-algorithm": "safemr.experiment.check_algorithm",
    "check": "safemr.experiment.check",
    "list": "safemr.experiment.listing",
    "config": "safemr.experiment.config",
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
