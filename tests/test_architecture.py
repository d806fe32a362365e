"""The direction of imports, read from the syntax trees of all sources."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(
    path.relative_to(ROOT)
    for package in ("envs", "safemr")
    for path in (ROOT / package).rglob("*.py")
)
ENVIRONMENT_PACKAGES = {"envs", "gymnasium", "mujoco", "numpy", "numba", "matplotlib"}
# The true dynamics that the reachability solver and the aircraft's tables share with the task, and
# the one decorator of compiled code.
MAY_IMPORT = ("envs.aircraft", "envs.compiled")


def imports(path: Path, *, top_level: bool = False, root: Path = ROOT) -> Iterator[str]:
    """Dotted names that a module imports; with ``top_level`` only those that importing it costs."""
    tree = ast.parse((root / path).read_text())
    nodes = list(ast.walk(tree))
    if top_level:
        nodes = [inner for node in tree.body if not _deferred(node) for inner in ast.walk(node)]
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _deferred(node: ast.stmt) -> bool:
    if isinstance(node, ast.If):
        return ast.unparse(node.test) in ("TYPE_CHECKING", "__name__ == '__main__'")
    return isinstance(node, (ast.FunctionDef, ast.ClassDef))


def reached(start: str) -> set[str]:
    """Top-level imports of a module of this repository, followed through the repository."""
    names, pending = set(), [start]
    while pending:
        name = pending.pop()
        if name in names:
            continue
        names.add(name)
        for suffix in (".py", "/__init__.py"):
            path = Path(name.replace(".", "/") + suffix)
            if (ROOT / path).is_file():
                pending += imports(path, top_level=True)
    return names


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_direction_of_imports(path: Path) -> None:
    names = set(imports(path))
    packages = {name.partition(".")[0] for name in names}
    assert "workflow" not in packages
    assert "snakemake" not in packages
    if path.parts[0] == "envs":
        assert packages <= ENVIRONMENT_PACKAGES | sys.stdlib_module_names
    else:  # environments come by their Gymnasium id; `import envs` only registers them
        inside = {name for name in names if name.startswith("envs.")}
        assert all(name.startswith(MAY_IMPORT) for name in inside)


# A module imports from its own room and from the rooms before it. Loose modules are rooms of one.
ROOMS = (
    *("errors", "files", "names", "conventions", "packages", "paper"),
    *("environments", "foreign_check", "foreign", "tasks"),
    *("certificates", "learning", "filters", "algorithms", "parallel"),
    *("experiment", "measure", "aircraft"),
    "report",
    "cli",
)


def modules_below(root: Path) -> dict[str, set[str]]:
    """Module of the package `safemr` below ``root`` -> the modules of it that it imports."""
    paths = {
        ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted((root / "safemr").rglob("*.py"))
    }
    return {
        name: {found for found in imports(path.relative_to(root), root=root) if found in paths}
        - {name}
        for name, path in paths.items()
    }


def upward(modules: Mapping[str, set[str]]) -> set[tuple[str, str]]:
    """Imports of a room above the importing one; KeyError for a room without a place."""
    place = {room: index for index, room in enumerate(ROOMS)}

    def height(name: str) -> int:
        return place[name.split(".")[1]] if "." in name else len(ROOMS)  # the public face is on top

    return {
        (name, found)
        for name, others in modules.items()
        for found in others
        if "." in found and height(found) > height(name)
    }


def in_circles(modules: Mapping[str, set[str]]) -> set[str]:
    """The modules that import themselves in the end; a package's own face does not count."""
    left = {name: {o for o in others if "." in o} for name, others in modules.items()}
    while free := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in free}
    return set(left)


def test_rooms_import_downwards_and_without_circles() -> None:
    modules = modules_below(ROOT)
    assert len(modules) > 60
    assert upward(modules) == set()
    assert in_circles(modules) == set()


def test_the_page_of_the_architecture_has_the_rooms_in_this_order() -> None:
    page = (ROOT / "docs/architecture.md").read_text()
    cells = re.findall(r"^\| (`.+?) \|", page, re.MULTILINE)
    assert tuple(re.findall(r"`(\w+)`", " ".join(cells))) == ROOMS
    paths = re.findall(r"`((?:safemr|envs|workflow|config|tests)/[\w./]*)`", page)
    assert len(paths) > 20
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_a_planted_violation_is_found(tmp_path: Path) -> None:
    planted = {
        "safemr/learning/loop.py": "def train():\n    from safemr.report import tables\n",
        "safemr/report/tables.py": "from safemr.report.circle import a\n",
        "safemr/report/circle.py": "from safemr.report import tables\n",
    }
    for name, text in planted.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    modules = modules_below(tmp_path)
    assert upward(modules) == {("safemr.learning.loop", "safemr.report.tables")}
    # what leads into a circle cannot be taken apart either
    assert {"safemr.report.tables", "safemr.report.circle"} <= in_circles(modules)
    (tmp_path / "safemr/attic").mkdir()
    (tmp_path / "safemr/attic/box.py").write_text("from safemr.report import tables\n")
    with pytest.raises(KeyError, match="attic"):
        upward(modules_below(tmp_path))


@pytest.mark.parametrize(
    "module",
    [
        *(
            "safemr.experiment.config",
            "safemr.experiment.records",
            "safemr.experiment.planning",
            "safemr.experiment.plan_cache",
            "safemr.cli",
        ),
        *(f"safemr.report.{path.stem}" for path in (ROOT / "safemr/report").glob("[a-z]*.py")),
        *(
            f"safemr.report.figures.{path.stem}"
            for path in (ROOT / "safemr/report/figures").glob("[a-z]*.py")
        ),
    ],
)
def test_reading_and_drawing_need_no_torch(module: str) -> None:
    assert "torch" not in reached(module)


def test_building_the_workflow_needs_neither_torch_nor_a_simulator() -> None:
    names = reached("safemr.experiment.plan_cache")
    assert not names & {"torch", "mujoco", "gymnasium", "numba", "pandas", "matplotlib"}


def test_drawing_a_scene_needs_neither_a_simulator_nor_compiled_code() -> None:
    assert not reached("envs.drawing") & {"mujoco", "numba", "envs.compiled", "matplotlib"}


def test_energy_has_one_home() -> None:
    """Powers of distances minus a multiple of d_dot: phi has one home."""

    def is_phi(node: ast.AST) -> bool:
        if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Sub):
            return False
        has_power = any(isinstance(part, ast.Pow) for part in ast.walk(node.left))
        return has_power and "d_dot" in ast.unparse(node.right)

    trees = {path: ast.parse((ROOT / path).read_text()) for path in SOURCES}
    homes = {str(path) for path, tree in trees.items() if any(map(is_phi, ast.walk(tree)))}
    assert homes == {"safemr/certificates/energy.py"}


def test_constants_have_one_home() -> None:
    """One name with one value in two files is one decision that can be changed in one of them."""
    paths = [*SOURCES, *(p.relative_to(ROOT) for p in (ROOT / "workflow/scripts").glob("*.py"))]
    homes: dict[tuple[str, str], list[str]] = {}
    for path in paths:
        for node in ast.parse((ROOT / path).read_text()).body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            for name in (target.id for target in targets if isinstance(target, ast.Name)):
                if name.isupper() and name not in ("VERSION", "CERTIFICATE", "ROLE"):  # by each
                    homes.setdefault((name, ast.unparse(node.value)), []).append(str(path))
    assert {key: found for key, found in homes.items() if len(found) > 1} == {}


def _names(node: ast.AST) -> set[str]:
    return {inner.id for inner in ast.walk(node) if isinstance(inner, ast.Name)}


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_compiled_code_holds_nothing_from_other_modules(path: Path) -> None:
    """Numba compiles again when the file changes, not when a constant imported into it does."""
    tree = ast.parse((ROOT / path).read_text())
    foreign = {
        alias.asname or alias.name.partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
        if (getattr(node, "module", None) or alias.name).partition(".")[0] in ("envs", "safemr")
    }
    for node in tree.body:  # and what is made of it at the top of the module
        if (
            isinstance(node, ast.Assign | ast.AnnAssign)
            and node.value
            and _names(node.value) & foreign
        ):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            foreign |= {name for target in targets for name in _names(target)}
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any(
            "njit" in ast.unparse(decorator) or "_compiled" in ast.unparse(decorator)
            for decorator in node.decorator_list
        ):
            used = {name for statement in node.body for name in _names(statement)}
            assert not used & foreign, f"{path}: {node.name} keeps a copy of {used & foreign}"


@pytest.mark.parametrize("path", SOURCES, ids=str)
def test_files_stay_readable(path: Path) -> None:
    assert len((ROOT / path).read_text().splitlines()) <= 450
