"""`import safemr`: cheap, and everything that it promises is there."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import safemr

ROOT = Path(__file__).resolve().parents[1]


def test_importing_the_package_imports_nothing_heavy() -> None:
    program = (
        "import sys, safemr; dir(safemr); "
        "heavy = ('torch', 'gymnasium', 'mujoco', 'numpy', 'pandas'); "
        "print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", safemr.__all__)
def test_each_name_is_that_of_its_module_and_is_documented(name: str) -> None:
    value = getattr(safemr, name)
    assert value is getattr(importlib.import_module(value.__module__), name)
    assert value.__doc__
    assert name in (safemr.__doc__ or "")
    assert name in dir(safemr)


def test_another_name_is_missing_as_from_any_module() -> None:
    with pytest.raises(AttributeError, match="no attribute 'load_polices'"):
        safemr.load_polices  # noqa: B018
    assert importlib.import_module("safemr.errors").UserError is safemr.UserError


def test_the_repository_imports_from_the_modules() -> None:
    """What goes through the face is hidden from `safemr.experiment.sources`."""
    paths = [path for part in ("safemr", "workflow") for path in (ROOT / part).rglob("*.py")]
    found = {
        (path.name, alias.name)
        for path in paths
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ImportFrom) and node.module == "safemr"
        for alias in node.names
        if alias.name in safemr.__all__
    }
    assert len(paths) > 80
    assert found == set()
