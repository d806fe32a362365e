"""What was measured on finished records, kept beside them so that it is measured once.

Flying ten thousand encounters or searching a certificate takes seconds to minutes and gives the
same numbers every time. `kept` stores such a result in
``<results root>/measurements/<kind>/<label>-<key>``, where the key is a digest of everything the
result depends on: the kind, its version, and the caller's inputs, among them the checksums of the
records (`Record.inputs`). What is stored under another key of the same label was superseded and is
removed. Deleting the folder measures everything anew.

Rows of numbers are kept as JSON, arrays as npz without pickles. Beside them stands by which
revision, packages and processor they were measured: an episode differs between processors.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from safemr import files
from safemr.errors import UserError
from safemr.experiment import provenance, records

FOLDER = "measurements"
HEADER = "measurement"  # the array of an npz that says what it is

# Raise a version when the code behind a kind changes what it returns;
# tests/test_kept_measurements.py measures one of each again and says so.
VERSIONS = {
    "controllers": 1,
    "certificates": 1,
    "margins": 1,
    "oracle": 1,
    "encounters": 1,
    "rollouts": 1,
    "episodes": 1,
    "unseen_layouts": 1,
    "filters": 1,
    "aircraft_frontier": 1,
    "aircraft_slices": 2,
    "aircraft_learners": 1,
    "aircraft_references": 1,
    "aircraft_neural": 1,
    "aircraft_neural_slice": 2,
}

T = TypeVar("T")


class Measurements:
    """The measurements kept under a results root."""

    def __init__(self, root: Path | str) -> None:
        self.folder = Path(root) / FOLDER

    def rows(
        self,
        kind: str,
        label: str,
        inputs: Mapping[str, Any],
        measure: Callable[[], T],
    ) -> T:
        """A JSON value: the kept one, or that of ``measure``, which is then kept.

        Tuples come back as lists. Raises UserError where a kept file is damaged.
        """
        path, header = self._place(kind, label, inputs, ".json")
        if path.exists():
            try:
                stored = json.loads(path.read_text(encoding="utf-8"))
                if _digest(stored["value"]) != stored["sha256"]:
                    raise ValueError("its value does not have the checksum it states")
                return stored["value"]
            except OSError as error:
                raise _unreadable(path, error) from error
            except (ValueError, KeyError, TypeError) as error:
                raise _damaged(path, error) from error
        value = json.loads(json.dumps(measure()))  # what a reader of the file gets
        content = {**header, "made": _made(), "sha256": _digest(value), "value": value}
        path.parent.mkdir(parents=True, exist_ok=True)
        # Not sorted: a table's columns keep their order.
        files.write(path, (json.dumps(content, indent=1) + "\n").encode())
        self._supersede(path)
        return value

    def arrays(
        self,
        kind: str,
        label: str,
        inputs: Mapping[str, Any],
        measure: Callable[[], files.Arrays],
    ) -> files.Arrays:
        """Named arrays: the kept ones, or those of ``measure``, which are then kept."""
        path, header = self._place(kind, label, inputs, ".npz")
        if path.exists():
            try:  # the archive's own checksums guard it
                return {k: v for k, v in files.load_arrays(path).items() if k != HEADER}
            except UserError as error:
                if isinstance(error.__cause__, OSError):
                    raise _unreadable(path, error.__cause__) from error
                raise _damaged(path, error) from error
        made = measure()
        note = json.dumps({**header, "made": _made()}, sort_keys=True)
        files.save_arrays(path, {**made, HEADER: np.array(note)})
        self._supersede(path)
        return made

    def _place(
        self, kind: str, label: str, inputs: Mapping[str, Any], end: str
    ) -> tuple[Path, dict[str, Any]]:
        header = {"kind": kind, "version": VERSIONS[kind], "inputs": dict(inputs)}
        name = f"{records.folder_name(label)}-{_digest(header)[:12]}{end}"
        return self.folder / kind / name, header

    @staticmethod
    def _supersede(path: Path) -> None:
        ours = re.compile(re.escape(path.stem[:-12]) + r"[0-9a-f]{12}" + re.escape(path.suffix))
        for other in path.parent.iterdir():
            if ours.fullmatch(other.name) and other != path:
                other.unlink(missing_ok=True)


def _made() -> dict[str, Any]:
    """By what a measurement is made; no part of its key, since another place would do."""
    return {
        "source": provenance.source_revision(),
        "packages": provenance.package_versions(),
        "cpu": provenance.cpu_model(),
    }


def _digest(value: Any) -> str:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _unreadable(path: Path, error: OSError) -> UserError:
    return UserError(f"measurement {path} cannot be read: {error.strerror or error}")


def _damaged(path: Path, error: Exception) -> UserError:
    return UserError(f"measurement {path} is damaged ({error}): delete it to measure again")
