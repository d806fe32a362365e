"""Signals that ask a program to end: SIGINT, SIGTERM and SIGHUP.

Whether one may end it at once depends on what would be lost, so the program says where it is:

    with StopSignals() as signals:
        ...                  # nothing is begun: a signal ends the program at once
        signals.defer()      # work would be lost: a signal is noted in `received`
        ...
        signals.ignore()     # all is done: nothing may spoil the exit status
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from types import FrameType, TracebackType
from typing import Any, Self

# A closed terminal sends SIGHUP; a scheduler SIGTERM; Ctrl-C SIGINT.
NUMBERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
# Slurm sends SIGTERM twice within 30 ms, and a person may press Ctrl-C twice: only what comes
# later than this after the first one is meant as a second request.
REPEATED = 2.0


class StoppedError(SystemExit):
    """A signal ended the program at once; the exit status is that of shells, 128 + its number."""

    def __init__(self, number: signal.Signals) -> None:
        super().__init__(128 + number)
        self.number = number


class StopSignals(contextlib.AbstractContextManager["StopSignals"]):
    """Handlers of the signals that were not ignored before, as ``nohup`` ignores SIGHUP.

    Attributes:
        received: The first signal that was noted.
    """

    def __init__(self) -> None:
        self.received: signal.Signals | None = None
        self._since = 0.0  # when it came
        self._before: dict[signal.Signals, Any] = {}
        self._act = self._end

    def __enter__(self) -> Self:
        self.install()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def install(self) -> Self:
        """Handle signals until the process ends: ``with`` without its end."""
        for number in NUMBERS:
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._handle)
        return self

    def defer(self) -> None:
        """From here on a signal is noted; one that comes more than 2 s after it raises.

        Raises StoppedError for a signal that came before and whose exception was swallowed, as a
        bare ``except`` in a package that is being imported does.
        """
        if self.received is not None:
            raise StoppedError(self.received)
        self._act = self._note

    def ignore(self) -> None:
        """From here on signals do nothing."""
        self._act = lambda number: None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._act(signal.Signals(number))

    def _end(self, number: signal.Signals) -> None:
        self.received = number
        raise StoppedError(number)

    def _note(self, number: signal.Signals) -> None:
        now = time.monotonic()
        if self.received is None:
            self.received, self._since = number, now
            announce(f"{number.name}: stopping at the next log point; another one stops at once")
        elif now - self._since > REPEATED:
            raise StoppedError(number)


def announce(message: str) -> None:
    """A line on standard error by a handler, which may have interrupted another line's writing:
    a text stream cannot be entered twice."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        os.write(sys.stderr.fileno(), f"{message}\n".encode())
