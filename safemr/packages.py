"""Modules of other packages: how they are named and found, and which sources they are.

An algorithm, or a family of energy functions, is a module of any package that Python can import, by
its dotted name, ``my_package.my_algorithm``, or by a shorter one that the package registers:

    [project.entry-points."safemr.algorithms"]
    my_algorithm = "my_package.my_algorithm"

A run's configuration says the dotted name, whichever was written, and the package; so the digest of
a run does not depend on how its package was installed. Which version of the package it was, and
which sources, its provenance says.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import importlib.util
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

from safemr.errors import UserError

# Groups of entry points; the first is our own package of algorithms, too.
ALGORITHMS, CERTIFICATES = "safemr.algorithms", "safemr.certificates"


@functools.cache
def registered(group: str) -> dict[str, str]:
    """Short name -> dotted name of the module, as the installed packages say."""
    return {entry.name: entry.module for entry in metadata.entry_points(group=group)}


def is_outside(name: str) -> bool:
    """Whether a name is a module's of another package."""
    return "." in name


def package_of(name: str) -> str:
    """The package of a module, by whose name it is imported."""
    return name.partition(".")[0]


def origin(name: str) -> Path | None:
    """The file of a module; None where there is no such module."""
    with contextlib.suppress(ImportError, AttributeError, ValueError):
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.origin is not None:
            return Path(spec.origin)
    return None


def imported(name: str) -> ModuleType:
    """A module of another package.

    Raises:
        UserError: it is not there, or fails while it is imported, with the reason.
    """
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if not f"{name}.".startswith(f"{error.name}."):
            raise _failing(name, error) from error
        raise UserError(
            f"there is no module {error.name}, of which {name} is asked for; install its package, "
            "or name the folder that holds it in PYTHONPATH"
        ) from error
    except Exception as error:  # whatever is wrong in that file, its author wants to know where
        raise _failing(name, error) from error


def _failing(name: str, error: Exception) -> UserError:
    reason = str(error).partition("\n")[0]
    return UserError(f"{name} does not import: {type(error).__name__}: {reason}")


def sources(name: str) -> list[Path]:
    """The Python files of the package that a module belongs to; nothing where it is not found."""
    spec = None
    with contextlib.suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(package_of(name))
    if spec is not None and spec.submodule_search_locations is None:  # a package of one file
        return [Path(spec.origin)] if spec.origin else []
    folders = [Path(folder) for folder in (spec and spec.submodule_search_locations) or ()]
    return sorted(path for folder in folders for path in folder.rglob("*.py"))


def digest(name: str) -> str:
    """SHA-256 of the package's sources."""
    state = hashlib.sha256()
    for path in sources(name):
        content = path.read_bytes()
        state.update(f"{path.name}:{len(content)}\n".encode() + content)
    return state.hexdigest()


def provenance(name: str) -> dict[str, Any]:
    """Where a module comes from: package, distributions with their versions, and its sources."""
    package = package_of(name)
    found = metadata.packages_distributions().get(package, [])
    return {
        "module": name,
        "package": package,
        "distributions": {each: metadata.version(each) for each in sorted(set(found))},
        "sources": digest(name),
    }
