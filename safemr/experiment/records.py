"""The record of one training run: what is written, and how it is checked.

A record is a folder ``runs/<task>/<variant>/seed<n>-<digest>/`` with

``config.json``      the resolved configuration, canonical JSON; its SHA-256 begins with the digest
``progress.csv``     one row a log point: ``step``, then the metrics in alphabetical order
``policy.npz``       the trained policy (optional: readers of curves and tables do without it)
``provenance.json``  where the record comes from and the SHA-256 of the other files; written last

so that a record is either complete or absent. Implementations outside this package write the same
files with `write_record` (or by hand) and are held to the same `verify_record`. Whoever asks what a
record says opens it (`safemr.experiment.record.Record`), or reads many as tables (`read_records`).
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from safemr import files
from safemr.errors import UserError
from safemr.files import POLICY

if TYPE_CHECKING:
    import pandas as pd

SCHEMA = 1
CONFIG, PROGRESS, PROVENANCE = "config.json", "progress.csv", "provenance.json"
REQUIRED_FILES = (CONFIG, PROGRESS, PROVENANCE)
REQUIRED_METRICS = ("eval_return", "eval_cost", "eval_zero_violation_share")
CONFIG_KEYS = {"schema", "task", "algorithm", "seed", "steps", "evaluation", "log_every"}
PROVENANCE_KEYS = {"schema", "digest", "variant", "status", "files"}
MEASURED = ("wall_s", "cpu_s", "peak_rss_mb")  # optional numbers of provenance.json

# Where a record stands, <results root>/runs/<task>/<variant>/seed<n>-<digest>, and whose files it
# may hold. Nothing else is ever advised to be removed.
_PLACE = re.compile(r"(^|.*/)runs/[^/]+/[^/]+/seed\d+-[0-9a-f]{12}")
_OWN = re.compile(r"config\.json|progress\.csv|policy\.npz|provenance\.json|\..+\.tmp")

Row = Mapping[str, float]


class RecordError(UserError):
    """A record that must not be believed; names its folder, the fault and the repair."""


def canonical_json(value: Any) -> str:
    """Sorted keys, no spaces, no NaN: equal values have equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def config_digest(config: Mapping[str, Any]) -> str:
    """The first 12 hexadecimal digits of the SHA-256 of the canonical JSON of a run's config."""
    return hashlib.sha256(canonical_json(config).encode()).hexdigest()[:12]


def folder_name(variant: str) -> str:
    """A variant's label as a folder name: ``SafeMR[0.45,0.15]`` -> ``SafeMR-0.45-0.15``."""
    return re.sub(r"[^A-Za-z0-9._+]+", "-", variant).strip("-")


def record_path(config: Mapping[str, Any], variant: str) -> Path:
    """The record's folder, relative to the results root."""
    seed = f"seed{config['seed']}-{config_digest(config)}"
    return Path("runs", config["task"]["name"], folder_name(variant), seed)


def format_progress(rows: Sequence[Row]) -> str:
    """Rows of metrics as CSV: shortest round-trip numbers, an empty cell where a metric is NaN."""
    columns = sorted({name for row in rows for name in row} - {"step"})
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["step", *columns])
    for row in rows:
        cells = (float(row.get(name, math.nan)) for name in columns)
        writer.writerow([int(row["step"]), *("" if math.isnan(x) else repr(x) for x in cells)])
    return buffer.getvalue()


def parse_progress(text: str) -> list[dict[str, float]]:
    """The inverse of `format_progress`.

    Raises:
        ValueError: a malformed header, row or number, or steps that do not increase.
    """
    header, *lines = list(csv.reader(io.StringIO(text))) or [[]]
    if header[:1] != ["step"] or len(set(header)) != len(header):
        raise ValueError("its header is not 'step' followed by distinct metrics")
    rows: list[dict[str, float]] = []
    for number, cells in enumerate(lines, start=2):
        if len(cells) != len(header):
            raise ValueError(f"line {number} has {len(cells)} cells instead of {len(header)}")
        try:
            values = [float(cell) if cell else math.nan for cell in cells[1:]]
            step = int(cells[0])
        except ValueError:
            raise ValueError(f"line {number} holds something that is not a number") from None
        if step <= (rows[-1]["step"] if rows else -1):
            raise ValueError(f"line {number}: its steps do not increase")
        rows.append({"step": step, **dict(zip(header[1:], values, strict=True))})
    if not rows:
        raise ValueError("it has no rows")
    return rows


def write_record(
    folder: Path,
    config: Mapping[str, Any],
    variant: str,
    rows: Sequence[Row],
    provenance: Mapping[str, Any],
    policy: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a whole record; ``provenance.json``, which vouches for the rest, comes last.

    Args:
        folder: The record's folder; created if absent.
        config: The resolved run configuration.
        variant: The label under which figures and tables show the run.
        rows: The progress rows, each with ``step``.
        provenance: What `safemr.experiment.provenance.collect` returns, or any JSON object of an
            outside implementation; the required keys are added here.
        policy: Arrays of the trained policy.
    """
    folder.mkdir(parents=True, exist_ok=True)
    contents = {
        CONFIG: (canonical_json(config) + "\n").encode(),
        PROGRESS: format_progress(rows).encode(),
    }
    if policy is not None:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **policy)
        contents[POLICY] = buffer.getvalue()
    (folder / PROVENANCE).unlink(missing_ok=True)
    for name, content in contents.items():
        files.write(folder / name, content)
    closing = {
        **provenance,
        "schema": SCHEMA,
        "digest": config_digest(config),
        "variant": variant,
        "status": "complete",
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()},
    }
    text = json.dumps(closing, sort_keys=True, indent=1, allow_nan=False) + "\n"
    files.write(folder / PROVENANCE, text.encode())


def verify_record(folder: Path) -> None:
    """Check checksums, schema, digest, place and progress of the record in ``folder``.

    Raises:
        RecordError: one line with the folder, the fault and the command that repairs it.
    """
    verified(folder)


def is_complete(folder: Path) -> bool:
    """Whether ``folder`` holds a record that passes `verify_record`."""
    try:
        verified(folder)
    except RecordError:
        return False
    return True


def verified(folder: Path) -> tuple[dict[str, Any], dict[str, Any], list[dict[str, float]]]:
    """The config, provenance and progress rows of a record that passed every check.

    Raises RecordError as `verify_record`.
    """

    _require_place(folder)

    def refuse(fault: str) -> RecordError:
        return RecordError(f"record {folder}: {fault}; repair: {_repair(folder)}")

    missing = [name for name in REQUIRED_FILES if not (folder / name).is_file()]
    if missing:
        raise refuse(f"{missing[0]} is missing")
    contents = {name: (folder / name).read_bytes() for name in (*REQUIRED_FILES, POLICY)
                if (folder / name).is_file()}  # fmt: skip
    try:
        config, provenance = json.loads(contents[CONFIG]), json.loads(contents[PROVENANCE])
    except ValueError as error:
        raise refuse(f"config.json or provenance.json is not JSON ({error})") from None
    for name, value, keys in (
        (CONFIG, config, CONFIG_KEYS),
        (PROVENANCE, provenance, PROVENANCE_KEYS),
    ):
        if not isinstance(value, dict) or keys - value.keys():
            lacking = sorted(keys - value.keys()) if isinstance(value, dict) else sorted(keys)
            raise refuse(f"{name} lacks {', '.join(lacking)}")
    if config["schema"] != SCHEMA or provenance["schema"] != SCHEMA:
        raise refuse(f"its schema is not {SCHEMA}")
    if provenance["status"] != "complete" or not isinstance(provenance["files"], dict):
        raise refuse("its provenance does not call it complete")
    for name in (CONFIG, PROGRESS, *([POLICY] if POLICY in contents else [])):
        if hashlib.sha256(contents[name]).hexdigest() != provenance["files"].get(name):
            raise refuse(f"{name} does not have the checksum in provenance.json")
    for name in MEASURED:
        value = provenance.get(name)
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        if value is not None and not (number and 0 <= value < math.inf):
            raise refuse(f"{name} in its provenance is not a number of at least 0")
    if not isinstance(provenance.get("cpu"), (str, type(None))):
        raise refuse("cpu in its provenance is not text")
    for name in ("seed", "steps"):
        if type(config[name]) is not int or config[name] < 0:
            raise refuse(f"{name} in config.json is not a whole number of at least 0")
    if not isinstance(config["algorithm"], dict) or not isinstance(
        config["algorithm"].get("name"), str
    ):
        raise refuse("algorithm in config.json has no name")
    try:
        place = record_path(config, provenance["variant"]).parts
    except (KeyError, TypeError, ValueError) as error:
        raise refuse(f"config.json is malformed ({error!r})") from None
    if config_digest(config) != provenance["digest"]:
        raise refuse("config.json does not have the digest in provenance.json")
    if _full(folder).parts[-len(place) :] != place:
        raise refuse(f"it belongs to {Path(*place)}: move it there, or")
    try:
        rows = parse_progress(contents[PROGRESS].decode())
    except ValueError as error:
        raise refuse(f"progress.csv: {error}") from None
    absent = [name for name in REQUIRED_METRICS if all(math.isnan(row.get(name, math.nan))
              for row in rows)]  # fmt: skip
    if absent:
        raise refuse(f"progress.csv has no {absent[0]}")
    if rows[-1]["step"] < config["steps"]:
        raise refuse(f"progress.csv ends at step {rows[-1]['step']} of {config['steps']}")
    return config, provenance, rows


def _full(folder: Path) -> Path:
    """An absolute path without ``..``, symbolic links kept: what a person would call the place."""
    return Path(os.path.abspath(folder))


def _require_place(folder: Path) -> None:
    """Raises RecordError where ``folder`` is not a record's place and hence none of ours."""
    if _PLACE.fullmatch(_full(folder).as_posix()) and (folder.is_dir() or not folder.exists()):
        return
    what = "a record is a folder <results root>/runs/<task>/<variant>/seed<n>-<digest>"
    if not folder.is_dir():
        kind = "a file" if folder.exists() else "no folder"
        raise RecordError(f"record {folder}: it is {kind}; {what}")
    entries = sorted(path.name for path in folder.iterdir())
    found = f"it holds {_some(entries)}" if entries else "it is empty"
    raise RecordError(f"record {folder}: {found}; {what} with {', '.join(REQUIRED_FILES)}")


def _repair(folder: Path) -> str:
    """The command that makes a record anew; removing what is not a record's is never advised."""
    if not folder.exists():
        return "snakemake -j2, which trains it where the configuration asks for it"
    foreign = sorted(path.name for path in folder.iterdir() if not _OWN.fullmatch(path.name))
    if foreign:
        return f"it also holds {_some(foreign)}, which is no part of a record; move that away first"
    quoted = shlex.quote(str(folder))
    return f"rm -r {quoted} && snakemake -j2"


def _some(names: Sequence[str]) -> str:
    """The first of some names, and how many more there are."""
    more = len(names) - 5
    return ", ".join(names[:5]) + (f" and {more} more" if more > 0 else "")


def read_records(
    root: Path, folders: Iterable[Path | str] | None = None
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Verify and read records.

    Args:
        root: The results root.
        folders: Record folders relative to ``root``; all records under it when omitted.

    Returns:
        The index (task, variant, seed, digest, folder, algorithm, steps, and what provenance says
        of time and machine, nan or None where it says nothing), one row a run; and the tidy
        progress table (task, variant, seed, step, metric, value) without NaN values.

    Raises:
        RecordError: on the first record that must not be believed.
    """
    import pandas as pd  # half a second, which training and `snakemake -n` need not wait for

    if folders is None:
        folders = sorted(
            path.parent.relative_to(root) for path in root.glob(f"runs/*/*/*/{CONFIG}")
        )
    index: list[dict[str, Any]] = []
    columns = ["task", "variant", "seed", "step", "metric", "value"]
    tidy: dict[str, list[Any]] = {name: [] for name in columns}
    for folder in map(Path, folders):
        config, provenance, rows = verified(root / folder)
        key = {
            "task": config["task"]["name"],
            "variant": provenance["variant"],
            "seed": config["seed"],
        }
        index.append(
            {
                **key,
                "digest": provenance["digest"],
                "algorithm": config["algorithm"]["name"],
                "steps": config["steps"],
                **{name: provenance.get(name) for name in (*MEASURED, "cpu")},
                "folder": folder.as_posix(),
            }
        )
        logged = [  # in plain lists: a frame a record costs five times as much
            (row["step"], metric, row[metric])
            for metric in rows[0]
            if metric != "step"
            for row in rows
            if not math.isnan(row[metric])
        ]
        for name, values in zip(columns[3:], zip(*logged, strict=True), strict=True):
            tidy[name] += values
        for name, value in key.items():
            tidy[name] += [value] * len(logged)
    runs = pd.DataFrame(index)
    progress = pd.DataFrame(tidy) if index else pd.DataFrame(columns=columns)
    # A column that no record fills would hold None, with which nothing can be computed.
    return runs.astype({name: float for name in MEASURED if name in runs}), progress
