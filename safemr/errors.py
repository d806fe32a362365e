"""What the user is told: the one exception that means "the user can fix this", and messages."""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Iterator
from typing import Any, TextIO


class UserError(Exception):
    """A single-line message that names the culprit and the remedy.

    Command-line entry points print it to standard error and exit with status 2; anything else that
    escapes is a bug and keeps its traceback.
    """


def tell(message: str, stream: TextIO | None = None, *, end: str = "\n") -> None:
    """Print to standard error, or to ``stream``, without ever failing.

    Ctrl-C also ends the `tee` that a run writes to, and logs lie on disks that fill up: that nobody
    hears is no reason to lose a run.
    """
    with contextlib.suppress(OSError):
        print(message, file=stream or sys.stderr, end=end, flush=True)


def show(value: Any) -> str:
    """A short one-line picture of any value for an error message."""
    text = ascii(value)
    return text if len(text) <= 80 else text[:77] + "..."


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
