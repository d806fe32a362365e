"""The package `envs` beside this one, which registers the tasks with Gymnasium."""

from __future__ import annotations

import functools
import importlib
import importlib.util
from pathlib import Path

from safemr.errors import UserError

PACKAGE = "envs"


@functools.cache
def register_tasks() -> None:
    """Import the environments, so that Gymnasium knows the tasks.

    Raises:
        UserError: if Python finds another package of that name first, as `python -m` does in a
            folder that holds one.
    """
    ours = (Path(__file__).resolve().parents[1] / PACKAGE).resolve()
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None:
        raise UserError(f"the package {PACKAGE} is missing: {ours}")
    found = Path(spec.origin or next(iter(spec.submodule_search_locations or [""])))
    if found.resolve().parent != ours:
        raise UserError(
            f"Python found another package {PACKAGE}, {found}, before the tasks' own, {ours}: "
            "start from another folder or with `python -P`, or take that one out of PYTHONPATH"
        )
    importlib.import_module(PACKAGE)
