"""Compiled functions, cached where this user may keep a cache, and compiled anew elsewhere.

Numba keeps its cache beside the sources or below the home folder, and fails at import where it can
write to neither: in containers, for service accounts, with a read-only installation. It then goes
into a folder of this user's own below the temporary one. Such a cache is code that is loaded, so a
folder that anybody else could have written to is not used.
"""

from __future__ import annotations

import functools
import os
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba

VARIABLE = "NUMBA_CACHE_DIR"  # where Numba looks first


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """A decorator: `numba.njit` with these options, and a cache where there can be one."""

    def decorate(function: Callable[..., Any]) -> Any:
        cache = _find_cache(Path(function.__code__.co_filename).parent)
        return numba.njit(cache=cache, **options)(function)

    return decorate


@functools.cache
def _find_cache(sources: Path) -> bool:
    """Whether Numba has a place for what it compiles from a folder; gives it one if need be."""
    given = os.environ.get(VARIABLE)
    if given and _is_writable(Path(given)):
        return True
    if _is_writable(sources / "__pycache__"):
        return True
    # Without a home Numba would make a folder named "~".
    user = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.path.isabs(user) and _is_writable(Path(user, "numba")):
        return True
    try:
        own = Path(tempfile.gettempdir(), f"numba-{os.geteuid()}")
    except FileNotFoundError:  # there is no temporary folder either
        return False
    if not (_is_ours_alone(own) and _is_writable(own)):
        return False
    # Both: Numba reads the variable at import, and now and then again.
    os.environ[VARIABLE] = str(own)
    numba.config.CACHE_DIR = str(own)  # type: ignore[attr-defined]
    return True


def _is_writable(folder: Path) -> bool:
    """Whether the folder exists, or can be made, and a file can be made in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _is_ours_alone(folder: Path) -> bool:
    """Whether the folder exists, or can be made, and belongs to nobody else."""
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return False
    mine = stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid()
    return mine and not status.st_mode & 0o077
