"""Folders that a configuration may name for results and figures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from safemr.errors import UserError, show
from safemr.files import REPOSITORY

_ROOT = re.compile(r"(/|(\.\./)*)[A-Za-z0-9_][A-Za-z0-9._-]*(/[A-Za-z0-9_][A-Za-z0-9._-]*)*")
_SOURCES = {
    *("benchmarks", "config", "docs", "envs", "examples", "profiles", "safemr", "tests"),
    "workflow",
}


def root(value: Any, where: str) -> Path:
    """A folder for results or figures, which lies neither among the sources nor around them.

    Raises UserError, naming ``where`` it is written, for any other value.
    """
    if not isinstance(value, str) or not _ROOT.fullmatch(value):
        raise UserError(
            f"{where} must be a path of plain names, from here, from above (../) or from / "
            f"(no hidden folder, no '..' but at the start), not {show(value)}"
        )
    path = Path(value)
    place = path.resolve()
    if path.parts[0] in _SOURCES or _among_sources(place):
        raise UserError(f"{where} = {value!r} lies among the sources; choose another folder")
    if place in (REPOSITORY, *REPOSITORY.parents, Path.cwd(), *Path.cwd().parents):
        raise UserError(f"{where} = {value!r} contains the repository; choose a folder beside it")
    if path.exists() and not path.is_dir():
        raise UserError(f"{where} = {value!r} is a file; choose a folder")
    return path


def _among_sources(place: Path) -> bool:
    inside = place.is_relative_to(REPOSITORY)
    first = place.relative_to(REPOSITORY).parts[:1] if inside else ()
    return any(name in _SOURCES or name.startswith(".") for name in first)
