"""The ``safemr`` command: one name for the programs of this package.

safemr train ...      train one run (`python -m safemr.experiment.train`)
safemr evaluate ...   evaluate a recorded policy (`python -m safemr.learning.evaluation`)
safemr certify ...    check a learned energy function (`python -m safemr.measure.certify`)
safemr records ...    verify the records under a results root and say what is unfinished
safemr list ...       tasks, algorithms and hyperparameters (`safemr list ALGORITHM`)
safemr config ...     check configuration files, each put over the ones before it
"""

from __future__ import annotations

import contextlib
import importlib
import io
import sys
from collections.abc import Callable, Iterator, Sequence

from safemr.errors import UserError
from safemr.names import unknown

# Command -> module with main(arguments) -> exit status, imported only when it is called.
COMMANDS = {
    "train": "safemr.experiment.train",
    "evaluate": "safemr.learning.evaluation",
    "certify": "safemr.measure.certify",
    "records": "safemr.experiment.overview",
    "list": "safemr.experiment.listing",
    "config": "safemr.experiment.config",
}


@contextlib.contextmanager
def reported_errors() -> Iterator[None]:
    """Print a UserError as one line on standard error and exit with its status (2)."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a letter that the terminal lacks stops nothing
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        yield
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(getattr(error, "exit_code", 2)) from None


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
