"""The `safemr` command: every program of the package is reached by it."""

from __future__ import annotations

import ast
import glob
import re
import shlex
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


def test_the_help_has_the_commands_in_their_order() -> None:
    named = re.findall(r"^safemr ([\w-]+) ", cli.__doc__ or "", re.MULTILINE)
    assert named == list(cli.COMMANDS)


def test_the_first_run_of_the_help(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its commands as they stand there, on a smaller budget."""
    monkeypatch.chdir(tmp_path)
    commands = [
        shlex.split(line) for line in re.findall(r"^  safemr (.+)$", cli.__doc__ or "", re.M)
    ]
    assert [command[0] for command in commands] == ["train", "records", "evaluate", "play"]
    less = {
        "train": ["--steps", "1200", "--log-points", "1", "--eval-episodes", "1",
                  *("--set", "hidden=16", "--set", "start_steps=160", "--set", "batch_size=32")],
        "evaluate": ["--episodes", "1"],
        "play": ["--steps", "8"],
    }  # fmt: skip
    for command in commands:
        words = [
            found for word in command
            for found in (sorted(glob.glob(word)) if "*" in word else [word])
        ]  # fmt: skip
        assert cli.main([*words, *less.get(command[0], [])]) == 0
    assert Path("episode.gif").stat().st_size > 0


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
