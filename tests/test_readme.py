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
EQUATIONS = (ROOT / "docs/algorithms.md").read_text()
ROWS = re.findall(r"^\| .+ \| `(safemr[\w.]+)` \| `(tests/[\w.]+)` \|$", EQUATIONS, re.MULTILINE)
PAGES = sorted(path.name for path in (ROOT / "docs").glob("*.md"))
DOCUMENTS = ["README.md", "REPRODUCIBILITY.md", *(f"docs/{page}" for page in PAGES)]
TABLES = ["README.md", "REPRODUCIBILITY.md", "docs/results.md"]


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


def anchors(document: Path) -> set[str]:
    """What can stand behind # in a link to a document: its headings as GitHub names them."""
    text = re.sub(r"^```.*?^```", "", document.read_text(), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_somewhere(document):
    path = ROOT / document
    links = re.findall(r"\]\((?![a-z]+:)([^)#\s]*)(?:#([^)\s]+))?\)", path.read_text())
    for link, anchor in links:
        target = path.parent / link if link else path
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), f"{link}#{anchor}"


def test_the_index_has_every_page_and_what_it_answers():
    listed = re.findall(
        r"^\| \[(.+?)\]\((.+?)\) \| (.+) \|$", (ROOT / "docs/README.md").read_text(), re.M
    )
    assert sorted(name for name, _, _ in listed) == [page for page in PAGES if page != "README.md"]
    for name, link, answers in listed:
        assert link == name
        lines = (ROOT / "docs" / name).read_text().splitlines()
        assert lines[1:4] == ["", f"*Answers: {answers}*", ""], name


def test_the_front_page_is_short():
    assert len(README.splitlines()) <= 150
    (verdicts,) = re.findall(r"<!-- table: (.+verdicts.md) -->", README)
    assert len((ROOT / verdicts).read_text().splitlines()) <= 2 + 2 + 8


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
    assert "SAC-L: {algorithm: sac_lagrangian}" in (ROOT / "docs/your-own.md").read_text()


@pytest.mark.parametrize("document", TABLES)
def test_the_tables_in_a_document_are_those_of_the_pipeline(document):
    text = (ROOT / document).read_text()
    assert "results/tables/" in "".join(re.findall("<!-- table: (.+) -->", text))
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
