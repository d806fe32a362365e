"""What is tracked of each configuration is what its records give today.

The default configuration's are drawn by everybody who runs `make.py all`; those of the others
would stay as they are when code that draws them changes.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from safemr.experiment import config, planning, records

ROOT = Path(__file__).resolve().parents[1]
DEFAULT = ROOT / "config/config.yaml"


def git(folder: Path, *arguments: str) -> str:
    done = subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(ROOT.glob("config/*.yaml")), ids=lambda path: path.stem)
def test_a_redraw_changes_nothing_that_is_tracked(path: Path, tmp_path: Path) -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no clone: nothing says what is tracked")
    chosen = config.load([DEFAULT, path])
    runs = planning.resolve(chosen).runs
    recorded = sum(records.is_complete(ROOT / chosen.results_root / run.path) for run in runs)
    if recorded < len(runs) and not (recorded and chosen.allow_missing):
        pytest.skip(f"{recorded} of {len(runs)} runs are recorded: it would train the others")
    folder = tmp_path / "clone"
    git(tmp_path, "clone", "--quiet", "--no-hardlinks", str(ROOT), str(folder))
    command = [sys.executable, "-P", "-m", "snakemake", "-j2", "all", "--configfile", str(path)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert git(folder, "status", "--porcelain", "--untracked-files=no") == ""
