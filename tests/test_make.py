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
