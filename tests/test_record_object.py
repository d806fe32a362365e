"""`Record.open`: what a verified record says, without a file of it being read a second time."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest
from sample_record import CONFIG, POLICY, ROWS, make_record

from safemr.errors import UserError
from safemr.experiment import records
from safemr.experiment.record import Record
from safemr.experiment.records import RecordError
from safemr.learning.interface import Interface

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return make_record(tmp_path)


def test_it_says_what_was_written(folder: Path) -> None:
    record = Record.open(folder)
    assert record.config == CONFIG
    assert record.rows == ROWS
    assert record.provenance["digest"] == records.config_digest(CONFIG)
    assert (record.variant, record.task, record.seed) == ("FAC-phih", CONFIG["task"], 100)
    assert (record.algorithm, record.hyperparameters) == ("fac", {"gamma": 0.99})
    assert record.name == "FAC-phih (seed 100)"
    assert record.has_policy
    assert record.policy_arrays().keys() == POLICY.keys()
    np.testing.assert_array_equal(record.policy_arrays()["weights"], POLICY["weights"])


def test_it_says_how_its_task_was_met(tmp_path: Path) -> None:
    entry = {"action_repeat": 5, "action_scale": [0.05, 1.0], "decode": ["goal_lidar"]}
    for place, changes, expected in (
        ("plain", {}, Interface()),
        ("held", {"interface": entry}, Interface(5, (0.05, 1.0), ("goal_lidar",))),
    ):
        assert Record.open(make_record(tmp_path / place, **changes)).interface == expected
    folder = make_record(tmp_path, interface={"action_repeats": 5})
    with pytest.raises(UserError, match=r"'action_repeats' in .*interface"):
        _ = Record.open(folder).interface


def test_it_is_what_was_verified(folder: Path) -> None:
    """One that was opened goes on to say what it said; what is damaged is not opened again."""
    record = Record.open(folder)
    (folder / records.PROGRESS).write_text("step\n1\n")
    assert record.rows == ROWS
    with pytest.raises(RecordError, match=r"progress.csv does not have the checksum"):
        Record.open(folder)
    with pytest.raises(RecordError, match="no folder"):
        Record.open(folder.parent / "seed0")


def test_its_measurements_are_found_again(folder: Path) -> None:
    """The key of what is kept in results/measurements: neither of these two may change."""
    record = Record.open(folder)
    last = f"seed100-{records.config_digest(CONFIG)}"
    assert record.label == f"Pillars-0.15-Goal FAC-phih {last}"
    assert record.inputs == {
        "record": f"Pillars-0.15-Goal/FAC-phih/{last}",
        "files": record.provenance["files"],
    }


def test_one_without_a_policy_says_so(folder: Path) -> None:
    (folder / records.POLICY).unlink()
    record = Record.open(folder)
    assert not record.has_policy
    for read in (record.policy_arrays, record.policy):
        with pytest.raises(UserError, match="no such policy"):
            read()


def test_arrays_that_are_no_policy_are_refused_when_it_is_asked_for(folder: Path) -> None:
    with pytest.raises(UserError, match="not a policy file"):
        Record.open(folder).policy()


def test_no_other_code_takes_a_record_apart() -> None:
    """The names of a record's files, and its unchecked parts, are for those who write or verify."""
    # The last reads the unfinished ones, which are no records yet.
    own = {"experiment/records.py", "experiment/checkpoints.py", "experiment/begun.py"}
    names = {"CONFIG", "PROGRESS", "PROVENANCE", "parse_progress"}
    readers = set()
    for path in sorted((ROOT / "safemr").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "safemr.experiment.records":
                found = {alias.name for alias in node.names}
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "records":
                found = {node.attr}
            else:
                continue
            if found & names:
                readers.add(path.relative_to(ROOT / "safemr").as_posix())
    assert readers <= own
