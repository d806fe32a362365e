"""make.py: what is wrong with a configuration file is said before Snakemake starts."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """make.py with the interpreter of these tests in place of an environment of its own."""
    spec = importlib.util.spec_from_file_location("make", ROOT / "make.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "environment", lambda: Path(sys.prefix))
    return module


@pytest.mark.parametrize("option", ["--configfile", "--configfiles"])
@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (None, "cannot read the config file {path}: No such file or directory"),
        ("folder", "cannot read the config file {path}: Is a directory"),
        (b"seeds: [1, 2\n", "{path}, line 2: expected ',' or ']'"),
        (b"\xff\xfe\x00", "{path}"),
        (b"- seeds\n", "{path} must hold a mapping"),
        (b"sedes: [1]\n", "unknown key 'sedes' in the config; did you mean 'seeds'?"),
    ],
)
def test_a_bad_configfile_is_one_line_before_snakemake(
    option: str,
    content: str | bytes | None,
    expected: str,
    make: ModuleType,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "bad.yaml"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        path.mkdir()
    assert make.main(["all", "-n", option, "config/smoke.yaml", str(path)]) == 2
    printed = capfd.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert line.startswith("error: ")
    assert expected.format(path=path) in line


@pytest.fixture
def building(make: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """make.py whose environments are made in a moment, without pip."""
    spec = importlib.util.spec_from_file_location("make", ROOT / "make.py")
    assert spec is not None
    assert spec.loader is not None
    spec.loader.exec_module(make)  # `environment` as it is
    monkeypatch.setattr(make, "create", lambda folder: (folder / "pyvenv.cfg").write_text("new"))
    monkeypatch.setattr(make, "pip", lambda *arguments: "")
    return make


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("holds", [["pyvenv.cfg", "bin"], ["thesis.tex"], ["complete"]])
def test_a_folder_that_was_not_made_here_is_never_cleared(
    holds: list[str], building: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SAFEMR_VENV may name an environment that somebody works in."""
    own = tmp_path / "own"
    own.mkdir()
    for name in holds:
        (own / name).write_text("mine")
    (tmp_path / "own.lock").write_text("poetry's")
    monkeypatch.setenv("SAFEMR_VENV", str(own))
    with pytest.raises(SystemExit, match="was not made by this program and is left as it is"):
        building.environment()
    assert names(own) == set(holds)
    assert all((own / name).read_text() == "mine" for name in holds)
    assert (tmp_path / "own.lock").read_text() == "poetry's"


def test_a_file_in_the_environments_place_is_one_line(
    building: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own").write_text("mine")
    monkeypatch.setenv("SAFEMR_VENV", str(tmp_path / "own"))
    with pytest.raises(SystemExit, match="is a file"):
        building.environment()


@pytest.mark.parametrize("state", ["absent", "empty", "interrupted", "outdated", "older"])
def test_what_was_made_here_is_built_again(
    state: str, building: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, elsewhere = tmp_path / "made", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "kept").write_text("")
    monkeypatch.setenv("SAFEMR_VENV", str(folder))
    if state == "empty":
        folder.mkdir()
    elif state != "absent":
        building.environment()
        (folder / "lib").mkdir()
        (folder / "lib" / "old.py").write_text("")
        (folder / "lib64").symlink_to(elsewhere)
    if state == "interrupted":
        (folder / building.STAMP).unlink()
    elif state in ("outdated", "older"):
        (folder / building.STAMP).write_text("0" * 64)
    if state == "older":  # made before there was a mark
        (folder / building.MARK).unlink()
    assert building.environment() == folder
    assert names(folder) == {building.MARK, building.STAMP, "pyvenv.cfg"}
    assert names(elsewhere) == {"kept"}, "a link is removed, not what it points to"
    before = (folder / building.STAMP).stat().st_mtime_ns
    assert building.environment() == folder
    assert (folder / building.STAMP).stat().st_mtime_ns == before, "complete: nothing to do"


def test_everything_else_is_left_to_snakemake(
    make: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands = []
    monkeypatch.setattr(make, "run", lambda *command: commands.append(command) or 0)
    assert make.main(["all", "--config", "seeds=[1]", "-n"]) == 0
    assert make.main(["all", "--configfile=config/smoke.yaml"]) == 0
    assert [command[2] for command in commands] == ["snakemake", "safemr.cli", "snakemake"]
    assert commands[0][-3:] == ("--config", "seeds=[1]", "-n")
    assert commands[1][-1] == "config/smoke.yaml"
