"""Files that are replaced as a whole, and arrays in them: a crash leaves the old or the new one."""

from __future__ import annotations

import contextlib
import os
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from safemr.errors import UserError

Arrays = Mapping[str, NDArray[Any]]

POLICY = "policy.npz"  # in a record: the trained policy, which is optional
REPOSITORY = Path(__file__).resolve().parents[1]  # the folder that holds the packages


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


def save_arrays(path: Path | str, arrays: Arrays) -> None:
    """Write a compressed `.npz` without pickled objects; it appears whole or not at all."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with replacing(Path(path), durable=False) as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def load_arrays(path: Path | str) -> Arrays:
    """The arrays of `save_arrays`. Raises UserError for anything else."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is not a readable archive of arrays: {error}") from error


class NoPolicyError(UserError):
    """A record has no policy file, which is optional."""


def policy_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a ``policy.npz``. Pickled objects, which could run code, are refused.

    Raises NoPolicyError where there is no such file, and UserError where it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError as error:
        raise NoPolicyError(f"{path}: no such policy; train the run first") from error
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is not a readable policy file: {error}") from error


def _sync_directory(folder: Path) -> None:
    """Make a rename inside ``folder`` durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
