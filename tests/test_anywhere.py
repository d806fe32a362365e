"""Anywhere a person may run it: no home, nothing to write to, OpenGL missing, names taken.

Folders that cannot be written to are files here, which stops the superuser, too.
"""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Keeps os.path.expanduser from finding a home, as for a user number without an account.
NO_ACCOUNT = """
import pwd
def getpwuid(uid):
    raise KeyError(uid)
pwd.getpwuid = getpwuid
"""
COMPILE = """
import numba
from envs import compiled
from envs.navigation_kernels import write_controls
print(numba.config.CACHE_DIR or "no cache")
"""


def python(
    *arguments: str, cwd: Path, options: tuple[str, ...] = (), **variables: str | None
) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder; a variable that is None is taken out of the environment."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", **variables}
    return subprocess.run(
        [sys.executable, *options, *arguments],
        cwd=cwd,
        env={name: value for name, value in environment.items() if value is not None},
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder that holds `envs` without a place for compiled code, and a `tmp` beside it."""
    site = tmp_path / "site"
    shutil.copytree(ROOT / "envs", site / "envs", ignore=shutil.ignore_patterns("__pycache__"))
    (site / "envs/__pycache__").touch()
    (tmp_path / "tmp").mkdir()
    return site


@pytest.mark.parametrize("home", ["/dev/null", None])
def test_compiled_code_is_kept_where_there_is_no_home(
    home: str | None, installed: Path, tmp_path: Path
) -> None:
    done = python(
        "-c", NO_ACCOUNT + COMPILE, cwd=tmp_path,
        PYTHONPATH=str(installed), HOME=home, TMPDIR=str(tmp_path / "tmp"),
        NUMBA_CACHE_DIR=None, XDG_CACHE_HOME=None,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    own = Path(done.stdout.strip())
    assert own.parent == tmp_path / "tmp"
    assert stat.S_IMODE(own.stat().st_mode) == 0o700
    assert not (tmp_path / "~").exists()


@pytest.mark.parametrize("planted", ["open to all", "a link"])
def test_compiled_code_is_not_taken_from_others(
    planted: str, installed: Path, tmp_path: Path
) -> None:
    own = tmp_path / f"tmp/numba-{os.geteuid()}"
    if planted == "a link":
        own.symlink_to(tmp_path / "site")
    else:
        own.mkdir()
        own.chmod(0o777)
    done = python(
        "-c", COMPILE, cwd=tmp_path,
        PYTHONPATH=str(installed), HOME="/dev/null", TMPDIR=str(tmp_path / "tmp"),
        NUMBA_CACHE_DIR="/dev/null/none", XDG_CACHE_HOME=None,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "/dev/null/none"  # Numba goes without
    assert not list(own.glob("envs_*"))


@pytest.mark.parametrize("value", ["egl", "osmesa", "nonsense", "disabled"])
def test_a_step_needs_no_opengl(value: str, tmp_path: Path) -> None:
    code = (
        "import os, gymnasium, envs\n"
        "env = gymnasium.make('Pillars-0.15-Goal-v0')\n"
        "env.reset(seed=0)\n"
        "print(env.step(env.action_space.sample())[1], os.environ['MUJOCO_GL'])"
    )
    done = python("-c", code, cwd=tmp_path, MUJOCO_GL=value, PYOPENGL_PLATFORM=None)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[1] == value  # a child process sees what this one saw


@pytest.mark.parametrize("value", ["nonsense", "disabled"])
def test_a_frame_that_cannot_be_drawn_names_the_variable(value: str, tmp_path: Path) -> None:
    code = (
        "import gymnasium, envs\n"
        "env = gymnasium.make('Pillars-0.15-Goal-v0', render_mode='rgb_array')\n"
        "env.reset(seed=0)\n"
        "env.render()"
    )
    done = python("-c", code, cwd=tmp_path, MUJOCO_GL=value)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(
        f"RuntimeError: cannot render with MUJOCO_GL={value}: "
    )


TRAIN = ("safemr.experiment.train", "--task", "Pillars-0.15-Goal", "--algorithm", "safemr")
CERTIFY = ("safemr.cli", "certify", "--sigma", "0.2", "--k", "1", "--n", "2",
           "--task", "Pillars-0.15-Goal")  # fmt: skip


@pytest.mark.parametrize(
    ("name", "command"),
    [("envs.py", TRAIN), ("envs/__init__.py", TRAIN), ("envs/__init__.py", CERTIFY)],
)
def test_another_package_of_that_name_is_told(
    name: str, command: tuple[str, ...], tmp_path: Path
) -> None:
    other = tmp_path / name
    other.parent.mkdir(exist_ok=True)
    other.write_text("raise ImportError('not that one')\n")
    done = python("-m", *command, cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: Python found another package envs, {other}, before ")
    assert "python -P" in line


def test_the_tasks_are_found_beside_another_package(tmp_path: Path) -> None:
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs/__init__.py").touch()
    code = "from safemr.experiment import planning; print(len(planning.task_names()))"
    (tmp_path / "program.py").write_text(code)
    done = python("program.py", cwd=tmp_path, options=("-P",))
    assert done.stdout.strip() == "6", done.stderr


def test_the_revision_is_known_in_a_clone_of_another_owner(tmp_path: Path) -> None:
    clone = tmp_path / "clone"
    (clone / "safemr/experiment").mkdir(parents=True)
    own = ("__init__", "errors", "files", "experiment/__init__", "experiment/provenance")
    for name in own:
        shutil.copy(ROOT / f"safemr/{name}.py", clone / f"safemr/{name}.py")
    identity = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    for arguments in (("init", "-q"), ("add", "."), (*identity, "commit", "-qm", "one")):
        subprocess.run(["git", *arguments], cwd=clone, check=True)
    code = "from safemr.experiment.provenance import source_revision; print(source_revision())"
    done = python("-c", code, cwd=clone, PYTHONPATH=str(clone), GIT_TEST_ASSUME_DIFFERENT_OWNER="1")
    head = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=clone, check=True, capture_output=True, text=True
    )
    assert done.stdout.strip() == str({"commit": head.stdout.strip(), "dirty": False})


def test_letters_that_a_terminal_lacks_stop_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "données"
    folder.mkdir()
    code = (
        "from safemr.errors import reported_errors\nwith reported_errors():\n    print('données')"
    )
    done = python("-c", code, cwd=folder, PYTHONIOENCODING="ascii")
    assert (done.returncode, done.stdout.strip()) == (0, "donn\\xe9es")
