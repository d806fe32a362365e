"""``safemr records``: which records can be believed, and what is unfinished."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

from safemr.experiment import checkpoints, records


def faults(root: Path) -> Iterator[tuple[Path, str | None]]:
    """Every record folder under a results root with its fault, or None where it has none."""
    for folder in sorted(path for path in root.glob("runs/*/*/*") if path.is_dir()):
        try:
            records.verify_record(folder)
        except records.RecordError as error:
            yield folder, str(error)
        else:
            yield folder, None


def unfinished(root: Path) -> Iterator[str]:
    """One line for each run that was begun and has no record yet."""
    for work in sorted(path for path in (root / ".work").glob("*") if path.is_dir()):
        try:
            last = checkpoints.read_attempts(work)[-1]
        except (OSError, IndexError):
            continue
        state = f"failed: {last['reason']}" if "reason" in last else "unfinished"
        yield f"{last['run']} ({work}) {state}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print every fault and every unfinished run; exit status 1 where a record has a fault."""
    parser = argparse.ArgumentParser("safemr records", description=__doc__)
    parser.add_argument("root", nargs="?", type=Path, default=Path("results"))
    root = parser.parse_args(arguments).root
    found = list(faults(root))
    broken = [fault for _, fault in found if fault]
    for fault in broken:
        print(fault)
    for line in unfinished(root):
        print(line)
    print(f"{len(found) - len(broken)} records verified, {len(broken)} refused")
    return 1 if broken else 0
