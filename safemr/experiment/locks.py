"""One process at a time, by an advisory lock that the kernel drops when its owner dies.

There is no stale lock to recognise and no process number to mistake for another's, also after
SIGKILL, a reboot or in a container. The file's text only says who the owner is.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Callable
from pathlib import Path

from safemr.errors import UserError, tell

_GLANCE = 0.05  # seconds after which who only looked (`is_held`) has looked


class LockedError(UserError):
    """Another live process holds the lock."""

    exit_code = 3


class ProcessLock:
    """The lock file ``path``; ``work`` is what its owner does, for messages."""

    def __init__(self, path: Path, work: str) -> None:
        self.path, self._work = path, work
        self._descriptor: int | None = None

    def acquire(self, *, wait: bool, while_waiting: Callable[[], None] = lambda: None) -> None:
        """Take the lock; when it is held, wait for its owner to end, or raise LockedError.

        ``while_waiting`` is called twice a second and may raise to give up.
        """
        if self._try():
            return
        announced = False
        time.sleep(_GLANCE)
        while not self._try():
            owner = self._owner()
            if not wait:
                raise LockedError(f"{owner} {self._work}; wait for it or stop it")
            if not announced:
                tell(f"waiting for {owner}, which {self._work}")
                announced = True
            while_waiting()
            time.sleep(0.5)

    def _owner(self) -> str:
        with contextlib.suppress(OSError):  # the owner may be removing the file right now
            return self.path.read_text(errors="replace").strip() or "another process"
        return "another process"

    def _try(self) -> bool:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        except (FileNotFoundError, FileExistsError):
            if self.path.parent.exists():
                raise
            return False  # the owner removed the folder between our two calls
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The previous owner may have removed the file between our open and our lock.
            current = os.stat(self.path).st_ino == os.fstat(descriptor).st_ino
        except (BlockingIOError, FileNotFoundError):
            current = False
        if not current:
            os.close(descriptor)
            return False
        with contextlib.suppress(OSError):  # a full disk: the lock holds without its text
            os.ftruncate(descriptor, 0)
            os.write(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode())
        self._descriptor = descriptor
        return True

    def release(self) -> None:
        """Drop the lock; the file may stay."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def is_held(path: Path) -> bool:
    """Whether a live process holds the lock file; one that takes it meanwhile tries again."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError as error:
        return isinstance(error, BlockingIOError)
    finally:
        os.close(descriptor)
    return False
