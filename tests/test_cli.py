"""The `safemr` command: every program of the package is reached by it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from safemr import cli

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("command", sorted(cli.COMMANDS))
def test_every_command_says_what_it_does(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([command, "--help"])
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: safemr {command} ")


@pytest.mark.parametrize("command", sorted(cli.COMMANDS))
def test_the_help_lists_every_command(command: str) -> None:
    assert f"\nsafemr {command} " in (cli.__doc__ or "")


def test_an_unknown_command_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["golde"])
    assert ended.value.code == 2
    assert "did you mean 'golden'?" in capsys.readouterr().err


def test_there_is_one_way_to_start_a_program() -> None:
    """Beside the command only what the workflow starts with signals in place is a program."""
    programs = {
        path.relative_to(ROOT).as_posix()
        for package in ("envs", "safemr")
        for path in (ROOT / package).rglob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.If) and "__main__" in ast.unparse(node.test)
    }
    assert programs == {"safemr/cli.py", "safemr/experiment/train.py"}
