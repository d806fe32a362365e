"""What a script's result depends on beside its inputs: the sources it uses, as one digest.

Snakemake notices that a script was edited, but not what the script imports. Every rule that draws,
measures or aggregates therefore has a digest of all that (`digests`) among its parameters, so that
an edit in ``safemr/`` or ``envs/`` makes again what depends on it, and nothing else. The training
rule has none: a run is identified by its settings and the versions in them.

Nothing is imported to find out; the syntax trees say what is reached:

- imports, inside functions too, but neither those for type checkers nor those of a module that is
  run as a program;
- Gymnasium's names of environments and entry points, ``"package.module:..."``;
- files and folders that stand beside a module and are named in it (``"assets"``).

Modules named only at run time, which are the algorithms, are not followed: a record, and not the
file that once made it, says what was trained. Other packages count with their installed versions.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import hashlib
import json
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from safemr.files import REPOSITORY as ROOT
from safemr.files import write

PACKAGES = ("envs", "safemr")
# Import name -> distributions, where they differ, and what is drawn with beneath matplotlib.
DISTRIBUTIONS = {
    "PIL": ("pillow",),
    "matplotlib": ("matplotlib", "contourpy", "pillow"),
    "yaml": ("PyYAML",),
}
_ENTRY_POINT = re.compile(r"([A-Za-z_]\w*(?:\.\w+)*):")
_FILE_NAME = re.compile(r"\w[\w.-]*")
_SKIPPED = ("TYPE_CHECKING", "__name__ == '__main__'")


@dataclass(frozen=True)
class Uses:
    """Files of this repository and distributions of others."""

    files: frozenset[Path]
    distributions: frozenset[str]


def digests(scripts: Sequence[Path], kept: Path) -> dict[str, str]:
    """Name of each script -> 16 hexadecimal digits that change when it, or what it reaches, does.

    What scripts reach is remembered in the file ``kept``, for these very sources only, because
    reading all syntax trees takes a second. Raises OSError where a source cannot be read.
    """
    key = _key(scripts)
    try:
        saved = json.loads(kept.read_text())
        found = {} if saved["key"] != key else {
            Path(name): Uses(frozenset(ROOT / file for file in files), frozenset(distributions))
            for name, (files, distributions) in saved["reached"].items()
        }  # fmt: skip
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        found = {}  # absent, damaged or of another version: read the sources again
    if found.keys() != set(scripts):
        found = {script: reached(script) for script in scripts}
        entries = {
            str(script): (sorted(map(_name, uses.files)), sorted(uses.distributions))
            for script, uses in found.items()
        }
        with contextlib.suppress(OSError):  # only slower the next time
            kept.parent.mkdir(parents=True, exist_ok=True)
            text = json.dumps({"key": key, "reached": entries})
            write(kept, text.encode(), durable=False)
    return {script.stem: _digest(uses) for script, uses in found.items()}


def _key(scripts: Sequence[Path]) -> str:
    """Of all files that scripts can reach, by name and content, and of who reads them."""
    within = [ROOT / name for name in PACKAGES] + sorted({script.parent for script in scripts})
    state = hashlib.sha256(f"{sys.version} {scripts}".encode())
    for folder in within:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and "__pycache__" not in path.parts:
                state.update(f"{path}:{_file_digest(path)}\n".encode())
    return state.hexdigest()


def _digest(found: Uses) -> str:
    state = hashlib.sha256()
    for path in sorted(found.files):
        state.update(f"{_name(path)}:{_file_digest(path)}\n".encode())
    for name in sorted(found.distributions):
        state.update(f"{name}=={_version(name)}\n".encode())
    return state.hexdigest()[:16]


def reached(script: Path | str) -> Uses:
    """Everything that a script uses, through any number of modules; the script is included."""
    files: set[Path] = set()
    distributions: set[str] = set()
    pending = [Path(script).resolve()]
    while pending:
        path = pending.pop()
        if path in files:
            continue
        files.add(path)
        if path.suffix == ".py":
            found = _direct(path)
            pending += found.files
            distributions |= found.distributions
    return Uses(frozenset(files), frozenset(distributions))


@functools.cache
def _direct(path: Path) -> Uses:
    """What one source names itself; nothing if it is no Python, which its rule will say."""
    files: set[Path] = set()
    distributions: set[str] = set()
    try:
        tree = ast.parse(path.read_bytes(), str(path))
    except (SyntaxError, ValueError):
        return Uses(frozenset(), frozenset())
    for node in _executed(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            entry_point = _ENTRY_POINT.match(node.value)
            if entry_point:
                files |= _modules(entry_point[1])
            elif len(node.value) < 100 and _FILE_NAME.fullmatch(node.value):
                files |= _beside(path.parent / node.value)
        for name in _imported(node):
            package = name.partition(".")[0]
            if package in PACKAGES:
                files |= _modules(name)
            elif package not in sys.stdlib_module_names:
                distributions.update(DISTRIBUTIONS.get(package, (package,)))
    return Uses(frozenset(files), frozenset(distributions))


def _executed(tree: ast.Module) -> Iterator[ast.AST]:
    """Every node that importing the module or calling its functions can execute."""
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) in _SKIPPED:
            pending += node.orelse
            continue
        yield node
        for value in vars(node).values():  # `ast.iter_child_nodes`, in half the time
            if isinstance(value, list):
                pending += [item for item in value if isinstance(item, ast.AST)]
            elif isinstance(value, ast.AST) and not isinstance(value, ast.expr_context):
                pending.append(value)


def _imported(node: ast.AST) -> Iterator[str]:
    """Dotted names in an import; `from a import b` may name a module a.b or something in a."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield from (f"{node.module}.{alias.name}" for alias in node.names)


@functools.cache
def _modules(name: str) -> frozenset[Path]:
    """The files of a dotted name: of the packages on the way, and the module if it is one."""
    parts = name.split(".")
    if parts[0] not in PACKAGES:
        return frozenset()
    found = []
    for length in range(1, len(parts) + 1):
        place = ROOT.joinpath(*parts[:length])
        found += [place / "__init__.py", place.with_suffix(".py")]
    return frozenset(path for path in found if path.is_file())


@functools.cache
def _beside(path: Path) -> frozenset[Path]:
    """Files that are no Python at or below a path."""
    below = path.rglob("*") if path.is_dir() else [path]
    return frozenset(
        file
        for file in below
        if file.is_file() and file.suffix != ".py" and "__pycache__" not in file.parts
    )


@functools.cache
def _file_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@functools.cache
def _version(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return "none"


def _name(path: Path) -> str:
    """The path as it is in every clone."""
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name
