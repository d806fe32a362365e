"""Records are complete or absent, and what must not be believed is refused."""

from __future__ import annotations

import json
import math
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sample_record import CONFIG, POLICY, ROWS, make_record

from safemr import files
from safemr.errors import UserError
from safemr.experiment import records
from safemr.experiment.checkpoints import RunSession
from safemr.experiment.record import Record
from safemr.experiment.records import RecordError
from safemr.measure import certify
from safemr.report import recorded, statistics


@pytest.fixture
def record(tmp_path: Path) -> Path:
    return make_record(tmp_path)


# --- what is written is what is read ------------------------------------------------------------


def test_digest_is_of_the_meaning_not_the_spelling() -> None:
    shuffled = dict(reversed(list(CONFIG.items())))
    assert records.config_digest(shuffled) == records.config_digest(CONFIG)
    assert records.config_digest({**CONFIG, "seed": 101}) != records.config_digest(CONFIG)
    with pytest.raises(ValueError, match="JSON"):
        records.canonical_json({"x": math.nan})


def test_variant_labels_become_plain_folder_names() -> None:
    assert records.folder_name("SafeMR[0.45,0.15]") == "SafeMR-0.45-0.15"
    assert records.folder_name("FAC-phi0") == "FAC-phi0"


values = st.floats(allow_nan=True, allow_infinity=True)
rows_of_metrics = st.lists(
    st.dictionaries(st.sampled_from(["a", "b", "time_wall_s"]), values), min_size=1, max_size=5
)


@given(rows_of_metrics)
def test_progress_round_trips_exactly(metrics: list[dict[str, float]]) -> None:
    rows = [{"step": 10 * index, **row} for index, row in enumerate(metrics)]
    text = records.format_progress(rows)
    parsed = records.parse_progress(text)
    columns = sorted({name for row in metrics for name in row})
    for row, again in zip(rows, parsed, strict=True):
        assert list(again) == ["step", *columns]
        for name in columns:
            np.testing.assert_equal(again[name], row.get(name, math.nan))
    assert records.format_progress(parsed) == text


def test_a_written_record_is_verified_and_read(record: Path, tmp_path: Path) -> None:
    records.verify_record(record)
    runs, progress = records.read_records(tmp_path)
    assert runs.loc[0, ["task", "variant", "seed"]].tolist() == [
        "Pillars-0.15-Goal",
        "FAC-phih",
        100,
    ]
    assert list(progress) == ["task", "variant", "seed", "step", "metric", "value"]
    assert len(progress) == 6
    np.testing.assert_array_equal(
        files.policy_arrays(record / "policy.npz")["weights"], POLICY["weights"]
    )


def test_a_record_without_its_policy_is_complete(record: Path) -> None:
    (record / "policy.npz").unlink()
    records.verify_record(record)


# --- what must not be believed -------------------------------------------------------------------


def edit(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / name
        path.write_text(change(path.read_text()))

    return apply


def reseal(name: str, change: Callable[[str], str]) -> Callable[[Path], None]:
    """An edit by someone who also mends the checksum."""

    def apply(folder: Path) -> None:
        edit(name, change)(folder)
        provenance = json.loads((folder / "provenance.json").read_text())
        digest = records.hashlib.sha256((folder / name).read_bytes()).hexdigest()
        provenance["files"][name] = digest
        (folder / "provenance.json").write_text(json.dumps(provenance))

    return apply


def reprovenance(**changes: Any) -> Callable[[Path], None]:
    return edit("provenance.json", lambda text: json.dumps({**json.loads(text), **changes}))


def append_row(*cells: str) -> Callable[[str], str]:
    return lambda text: text + ",".join(cells) + "\n"


FAULTS: dict[str, tuple[Callable[[Path], None], str]] = {
    "no provenance": (lambda f: (f / "provenance.json").unlink(), "provenance.json is missing"),
    "no progress": (lambda f: (f / "progress.csv").unlink(), "progress.csv is missing"),
    "no config": (lambda f: (f / "config.json").unlink(), "config.json is missing"),
    "truncated progress": (edit("progress.csv", lambda t: t[: len(t) // 2]), "checksum"),
    "empty progress": (edit("progress.csv", lambda t: ""), "checksum"),
    "edited number": (edit("progress.csv", lambda t: t.replace("0.1", "9.9")), "checksum"),
    "edited config": (edit("config.json", lambda t: t.replace("0.99", "0.9")), "checksum"),
    "resealed config": (reseal("config.json", lambda t: t.replace("0.99", "0.9")), "digest"),
    "truncated provenance": (edit("provenance.json", lambda t: t[:40]), "not JSON"),
    "provenance is a list": (edit("provenance.json", lambda t: "[]"), "lacks"),
    "another schema": (reprovenance(schema=2), "schema"),
    "unfinished": (reprovenance(status="running"), "complete"),
    "another digest": (reprovenance(digest="0" * 12), "digest"),
    "another variant": (reprovenance(variant="SafeMR"), "belongs to"),
    "no files": (reprovenance(files={}), "checksum"),
    "files is a list": (reprovenance(files=[]), "complete"),
    "foreign policy": (lambda f: (f / "policy.npz").write_bytes(b"x"), "checksum"),
    "no header": (reseal("progress.csv", lambda t: t.partition("\n")[2]), "header"),
    "header only": (reseal("progress.csv", lambda t: t.partition("\n")[0] + "\n"), "no rows"),
    "short row": (reseal("progress.csv", append_row("30", "1")), "cells"),
    "text in a row": (reseal("progress.csv", append_row("30", "a", "1", "1")), "not a number"),
    "steps fall": (reseal("progress.csv", append_row("15", "1", "1", "1")), "do not increase"),
    "step repeated": (reseal("progress.csv", append_row("20", "1", "1", "1")), "do not increase"),
    "ends early": (
        reseal("progress.csv", lambda t: "\n".join(t.splitlines()[:2]) + "\n"),
        "ends at step 10 of 20",
    ),
    "no evaluation": (
        reseal("progress.csv", lambda t: t.replace("eval_return", "train_return")),
        "no eval_return",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_damaged_record_is_refused_with_path_and_repair(
    name: str, record: Path, tmp_path: Path
) -> None:
    damage, expected = FAULTS[name]
    damage(record)
    for read in (
        lambda: records.verify_record(record),
        lambda: records.read_records(tmp_path, [record.relative_to(tmp_path)]),
    ):
        with pytest.raises(RecordError) as caught:
            read()
        message = str(caught.value)
        assert expected in message
        assert str(record) in message
        assert f"rm -r {shlex.quote(str(record))} && snakemake" in message
        assert "\n" not in message


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"steps": "20"}, "steps in config.json is not a whole number of at least 0"),
        ({"seed": "100"}, "seed in config.json is not a whole number of at least 0"),
        ({"algorithm": {}}, "algorithm in config.json has no name"),
        ({"algorithm": "fac"}, "algorithm in config.json has no name"),
    ],
)
def test_a_consistent_record_of_wrong_types_is_refused(
    changes: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """Programs outside write records, too: their digests and checksums are as they should be."""
    config = CONFIG | changes
    folder = tmp_path / records.record_path(config, "V")
    folder.mkdir(parents=True)
    contents = {
        "config.json": json.dumps(config),
        "progress.csv": records.format_progress(ROWS),
    }
    sums = {name: records.hashlib.sha256(text.encode()).hexdigest()
            for name, text in contents.items()}  # fmt: skip
    digest = records.config_digest(config)
    provenance = {
        "schema": 1,
        "digest": digest,
        "variant": "V",
        "status": "complete",
        "files": sums,
    }
    for name, text in (contents | {"provenance.json": json.dumps(provenance)}).items():
        (folder / name).write_text(text)
    with pytest.raises(RecordError, match=said):
        records.read_records(tmp_path)


def foreign_folders(root: Path, record: Path) -> dict[str, Path]:
    """Folders that are not a record's place, whatever they hold."""
    copied = root / "backup" / record.name  # a whole record, but somewhere else
    shutil.copytree(record, copied)
    shallow = root / "runs" / "Pillars-0.15-Goal"
    named = root / "results" / "seed0-0123456789ab"
    thesis = root / "thesis"
    for folder in (named, thesis):
        folder.mkdir(parents=True)
        (folder / "chapter1.tex").write_text("years of work")
    (root / "empty").mkdir()
    return {"a person's": thesis, "named like one": named, "above one": shallow, "a copy": copied,
            "empty": root / "empty", "absent": root / "nowhere",
            "a file": record / "policy.npz"}  # fmt: skip


def test_nothing_but_a_record_is_ever_advised_to_be_removed(record: Path, tmp_path: Path) -> None:
    for kind, folder in foreign_folders(tmp_path, record).items():
        for read in (
            records.verify_record,
            Record.open,
            certify.certificate_of_record,
        ):
            with pytest.raises(RecordError) as caught:
                read(folder)
            message = str(caught.value)
            assert "rm " not in message, kind
            assert "remove" not in message, kind
            assert "<results root>/runs/<task>/<variant>/seed<n>-<digest>" in message, kind
            assert str(folder) in message
            assert "\n" not in message
    with pytest.raises(RecordError, match=r"it holds chapter1\.tex; a record is"):
        records.verify_record(tmp_path / "thesis")
    with pytest.raises(RecordError, match="no folder"):
        records.verify_record(tmp_path / "nowhere")


def test_a_record_beside_what_is_somebodys_own(record: Path) -> None:
    (record / "config.json").unlink()
    (record / "my notes.txt").write_text("why this run is the best")
    with pytest.raises(RecordError, match=r"my notes\.txt, which is no part of a record") as caught:
        records.verify_record(record)
    assert "rm " not in str(caught.value)


def test_the_advice_can_be_pasted_whatever_the_path(tmp_path: Path) -> None:
    folder = make_record(tmp_path / "a person's $(echo) folder")
    (folder / "config.json").unlink()
    with pytest.raises(RecordError) as caught:
        records.verify_record(folder)
    command = str(caught.value).partition("repair: ")[2].removesuffix(" && snakemake -j2")
    assert shlex.split(command) == ["rm", "-r", str(folder)]
    subprocess.run(command, shell=True, check=True)
    assert not folder.exists()
    assert folder.parent.exists()


def test_a_record_that_is_gone_needs_no_removal(record: Path) -> None:
    shutil.rmtree(record)
    with pytest.raises(RecordError, match=r"config\.json is missing; repair: snakemake -j2"):
        records.verify_record(record)


def test_a_record_in_the_wrong_place_is_refused(record: Path, tmp_path: Path) -> None:
    other = make_record(tmp_path, seed=101)
    shutil.rmtree(other)
    shutil.copytree(record, other)
    with pytest.raises(RecordError, match="belongs to"):
        records.verify_record(other)


def test_writing_again_after_a_crash_in_between(record: Path, tmp_path: Path) -> None:
    (record / "provenance.json").unlink()  # the crash came before the last file
    assert not records.is_complete(record)
    make_record(tmp_path)
    records.verify_record(record)


def test_records_are_listed_and_filtered(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for variant, seed in (("SafeMR", 0), ("SafeMR[0.45,0.15]", 0), ("SafeMR", 1)):
        config = {**CONFIG, "seed": seed}
        rows = [
            {"step": step, "eval_return": step + seed, "eval_cost": 0.0,
             "eval_cost_indicator": 0.5, "eval_zero_violation_share": 0.75}
            for step in (10, 20)
        ]  # fmt: skip
        source = {"source": {"commit": "0123456789abcdef", "dirty": seed == 1}, "wall_s": 90.0}
        folder = tmp_path / records.record_path(config, variant)
        records.write_record(folder, config, variant, rows, source)

    def listed(*arguments: str) -> list[list[str]]:
        assert recorded.main([str(tmp_path), *arguments]) == 0
        head, *rows = capsys.readouterr().out.split("\n\n")[0].splitlines()
        assert head.split()[:3] == ["task", "variant", "seed"]
        return [row.split() for row in rows]

    everything = listed()
    assert [row[1:3] for row in everything] == [
        ["SafeMR", "0"], ["SafeMR", "1"], ["SafeMR[0.45,0.15]", "0"]
    ]  # fmt: skip
    _, progress = records.read_records(tmp_path)  # the tables' own rule of what is final
    finals = statistics.final_scores(progress)
    finals = finals[(finals["metric"] == "eval_return") & (finals["variant"] == "SafeMR")]
    assert [float(row[5]) for row in everything[:2]] == finals["value"].tolist()
    assert everything[1][6:] == ["0.50", "75.0%", "1.5", "0123456*"]
    assert everything[0][3] in str(next(tmp_path.glob("runs/*/SafeMR/seed0-*")))
    # A label with brackets is itself before it is a pattern.
    assert listed("--variant", "SafeMR[0.45,0.15]") == everything[2:]
    assert listed("--variant", "SafeMR", "--seed", "1") == everything[1:2]
    assert listed("--task", "Pillars*", "--variant", "*") == everything
    assert listed("--variant", "SafeMR", "SafeMR*") == everything
    with pytest.raises(UserError, match=r"unknown variant 'SafeMr' in these records; did you mean"):
        recorded.main([str(tmp_path), "--variant", "SafeMr"])


def test_the_overview_names_faults_and_unfinished_runs(
    record: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert recorded.main([str(tmp_path)]) == 0
    with RunSession({**CONFIG, "seed": 101}, "FAC-phih", tmp_path) as session:
        session.resume()
        session.fail("critic_loss became inf at step 10")
    edit("progress.csv", lambda t: "")(record)
    assert recorded.main([str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert str(record) in printed
    assert "FAC-phih Pillars-0.15-Goal seed 101" in printed
    assert "critic_loss became inf" in printed
