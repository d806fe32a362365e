"""Files that are replaced as a whole: a reader or a crash sees the old or the new one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO


@contextlib.contextmanager
def replacing(path: Path, *, durable: bool = True) -> Iterator[BinaryIO]:
    """A stream that takes the place of ``path`` when the block ends without an exception.

    ``durable`` also waits until the bytes are on the disk, so that a power failure cannot undo it.
    After a failure the previous file is untouched; only a kill leaves a ``*.tmp`` file behind.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as stream:
            yield stream
            if durable:
                stream.flush()
                os.fsync(stream.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if durable:
        _sync_directory(path.parent)


def write(path: Path, content: bytes, *, durable: bool = True) -> None:
    """Replace ``path`` by ``content``; see `replacing`."""
    with replacing(path, durable=durable) as stream:
        stream.write(content)


def _sync_directory(folder: Path) -> None:
    """Make a rename inside ``folder`` durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
