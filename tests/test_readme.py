"""What the README says exists does exist."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from safemr.errors import UserError
from safemr.report import documents

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
ROWS = re.findall(r"^\| .+ \| `(safemr[\w.]+)` \| `(tests/[\w.]+)` \|$", README, re.MULTILINE)


def test_the_table_of_equations_was_found():
    assert len(ROWS) >= 8


@pytest.mark.parametrize(("function", "test"), ROWS)
def test_each_equation_has_its_function_and_its_test(function, test):
    names = function.split(".")
    for split in range(len(names), 0, -1):
        try:
            value = importlib.import_module(".".join(names[:split]))
        except ModuleNotFoundError:
            continue
        for name in names[split:]:
            value = getattr(value, name)
        break
    assert value.__doc__
    assert names[-1] in (ROOT / test).read_text()


@pytest.mark.parametrize("document", ["README.md", "REPRODUCIBILITY.md"])
def test_links_lead_somewhere(document):
    links = re.findall(r"\]\(([^)#:]+)\)", (ROOT / document).read_text())
    missing = [link for link in links if not (ROOT / link).exists()]
    assert links
    assert not missing


def test_the_tests_that_guard_the_runs_exist():
    named = set(re.findall(r"\btest_\w+", (ROOT / "docs/trust.md").read_text()))
    files = list((ROOT / "tests").glob("test_*.py"))
    existing = {path.stem for path in files}
    for path in files:
        existing.update(re.findall(r"^def (test_\w+)", path.read_text(), re.MULTILINE))
    assert len(named) > 30
    assert named <= existing


def test_the_worked_example_is_an_algorithm_of_one_file():
    from safemr.experiment import planning

    assert planning.load_algorithm("sac_lagrangian").family == "off_policy"
    assert "SAC-L: {algorithm: sac_lagrangian}" in README


@pytest.mark.parametrize("document", ["README.md", "REPRODUCIBILITY.md"])
def test_the_tables_in_a_document_are_those_of_the_pipeline(document):
    text = (ROOT / document).read_text()
    assert "<!-- table: results/tables/" in text
    assert documents.with_tables(ROOT / document) == text, "run: safemr documents " + document


def test_a_table_is_put_between_its_marks_and_nowhere_else(tmp_path):
    (tmp_path / "made.md").write_text("| a\\1 |\n")
    document = tmp_path / "document.md"
    document.write_text(
        "before\n<!-- table: made.md -->\nold\n<!-- end of table -->\n\nbetween\n"
        "<!-- table: made.md -->\n<!-- end of table -->\nafter\n"
    )
    assert documents.main(["--check", str(document)]) == 1
    assert "old" in document.read_text()
    assert documents.main([str(document)]) == 0
    block = "<!-- table: made.md -->\n| a\\1 |\n<!-- end of table -->\n"
    assert document.read_text() == f"before\n{block}\nbetween\n{block}after\n"
    assert documents.main(["--check", str(document)]) == 0
    (tmp_path / "made.md").unlink()
    with pytest.raises(UserError, match=r"made\.md cannot be read.*named in"):
        documents.main([str(document)])
