"""Set up an environment and run this repository in it; needs nothing but Python 3.11 or later.

    python3 make.py all [ARGUMENTS]    snakemake -j2 --keep-going all ARGUMENTS
    python3 make.py test [ARGUMENTS]   the fast tests: pytest -n 2 -m "not slow" ARGUMENTS
    python3 make.py run -- COMMAND     any command inside the environment
    python3 make.py lock               renew requirements.lock from pyproject.toml

The environment is .venv, or the folder that SAFEMR_VENV names. It is built on first use from
requirements.lock, and built again when that file or the Python version changes, or when building
it was interrupted. A folder that was not made here is never touched.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent
LOCK = ROOT / "requirements.lock"
STAMP = "complete"  # written last; holds the key of what the environment was built from
MARK = "made-by-safemr"  # written first: the folder, and what is in it, is ours to build again
HEADER = """\
# Everything that the pipeline and the tests need, with exact versions.
# Renewed by `python3 make.py lock` from pyproject.toml.
"""


def main(arguments: Sequence[str]) -> int:
    command, rest = (arguments[0], list(arguments[1:])) if arguments else ("", [])
    if command == "lock" and not rest:
        return write_lock()
    if command == "all":
        # Of a dry run: what is trained and how many jobs there are. Snakemake's reasons name every
        # file of every record in one line; `snakemake -n all` prints them.
        quiet = ["--quiet", "rules", "host"] if any(map(is_dry, rest)) else []
        return check(rest) or run(
            "python", "-m", "snakemake", "-j2", *quiet, "--keep-going", "all", *rest
        )
    if command == "test":
        return run("python", "-m", "pytest", "-n", "2", "-m", "not slow", *rest)
    if command == "run" and rest and rest != ["--"]:
        return run(*(rest[1:] if rest[0] == "--" else rest))
    print(__doc__, file=sys.stdout if command in ("-h", "--help") else sys.stderr)
    return 0 if command in ("-h", "--help") else 2


def run(*command: str) -> int:
    """Run a command in the environment, from the repository's root; returns its exit status."""
    folder = environment()
    path = os.pathsep.join([str(folder / "bin"), os.environ.get("PATH", os.defpath)])
    variables = {**os.environ, "PATH": path, "VIRTUAL_ENV": str(folder)}
    # One thread a process: the parallelism is over runs and test files.
    variables.setdefault("OMP_NUM_THREADS", "1")
    variables.pop("PYTHONHOME", None)
    program = shutil.which(command[0], path=path)
    if program is None:
        print(f"error: there is no command {command[0]!r}", file=sys.stderr)
        return 127
    try:
        return subprocess.run([program, *command[1:]], cwd=ROOT, env=variables).returncode
    except KeyboardInterrupt:
        return 130


def is_dry(argument: str) -> bool:
    """Whether an argument asks Snakemake for a dry run: -n, -np, --dry-run."""
    return bool(re.fullmatch(r"-[a-zA-Z]*n[a-zA-Z]*|--dry-?run", argument))


def check(arguments: Sequence[str]) -> int:
    """Say in one line what is wrong with a --configfile; Snakemake would show a traceback."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--configfile", "--configfiles", nargs="+", action="extend", default=[])
    files = parser.parse_known_args(arguments)[0].configfile
    return run("python", "-m", "safemr.cli", "config", "config/config.yaml", *files) if files else 0


def environment() -> Path:
    """The folder of the complete environment, built if need be."""
    folder = Path(os.environ.get("SAFEMR_VENV") or ROOT / ".venv").expanduser().absolute()
    key = hashlib.sha256(LOCK.read_bytes() + f"{sys.version} {ROOT}".encode()).hexdigest()
    stamp = folder / STAMP
    with exclusive(folder.with_name(folder.name + ".lock")):
        if stamp.is_file() and stamp.read_text() == key:
            return folder
        clear(folder)
        print(f"Setting up {folder} (some minutes, once)", flush=True)
        create(folder)
        pip(folder, "install", "--quiet", "-r", str(LOCK))
        pip(folder, "install", "--quiet", "--no-deps", "--no-build-isolation", "-e", str(ROOT))
        stamp.write_text(key)
    return folder


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Only one process at a time builds an environment; a dead one holds nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a") as stream:  # "a" leaves alone what somebody else keeps under this name
        fcntl.flock(stream, fcntl.LOCK_EX)
        yield


def clear(folder: Path) -> None:
    """Empty an environment that was made here, or is to be; any other folder is refused."""
    if folder.exists() and not folder.is_dir():
        sys.exit(f"error: {folder} is a file; choose another SAFEMR_VENV")
    folder.mkdir(parents=True, exist_ok=True)
    entries = [path for path in folder.iterdir() if path.name != MARK]
    stamp = folder / STAMP  # alone in what was built before there was a mark
    stamped = stamp.is_file() and re.fullmatch("[0-9a-f]{64}", stamp.read_text(errors="replace"))
    if entries and not stamped and not (folder / MARK).is_file():
        sys.exit(
            f"error: {folder} was not made by this program and is left as it is; choose another "
            "folder by SAFEMR_VENV"
        )
    (folder / MARK).write_text("python3 make.py builds and clears this environment\n")
    for path in entries:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def create(folder: Path) -> None:
    try:
        venv.create(folder, with_pip=True)
    except subprocess.CalledProcessError:
        sys.exit("error: this Python cannot make environments; install its venv and pip packages")


def pip(folder: Path, *arguments: str) -> str:
    command = [str(folder / "bin" / "python"), "-m", "pip", "--disable-pip-version-check"]
    done = subprocess.run([*command, *arguments], stdout=subprocess.PIPE, text=True)
    if done.returncode:
        print(done.stdout, file=sys.stderr)
        sys.exit(f"error: pip {arguments[0]} failed; the next call starts again")
    return done.stdout


def write_lock() -> int:
    """Resolve pyproject.toml in a throw-away environment and write down what was chosen."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [
        *project["project"]["dependencies"],
        *project["project"]["optional-dependencies"]["test"],
        *project["build-system"]["requires"],
    ]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch, "venv")
        create(folder)
        pip(folder, "install", "--quiet", *wanted)
        frozen = pip(folder, "freeze", "--all", "--exclude", "pip")
    # What torch itself pins for one kind of accelerator, and builds local to one machine, would
    # keep the file from working elsewhere.
    names = [
        re.sub(r"\+\S+$", "", line)
        for line in frozen.splitlines()
        if "==" in line and not line.startswith(("nvidia-", "triton==", "cuda-"))
    ]
    LOCK.write_text(HEADER + "\n".join(names) + "\n")
    return 0


if __name__ == "__main__":
    if sys.version_info < (3, 11):  # noqa: UP036 -- the message is for the ones who lack it
        sys.exit("error: Python 3.11 or later is needed")
    sys.exit(main(sys.argv[1:]))
