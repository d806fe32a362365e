"""make.py: where the environment lies, and what is wrong is said before Snakemake starts."""

from __future__ import annotations

import importlib.util
import json
import sys
import tempfile
from collections.abc import Callable
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
    assert [command[3] for command in commands] == ["snakemake", "safemr.cli", "snakemake"]
    assert commands[0][-3:] == ("--config", "seeds=[1]", "-n")
    assert commands[1][-1] == "config/smoke.yaml"


@pytest.fixture
def repository(
    make: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], Path]:
    """A function that puts make.py into a new folder, where building is only written down."""
    monkeypatch.undo()
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("SAFEMR_VENV", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def move(name: str) -> Path:
        root = tmp_path / name
        root.mkdir(parents=True)
        (root / "requirements.lock").write_text("numpy\n")
        monkeypatch.setattr(make, "ROOT", root)
        monkeypatch.setattr(make, "LOCK", root / "requirements.lock")
        monkeypatch.setattr(make, "create", lambda folder: None)
        monkeypatch.setattr(make, "pip", lambda *arguments: "")
        return root

    return move


def test_the_environment_lies_in_the_repository(
    make: ModuleType, repository: Callable[[str], Path]
) -> None:
    root = repository("plain/données")
    assert make.environment() == root / ".venv"


@pytest.mark.parametrize("name", ["a b", "it's", 'a"b', "$HOME", "a\\b", "a;b", "~a"])
def test_a_path_that_needs_quotes_has_its_environment_in_the_cache(
    name: str,
    make: ModuleType,
    repository: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    repository(name)
    folder = make.environment()
    assert folder.parent == tmp_path / ".cache/safemr"
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith(f"Setting up {folder} ")
    assert make.environment() == folder
    repository(f"{name}/another")
    assert make.environment() not in (folder, None)


@pytest.mark.parametrize(
    ("name", "variables", "expected"),
    [
        ("a:b", {}, "move it to a path without ':'"),
        ("a", {"SAFEMR_VENV": "/tmp/a b"}, "set SAFEMR_VENV to a folder whose path has no spaces"),
        ("a b", {"HOME": "/dev/null"}, "set SAFEMR_VENV to a folder whose path has no spaces"),
        ("a", {"SAFEMR_VENV": "/dev/null/a/b"}, "/dev/null/a cannot be written to; name another"),
        ("a", {"SAFEMR_VENV": "~nobody-of-that-name/a"}, "SAFEMR_VENV is ~nobody-of-that-name/a"),
    ],
)
def test_what_cannot_be_an_environment_is_one_line(
    name: str,
    variables: dict[str, str],
    expected: str,
    make: ModuleType,
    repository: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    repository(name)
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)
    with pytest.raises(SystemExit) as caught:
        make.environment()
    assert str(caught.value).startswith("error: ")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_complete_environment_is_used_where_nothing_can_be_written(
    make: ModuleType, repository: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    repository("a")
    folder = make.environment()

    def refused(path: Path) -> None:
        raise PermissionError(path)

    monkeypatch.setattr(make, "exclusive", refused)
    assert make.environment() == folder


SHOW = "import json, os; print(json.dumps({n: os.environ.get(n) for n in NAMES}))"


def variables_of(make: ModuleType, capfd: pytest.CaptureFixture[str], *names: str) -> list[str]:
    """What a command of make.py finds in its environment variables."""
    assert make.run("python", "-c", f"NAMES = {names}; {SHOW}") == 0
    return list(json.loads(capfd.readouterr().out).values())


HOMES = ("HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR")


def test_a_home_is_left_alone(
    make: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in HOMES[1:]:
        monkeypatch.delenv(name, raising=False)
    assert variables_of(make, capfd, *HOMES) == [str(tmp_path), None, None]


@pytest.mark.parametrize("place", ["environment", "temporary folder"])
@pytest.mark.parametrize("home", ["missing", "no place for a cache"])
def test_caches_have_a_place_without_a_home(
    home: str,
    place: str,
    make: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    environment = tmp_path / "environment"
    environment.mkdir()
    (environment / "bin").symlink_to(Path(sys.prefix, "bin"))
    monkeypatch.setattr(make, "environment", lambda: environment)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    if place == "temporary folder":  # somebody else's environment: a file is in the way
        (environment / "cache").touch()
    own = tmp_path / "home"
    if home != "missing":
        own.mkdir()
        (own / ".cache").touch()
    monkeypatch.setenv("HOME", str(own))
    for name in HOMES[1:]:
        monkeypatch.delenv(name, raising=False)
    found, caches, drawing = map(Path, variables_of(make, capfd, *HOMES))
    assert found == (caches if home == "missing" else own)
    assert drawing == caches / "matplotlib"
    if place == "environment":
        assert caches == environment / "cache"
    else:
        assert caches.parent == tmp_path
        assert not caches.exists()  # gone with the command


def test_other_packages_do_not_come_before_the_environment(
    make: ModuleType, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/opt/others")
    monkeypatch.setenv("PYTHONHOME", "/opt/others")
    assert variables_of(make, capfd, "PYTHONPATH", "PYTHONHOME") == [str(ROOT), None]


def test_packages_are_installed_into_the_environment_alone(
    make: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Variables for pip that say where to install, and packages that would count as installed."""
    python = tmp_path / "bin/python"
    python.parent.mkdir()
    python.write_text('#!/bin/sh\necho "$@"\nenv\n')
    python.chmod(0o755)
    misleading = {"PIP_TARGET": "/x", "PIP_PREFIX": "/x", "PIP_ROOT": "/x", "PYTHONPATH": "/x"}
    for name, value in {**misleading, "PIP_USER": "1", "PIP_PROXY": "http://proxy:3"}.items():
        monkeypatch.setenv(name, value)
    command, *lines = make.pip(tmp_path, "install", "numpy").splitlines()
    assert command.split()[:3] == ["-I", "-m", "pip"]
    assert "PIP_PROXY=http://proxy:3" in lines
    assert "PIP_USER=0" in lines
    assert not {line.partition("=")[0] for line in lines} & set(misleading)


def test_the_lock_holds_what_the_pipeline_and_the_tests_need_extras_included(
    make: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def pip(folder: Path, *arguments: str) -> str:
        asked.extend(arguments)
        return "numpy==2.0.0+local\ntriton==3.0\n"

    monkeypatch.setattr(make, "create", lambda folder: None)
    monkeypatch.setattr(make, "pip", pip)
    monkeypatch.setattr(make, "LOCK", tmp_path / "requirements.lock")
    assert make.main(["lock"]) == 0
    for package in ("numpy", "snakemake", "pytest", "wandb", "setuptools"):
        assert any(need.startswith(f"{package}>=") for need in asked), package
    assert make.LOCK.read_text() == make.HEADER + "numpy==2.0.0\n"


def test_the_cluster_is_asked_through_the_profile_and_its_pinned_plugins(
    make: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is missing is installed within the locked versions, once; `all` installs nothing."""
    installed: list[tuple[str, ...]] = []
    ran: list[tuple[str, ...]] = []

    def pip(folder: Path, *arguments: str) -> str:
        installed.append(arguments)
        for name, _, version in (pin.partition("==") for pin in arguments if "==" in pin):
            stem = name.replace("-", "_")
            (tmp_path / f"lib/python3/site-packages/{stem}-{version}.dist-info").mkdir(parents=True)
        return ""

    monkeypatch.setattr(make, "environment", lambda: tmp_path)
    monkeypatch.setattr(make, "pip", pip)
    monkeypatch.setattr(make, "run", lambda *command: ran.append(command) or 0)
    for command in ("all", "cluster", "cluster"):
        assert make.main([command, "--default-resources", "slurm_account=me"]) == 0
    ((*options, slurm, jobstep, generic),) = installed
    assert options == ["install", "--quiet", "-c", "requirements.lock"]
    assert [pin.partition("==")[0].rpartition("-")[2] for pin in (slurm, jobstep, generic)] == [
        "slurm",
        "jobstep",
        "generic",
    ]
    local, *clusters = ran
    assert "-j2" in local
    assert "--profile" not in local
    for command in clusters:
        profile = command[command.index("--profile") + 1]
        assert (ROOT / profile / "config.yaml").is_file()
        assert command[-3:] == ("all", "--default-resources", "slurm_account=me")
        assert "-j2" not in command
