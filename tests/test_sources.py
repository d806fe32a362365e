"""What a script depends on is found in the sources, all of it and little else."""

from __future__ import annotations

import re
import subprocess
import sys
import textwrap
from importlib import metadata
from pathlib import Path

import pytest

from safemr.experiment import sources

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = sorted((ROOT / "workflow/scripts").glob("*.py"))
RULES = {
    rule.partition(":")[0].removeprefix("rule "): rule
    for path in sorted((ROOT / "workflow/rules").glob("*.smk"))
    for rule in re.split(r"(?m)^(?=rule )", path.read_text())[1:]
}


@pytest.mark.parametrize("name", RULES)
def test_every_rule_with_a_script_knows_its_sources_and_no_other_does(name: str) -> None:
    rule = RULES[name]
    script = re.search(r'(?m)^    script:\n        "\.\./scripts/(\w+)\.py"', rule)
    known = re.findall(r"\bsources\(([^)]*)\)", rule)
    if script is None:
        assert known == [], "a run is identified by its settings, not by sources"
    else:
        assert known == [f'"{script[1]}"']
        assert f'\n        sources=sources("{script[1]}"),\n' in rule.partition("params:")[2]


# Imports what every script imports, one script after the other with fresh modules.
_IMPORT_ALL = """
import ast, importlib, pathlib, sys

root, scripts = pathlib.Path(sys.argv[1]), sys.argv[2:]
sys.path.insert(0, str(root))
for script in scripts:
    for name in [n for n in sys.modules if n.partition(".")[0] in ("envs", "safemr")]:
        del sys.modules[name]
    tree = ast.parse(pathlib.Path(script).read_text())
    tree.body = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    exec(compile(tree, script, "exec"), {})
    if "envs" in sys.modules:
        importlib.import_module("envs.navigation")  # as gymnasium.make would
    files = {getattr(m, "__file__", None) or "" for m in list(sys.modules.values())}
    print(script, *sorted(f for f in files if f.startswith((f"{root}/envs/", f"{root}/safemr/"))))
"""


def test_what_importing_a_script_loads_was_found_without_importing() -> None:
    command = [sys.executable, "-W", "ignore", "-c", _IMPORT_ALL, str(ROOT), *map(str, SCRIPTS)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    lines = [line.split() for line in printed.splitlines()]
    assert [Path(script) for script, *_ in lines] == SCRIPTS
    for script, *loaded in lines:
        assert loaded
        missed = set(map(Path, loaded)) - sources.reached(script).files
        assert not missed, f"{script} uses {missed}"


def test_drawing_and_tables_depend_on_nothing_that_trains() -> None:
    for name in ("curves", "tables", "claims", "final_scores", "weight_map"):
        files = sources.reached(ROOT / f"workflow/scripts/{name}.py").files
        names = {path.relative_to(ROOT).as_posix() for path in files}
        assert not [n for n in names if n.startswith(("envs/", "safemr/algorithms/"))]
        assert not names & {
            "safemr/experiment/train.py",
            "safemr/experiment/planning.py",
            "safemr/learning/off_policy.py",
        }


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_every_package_counts_with_its_version(script: Path) -> None:
    found = sources.reached(script).distributions
    assert "numpy" in found or "pandas" in found
    for name in found:
        assert metadata.version(name)


FILES = {
    "script.py": """
        import safemr.direct
        from safemr import named, something
        from safemr.package import inner
        import yaml
        """,
    "safemr/__init__.py": "",
    "safemr/direct.py": """
        from typing import TYPE_CHECKING
        if TYPE_CHECKING:
            from safemr import for_types
        def late():
            from safemr.late import thing
        if __name__ == "__main__":
            import safemr.program
        """,
    "safemr/named.py": 'ENVIRONMENT = f"envs:{1}-v0"',
    "safemr/late.py": "import numpy.linalg",
    "safemr/package/__init__.py": "from safemr.package import hidden",
    "safemr/package/inner.py": "",
    "safemr/package/hidden.py": "import safemr.direct  # a circle ends",
    "safemr/for_types.py": "",
    "safemr/program.py": "",
    "safemr/unused.py": "",
    "envs/__init__.py": 'ENTRY = "envs.world:World"',
    "envs/world.py": 'from pathlib import Path\nP = Path(__file__).parent / "assets" / "x"',
    "envs/assets/world.xml": "<world/>",
    "envs/other.txt": "",
}
USED = {
    name for name in FILES if not name.endswith(("types.py", "program.py", "unused.py", ".txt"))
}


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    monkeypatch.setattr(sources, "ROOT", tmp_path)
    return tmp_path


def digest(tree: Path) -> str:
    """The digest that the next process would compute."""
    for function in (sources._direct, sources._modules, sources._beside, sources._file_digest):
        function.cache_clear()
    script, kept = tree / "script.py", tree.parent / "kept.json"
    remembered = sources.digests([script], kept)["script"]
    kept.unlink()
    assert sources.digests([script], kept)["script"] == remembered
    return remembered


def test_what_is_remembered_is_not_read_again(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = digest(tree)
    kept = tree.parent / "kept.json"
    monkeypatch.setattr(sources, "reached", None)
    assert sources.digests([tree / "script.py"], kept) == {"script": before}


@pytest.mark.parametrize("damage", ["", "[]", '{"key": 1}', '{"reached": []}'])
def test_a_damaged_memory_is_no_harm(damage: str, tree: Path) -> None:
    before = digest(tree)
    (tree.parent / "kept.json").write_text(damage)
    assert digest(tree) == before


def test_every_way_to_use_a_file_is_followed(tree: Path) -> None:
    digest(tree)
    found = sources.reached(tree / "script.py")
    assert {path.relative_to(tree).as_posix() for path in found.files} == USED
    assert found.distributions == {"numpy", "PyYAML"}


@pytest.mark.parametrize("name", FILES)
def test_an_edit_changes_the_digest_of_what_uses_the_file_only(name: str, tree: Path) -> None:
    before = digest(tree)
    path = tree / name
    path.write_text(path.read_text() + "\n")
    assert (digest(tree) != before) == (name in USED)


def test_another_version_of_a_package_changes_the_digest(
    tree: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = digest(tree)
    monkeypatch.setattr(sources, "_version", lambda name: "2" if name == "PyYAML" else "1")
    assert digest(tree) != before


def test_a_new_module_of_a_used_name_counts(tree: Path) -> None:
    before = digest(tree)
    (tree / "safemr/something.py").write_text("")
    assert digest(tree) != before


def test_a_source_that_is_no_python_stops_nothing_else(tree: Path) -> None:
    """Its rule will fail and say so; training must go on."""
    before = digest(tree)
    (tree / "safemr/late.py").write_text("def broken(:")
    assert digest(tree) != before


def test_the_same_sources_in_another_folder_have_the_same_digest(
    tree: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = digest(tree)
    other = tmp_path_factory.mktemp("clone") / "with space"
    tree.rename(other)
    monkeypatch.setattr(sources, "ROOT", other)
    assert digest(other) == before
