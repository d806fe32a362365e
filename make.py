"""Set up an environment and run this repository in it; needs nothing but Python 3.11 or later.

    python3 make.py all [ARGUMENTS]      snakemake -j2 --keep-going all ARGUMENTS
    python3 make.py cluster [ARGUMENTS]  the same through Slurm, by workflow/profiles/slurm
    python3 make.py test [ARGUMENTS]     the fast tests: pytest -n 2 -m "not slow" ARGUMENTS
    python3 make.py run -- COMMAND       any command inside the environment
    python3 make.py lock                 renew requirements.lock from pyproject.toml

The environment is .venv, or the folder that SAFEMR_VENV names; where the path of this repository
holds spaces or quotes, a folder in the user's cache (~/.cache/safemr). It is built on first use
from requirements.lock, and built again when that file or the Python version changes, or when
building it was interrupted. A folder that was not made here is never touched.
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
AWAY = "; not in .venv: Snakemake cannot call an interpreter whose path needs quotes"
HEADER = """\
# Everything that the pipeline and the tests need, with exact versions.
# Renewed by `python3 make.py lock` from pyproject.toml.
"""


def main(arguments: Sequence[str]) -> int:
    command, rest = (arguments[0], list(arguments[1:])) if arguments else ("", [])
    if command == "lock" and not rest:
        return write_lock()
    if command in ("all", "cluster"):
        here = ["-j2", "--keep-going"]
        how = here if command == "all" else ["--profile", "workflow/profiles/slurm"]
        # Of a dry run: what is trained and how many jobs there are. Snakemake's reasons name every
        # file of every record in one line; `snakemake -n all` prints them.
        quiet = ["--quiet", "rules", "host"] if any(map(is_dry, rest)) else []
        snakemake = ("python", "-P", "-m", "snakemake", *how, *quiet, "all", *rest)
        return check(rest) or (command == "cluster" and add("cluster")) or run(*snakemake)
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
    # What PYTHONPATH names would stand before the packages of the environment.
    ours = {"PATH": path, "VIRTUAL_ENV": str(folder), "PYTHONPATH": str(ROOT), "PYTHONUTF8": "1"}
    variables = {**os.environ, **ours}
    # One thread a process: the parallelism is over runs and test files.
    variables.setdefault("OMP_NUM_THREADS", "1")
    variables.pop("PYTHONHOME", None)
    program = shutil.which(command[0], path=path)
    if program is None:
        print(f"error: there is no command {command[0]!r}", file=sys.stderr)
        return 127
    with home_for(folder) as homes:
        variables.update(homes)
        try:
            return subprocess.run([program, *command[1:]], cwd=ROOT, env=variables).returncode
        except KeyboardInterrupt:
            return 130


def add(extra: str) -> int:
    """Install an extra of pyproject.toml whose versions are pinned, unless it is there already."""
    folder = environment()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pins = project["optional-dependencies"][extra]
    if not all(is_installed(folder, pin) for pin in pins):
        print(f"Adding {', '.join(pins)} to {folder}", flush=True)
        with exclusive(folder.with_name(folder.name + ".lock")):
            pip(folder, "install", "--quiet", "-c", LOCK.name, *pins)
    return 0


def is_installed(folder: Path, pin: str) -> bool:
    """Whether an environment holds a package in the version that ``name==version`` asks for."""
    name = pin.replace("-", "_").replace("==", "-")
    return any(folder.glob(f"lib/*/site-packages/{name}.dist-info"))


def is_dry(argument: str) -> bool:
    """Whether an argument asks Snakemake for a dry run: -n, -np, --dry-run."""
    return bool(re.fullmatch(r"-[a-zA-Z]*n[a-zA-Z]*|--dry-?run", argument))


def check(arguments: Sequence[str]) -> int:
    """Say in one line what is wrong with a --configfile; Snakemake would show a traceback."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--configfile", "--configfiles", nargs="+", action="extend", default=[])
    files = parser.parse_known_args(arguments)[0].configfile
    command = ("safemr.cli", "config", "config/config.yaml", *files)
    return run("python", "-P", "-m", *command) if files else 0


def environment() -> Path:
    """The folder of the complete environment, built if need be."""
    folder = place()
    key = hashlib.sha256(LOCK.read_bytes() + os.fsencode(f"{sys.version} {ROOT}")).hexdigest()
    stamp = folder / STAMP
    if stamp.is_file() and stamp.read_text() == key:  # perhaps where nothing can be written
        return folder
    with exclusive(folder.with_name(folder.name + ".lock")):
        if stamp.is_file() and stamp.read_text() == key:
            return folder
        clear(folder)
        away = "" if folder.is_relative_to(ROOT) or os.environ.get("SAFEMR_VENV") else AWAY
        print(f"Setting up {folder} (some minutes, once{away})", flush=True)
        create(folder)
        pip(folder, "install", "--quiet", "-r", LOCK.name)
        pip(folder, "install", "--quiet", "--no-deps", "--no-build-isolation", "-e", ".")
        stamp.write_text(key)
    return folder


def place() -> Path:
    """The folder for the environment: one whose path Snakemake and PATH can hold.

    Snakemake calls the interpreter without quotes, and PATH and PYTHONPATH are split at colons.
    """
    if os.pathsep in str(ROOT):
        sys.exit(f"error: PYTHONPATH cannot hold {ROOT}: move it to a path without {os.pathsep!r}")
    named = os.environ.get("SAFEMR_VENV")
    try:
        folder = Path(named or ROOT / ".venv").expanduser().absolute()
    except RuntimeError as error:
        sys.exit(f"error: SAFEMR_VENV is {named}: {error}")
    if is_plain(folder):
        return folder
    caches = cache_folder()
    elsewhere = caches and caches / "safemr" / hashlib.sha256(os.fsencode(ROOT)).hexdigest()[:16]
    if not named and elsewhere and is_plain(elsewhere):
        return elsewhere
    sys.exit(
        f"error: Snakemake cannot call an interpreter in {folder}: set SAFEMR_VENV to a folder "
        "whose path has no spaces, quotes or other special characters"
    )


def is_plain(path: Path) -> bool:
    """Whether a path means the same to a shell without quotes."""
    return not re.search(r"[^\w@%+=,./-]", str(path))


def cache_folder() -> Path | None:
    """The user's folder for caches, where there is one that can be written to."""
    home = os.path.expanduser("~")  # "~" itself for a user without a home
    named = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(named) and not os.path.isdir(home):
        return None
    folder = Path(named if os.path.isabs(named) else os.path.join(home, ".cache"))
    return folder if folder.is_absolute() and is_writable(folder) else None


def is_writable(folder: Path) -> bool:
    """Whether the folder exists, or can be made, and a file can be made in it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


@contextlib.contextmanager
def home_for(folder: Path) -> Iterator[dict[str, str]]:
    """Variables for programs that need a home and a place for caches, where the user has none."""
    home = os.path.expanduser("~")
    homeless = not (os.path.isabs(home) and os.path.isdir(home))
    if cache_folder() and not homeless:
        yield {}
        return
    with contextlib.ExitStack() as stack:
        own = folder / "cache"
        if not is_writable(own):  # an environment that somebody else made
            own = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="safemr-")))
        variables = {"HOME": str(own)} if homeless else {}
        if not cache_folder():
            variables["XDG_CACHE_HOME"] = str(own)
            variables["MPLCONFIGDIR"] = str(own / "matplotlib")
        yield variables


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Only one process at a time builds an environment; a dead one holds nothing."""
    if not is_writable(path.parent):
        sys.exit(f"error: {path.parent} cannot be written to; name another folder by SAFEMR_VENV")
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
    # Isolated: what PYTHONPATH names would count as installed. Nothing may go to another folder.
    command = [str(folder / "bin" / "python"), "-I", "-m", "pip", "--disable-pip-version-check"]
    elsewhere = {f"PIP_{name}" for name in ("TARGET", "PREFIX", "ROOT", "DRY_RUN")} | {"PYTHONPATH"}
    variables = {name: value for name, value in os.environ.items() if name not in elsewhere}
    done = subprocess.run(
        [*command, *arguments],
        cwd=ROOT,
        env={**variables, "PIP_USER": "0"},
        stdout=subprocess.PIPE,
        text=True,
    )
    if done.returncode:
        print(done.stdout, file=sys.stderr)
        sys.exit(f"error: pip {arguments[0]} failed; the next call starts again")
    return done.stdout


def write_lock() -> int:
    """Resolve pyproject.toml in a throw-away environment and write down what was chosen."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras = project["project"]["optional-dependencies"]
    wanted = [
        *project["project"]["dependencies"],
        *extras["pipeline"],
        *extras["test"],
        *extras["wandb"],  # a setting of the configuration
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
