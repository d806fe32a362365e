"""What is kept of measurements: found again exactly, measured anew when anything changes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from sample_record import make_record

from safemr.errors import UserError
from safemr.experiment import provenance
from safemr.experiment.record import Record
from safemr.measure import store
from safemr.measure.store import Measurements

KIND = "controllers"


class Counting:
    """A measurement that says how often it was made."""

    def __init__(self, value):
        self.value, self.calls = value, 0

    def __call__(self):
        self.calls += 1
        return self.value


@pytest.fixture
def kept(tmp_path: Path) -> Measurements:
    return Measurements(tmp_path)


def test_rows_are_measured_once_and_come_back_exactly(kept: Measurements) -> None:
    rows = [{"third": 1 / 3, "none": math.nan, "count": 7, "name": "a"}]
    measure = Counting(rows)
    first = kept.rows(KIND, "one", {"seed": 1}, measure)
    second = kept.rows(KIND, "one", {"seed": 1}, measure)
    assert measure.calls == 1
    for found in (first, second):
        assert list(found[0]) == list(rows[0]), "a table's columns keep their order"
        assert math.isnan(found[0].pop("none"))
        assert found == [{"third": 1 / 3, "count": 7, "name": "a"}]


def test_arrays_are_measured_once_and_come_back_exactly(kept: Measurements) -> None:
    measure = Counting({"x": np.linspace(0, 1, 7), "flag": np.array(True)})
    first = kept.arrays("margins", "one", {}, measure)
    second = kept.arrays("margins", "one", {}, measure)
    assert measure.calls == 1
    assert first.keys() == second.keys() == {"x", "flag"}
    np.testing.assert_array_equal(second["x"], measure.value["x"])
    assert second["flag"].dtype == bool


def test_a_measurement_says_by_what_it_was_made(kept: Measurements) -> None:
    """Flights judge claims, and differ between processors: as traceable as a record."""
    kept.rows(KIND, "one", {}, lambda: [1])
    kept.arrays("margins", "one", {}, lambda: {"x": np.zeros(3)})
    (rows,), (arrays,) = ((kept.folder / kind).iterdir() for kind in (KIND, "margins"))
    notes = [json.loads(rows.read_text()), json.loads(str(np.load(arrays)[store.HEADER]))]
    expected = provenance.collect()
    for note in notes:
        assert note["made"] == {name: expected[name] for name in ("source", "packages", "cpu")}


def test_other_inputs_or_another_version_replace_what_was_kept(
    kept: Measurements, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = Counting(0)
    kept.rows(KIND, "other", {"seed": 1}, other)
    measure = Counting(1)
    for seed in (1, 2, 2):
        kept.rows(KIND, "one", {"seed": seed}, measure)
    assert measure.calls == 2
    monkeypatch.setitem(store.VERSIONS, KIND, store.VERSIONS[KIND] + 1)
    kept.rows(KIND, "one", {"seed": 2}, measure)
    assert measure.calls == 3
    names = sorted(path.name[:-18] for path in (kept.folder / KIND).iterdir())
    assert names == ["one", "other"], "what is superseded is removed, other labels are not"


@pytest.mark.parametrize("damage", ["truncated", "tampered", "empty"])
def test_a_damaged_file_is_named_and_never_believed(kept: Measurements, damage: str) -> None:
    kept.rows(KIND, "one", {}, lambda: [{"return": 1.5}])
    (path,) = (kept.folder / KIND).iterdir()
    text = path.read_text()
    changed = {"truncated": text[:-20], "tampered": text.replace("1.5", "9.5"), "empty": ""}
    path.write_text(changed[damage])
    with pytest.raises(UserError, match=r"controllers/one-[0-9a-f]{12}\.json is damaged.*delete"):
        kept.rows(KIND, "one", {}, lambda: [])
    assert path.read_text() == changed[damage]


def test_damaged_arrays_are_named(kept: Measurements) -> None:
    kept.arrays("margins", "one", {}, lambda: {"x": np.zeros(1000)})
    (path,) = (kept.folder / "margins").iterdir()
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(UserError, match=r"margins/one-[0-9a-f]{12}\.npz is damaged.*delete"):
        kept.arrays("margins", "one", {}, dict)


def test_what_is_only_unreadable_is_not_advised_to_be_deleted(kept: Measurements) -> None:
    """A folder in a file's place stands for a permission that is missing, too (root reads all)."""
    kept.rows(KIND, "one", {}, lambda: [1])
    kept.arrays("margins", "one", {}, lambda: {"x": np.zeros(3)})
    for kind, read in (
        (KIND, lambda: kept.rows(KIND, "one", {}, list)),
        ("margins", lambda: kept.arrays("margins", "one", {}, dict)),
    ):
        (path,) = (kept.folder / kind).iterdir()
        path.unlink()
        path.mkdir()
        with pytest.raises(UserError, match="cannot be read: Is a directory") as caught:
            read()
        assert "delete" not in str(caught.value)


def test_somebodys_own_file_beside_the_measurements_stays(kept: Measurements) -> None:
    kept.rows(KIND, "one", {"seed": 1}, lambda: 1)
    own = kept.folder / KIND / "one-my_own_copy_.json"  # as long as a name of ours
    own.write_text("{}")
    kept.rows(KIND, "one", {"seed": 2}, lambda: 2)
    assert own.exists()
    assert len(list(own.parent.iterdir())) == 2


def test_a_failed_measurement_keeps_nothing(kept: Measurements) -> None:
    def fails() -> None:
        raise UserError("no")

    with pytest.raises(UserError):
        kept.rows(KIND, "one", {}, fails)
    assert not (kept.folder / KIND).exists()


def test_a_record_is_identified_by_its_content(tmp_path: Path) -> None:
    folder = make_record(tmp_path)
    inputs = Record.open(folder).inputs
    assert inputs["record"].endswith(folder.name)
    provenance = json.loads((folder / "provenance.json").read_text())
    assert inputs["files"] == provenance["files"]
    (folder / "progress.csv").write_text("step\n1\n")
    with pytest.raises(UserError, match="checksum"):
        Record.open(folder)
