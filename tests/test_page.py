"""The page of results: what is on it, where its links lead, and that it needs nothing else."""

from __future__ import annotations

import re
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import browsers
import pandas as pd
import pytest
from PIL import Image

from safemr import paper
from safemr.errors import UserError
from safemr.report import grounds, page, printed
from safemr.report.tables import Table

ROOT = Path(__file__).resolve().parents[1]
POINTS = {"SafeMR": (0.35, 0.15), "SafeMR[0.45,0.15]": (0.45, 0.15)}
FOLDERS = sorted(
    path.parent.relative_to(ROOT).as_posix() for path in ROOT.glob("results/**/tables")
)


class Read(HTMLParser):
    """Elements with their attributes, ids, and the text of cells, headings and captions."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {"cell": [], "h1": [], "h2": [], "h3": []}
        self._open: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attributes)))
        if name := {"td": "cell", "th": "cell"}.get(tag, tag if tag in self.texts else ""):
            self._open.append(name)
            self.texts[name].append("")

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th", "h1", "h2", "h3"):
            self._open.pop()

    def handle_data(self, data: str) -> None:
        if self._open:
            self.texts[self._open[-1]][-1] += data

    def all(self, attribute: str) -> list[str]:
        return [value for _, found in self.elements if (value := found.get(attribute)) is not None]


def make(
    target: Path,
    tables: Path | None = None,
    figures: Path | None = None,
    runs: pd.DataFrame | None = None,
    captions: Mapping[str, str] | None = None,
    **changes: Any,
) -> Read:
    """The page of some folders, read again."""
    empty = pd.DataFrame(columns=["task", "variant", "seed", "steps", "folder"])
    pictures = sorted(figures.rglob("*")) if figures else []
    page.write(
        target,
        tables=sorted(tables.glob("*.md")) if tables else [],
        pictures={
            path: path.relative_to(figures).with_suffix("").as_posix()
            for path in pictures
            if figures and path.suffix in (".png", ".gif")
        },
        captions=captions or {},
        runs=empty if runs is None else runs,
        **{"expected": 0, "points": POINTS, **changes},
    )
    return Read(target)


def table(folder: Path, name: str, cells: Mapping[str, list[str]], caption: str = "C.") -> None:
    display = pd.DataFrame(cells)
    Table(name, caption, display, display).write(folder)


def picture(path: Path, *, frames: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    shots = [Image.new("RGB", (90, 30), (60 * index, 90, 120)) for index in range(frames)]
    more: dict[str, Any] = {"save_all": True, "append_images": shots[1:]} if frames > 1 else {}
    shots[0].save(path, **more)


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_page_of_each_recorded_configuration(folder: str, tmp_path: Path) -> None:
    root, figures = ROOT / folder, ROOT / folder.replace("results", "paper_figures", 1)
    runs = pd.read_csv(root / "summary/runs.csv")
    # The pictures of this configuration and not of those in folders below.
    mine = tmp_path / "figures"
    mine.mkdir()
    for path in [*figures.glob("*.*"), *figures.glob("trajectories/*")]:
        (mine / path.relative_to(figures)).parent.mkdir(exist_ok=True)
        (mine / path.relative_to(figures)).symlink_to(path)
    made = make(tmp_path / "report.html", root / "tables", mine, runs, expected=len(runs))

    ids = made.all("id")
    assert len(ids) == len(set(ids))
    links = made.all("href")
    assert {link[1:] for link in links if link.startswith("#")} <= set(ids)
    for reference in ("aria-labelledby", "aria-describedby"):
        assert set(made.all(reference)) <= set(ids)
    for path in sorted((root / "tables").glob("*.md")):
        if path.stem in page.ELSEWHERE:
            continue
        rows = printed.read(path).rows
        lacking = {cell for row in rows for cell in row} - set(made.texts["cell"])
        if path.stem == "claims":  # two cells are one there, and reasons are in lines
            everything = " ".join(made.texts["cell"])
            lacking = {part for c in lacking for part in c.split("; ") if part not in everything}
            assert sum(identity.startswith("claim-") for identity in ids) == len(rows)
        assert not lacking, path
        assert path.stem == "claims" or f"table-{path.stem}" in ids
    shown = sum(tag == "img" for tag, _ in made.elements)
    assert shown == len([p for p in mine.rglob("*") if p.suffix in (".png", ".gif")])
    folders = {unquote(link).rstrip("/") for link in links if link.startswith("runs/")}
    assert folders == set(runs["folder"])
    # Nothing is loaded.
    assert all(source.startswith("data:") for source in [*made.all("src"), *made.all("srcset")])
    assert not re.search(r"https?://|url\(|@import", made.path.read_text(encoding="utf-8"))
    tags = {tag for tag, _ in made.elements}
    assert not tags & {"link", "iframe", "object", "embed", "base", "form"}


def test_links_lead_from_the_page_to_files_and_records() -> None:
    """As the rule places it, below the results root."""
    runs = pd.read_csv(ROOT / "results/summary/runs.csv")
    target = ROOT / "results/.report-of-a-test.html"
    try:
        made = make(target, ROOT / "results/tables", ROOT / "paper_figures/trajectories", runs)
    finally:
        target.unlink(missing_ok=True)
    files = [link for link in made.all("href") if not link.startswith("#")]
    assert len(files) > len(runs)
    assert [f for f in files if not (target.parent / unquote(f)).exists()] == []


def test_a_claim_leads_to_its_figure_and_to_the_runs_its_rule_asks_for(tmp_path: Path) -> None:
    found = grounds.grounds(POINTS)
    assert found["unsafe[CPO]"] == tuple((task, "CPO") for task in paper.TASKS)
    assert set(found["sensitivity_return"]) == {
        (paper.SENSITIVITY_TASK, variant) for variant in (*POINTS, "JointSIS")
    }
    assert found["coverage"] == ((paper.AIRCRAFT_TASK, paper.METHOD),)
    assert found["feasibility_paper"] == found["handcrafted_coverage"] == ()

    runs = pd.DataFrame(
        [["Pillars-0.15-Goal", "CPO", seed, 10, f"runs/{seed}"] for seed in (3, 4)],
        columns=["task", "variant", "seed", "steps", "folder"],
    )
    figures = tmp_path / "figures"
    picture(figures / "return_against_cost.png")
    made = make(tmp_path / "report.html", ROOT / "results/tables", figures, runs, expected=3)
    text = made.path.read_text(encoding="utf-8")
    row = text.partition('id="claim-unsafe-CPO"')[2].partition("</tr>")[0]
    assert 'href="#figure-return_against_cost"' in row
    assert 'href="#record-0"' in row
    assert "2 runs" in row
    # Where a figure is not made the claim says its name and has no link.
    row = text.partition('id="claim-zero_violations"')[2].partition("</tr>")[0]
    assert "href" not in row
    assert "2 recorded of 3 configured" in text


def test_what_was_not_made_has_no_heading(tmp_path: Path) -> None:
    table(tmp_path / "tables", "compute", {"algorithm": ["A"], "minutes": ["1.5"]})
    table(tmp_path / "tables", "my_own", {"algorithm": ["A"], "score": ["7"]})
    made = make(tmp_path / "report.html", tmp_path / "tables")
    assert made.texts["h2"] == [
        "What did it cost?", "What else was made?", "Where are the records?"
    ]  # fmt: skip
    assert made.texts["h3"] == ["Time and memory of the runs", "My own"]
    assert {link for link in made.all("href") if link.startswith("#")} == {
        "#main", "#Cost", "#More", "#records"
    }  # fmt: skip


def test_a_table_without_rows_is_shown(tmp_path: Path) -> None:
    """Such as the power of comparisons, where nothing is recorded to compare a method with."""
    table(tmp_path / "tables", "power", {"task": [], "minus": []})
    assert make(tmp_path / "report.html", tmp_path / "tables").texts["cell"][:2] == [
        "task",
        "minus",
    ]


def test_every_table_and_figure_of_the_rules_has_a_place() -> None:
    """What a rule makes and no question names would stand at the end, which is for others' own."""
    text = "".join(path.read_text() for path in (ROOT / "workflow/rules").glob("*.smk"))
    made = set(re.findall(r"(?:\{RESULTS\}/tables|\{FIGURES\})/(\w+)\.(?:md|png|gif)", text))
    made |= {path.stem for path in ROOT.glob("results/**/tables/*.md")}
    made |= {path.stem for path in ROOT.glob("paper_figures/**/*.png")}
    placed = {stem for q in page.QUESTIONS for stems in q.parts.values() for stem in stems}
    tasks = {path.stem for path in ROOT.glob("paper_figures/**/trajectories/*")}
    assert len(made) > 30
    assert made - placed - tasks <= {*page.FRONT, *page.ELSEWHERE}


@pytest.mark.parametrize(
    "name", ["<b>x</b>", '"><img src=x onerror=alert(1)>', "a|b & c", "{{ 7*7 }}"]
)
def test_names_and_cells_are_text(name: str, tmp_path: Path) -> None:
    table(tmp_path / "tables", "results", {"algorithm": [name], name: ["1"]}, caption=name)
    runs = pd.DataFrame(
        [[name, name, 0, 5, f"runs/{name}"]], columns=["task", "variant", "seed", "steps", "folder"]
    )
    made = make(tmp_path / "report.html", tmp_path / "tables", runs=runs, lead=name)
    assert made.texts["cell"].count(name) >= 3
    tags = {tag for tag, _ in made.elements}
    assert not tags & {"b", "img"}
    assert "onerror" not in {key for _, attributes in made.elements for key in attributes}


@pytest.mark.parametrize(
    "caption", ["an *open emphasis", ".. include:: /etc/hosts", ".. raw:: html\n\n   <b>"]
)
def test_a_caption_that_is_no_caption_is_refused_by_name(caption: str, tmp_path: Path) -> None:
    table(tmp_path / "tables", "results", {"algorithm": ["A"]})
    with pytest.raises(UserError, match="caption"):
        make(
            tmp_path / "report.html", tmp_path / "tables",
            captions={str(tmp_path / "tables/results.md"): caption},
        )  # fmt: skip
    assert not (tmp_path / "report.html").exists()


def test_a_caption_that_figures_share_stands_once(tmp_path: Path) -> None:
    figures, tables = tmp_path / "figures", tmp_path / "tables"
    for name in ("a", "b"):
        picture(figures / f"trajectories/{name}.png")
    picture(figures / "certificates.png")
    table(tables, "certificates", {"certificate": ["phi_h"]})
    paths = [*figures.rglob("*.png"), tables / "certificates.md"]
    captions = {str(path): f"Said of ``{path.parts[-2][:3]}``." for path in paths}
    captions[str(tables / "certificates.md")] = captions[str(figures / "certificates.png")]
    made = make(tmp_path / "report.html", tables, figures, captions=captions)
    text = re.sub(r"<[^>]*>", "", made.path.read_text(encoding="utf-8"))
    assert [text.count(f"Said of {word}.") for word in ("tra", "fig")] == [1, 1]


def test_the_page_is_the_same_each_time(tmp_path: Path) -> None:
    picture(tmp_path / "figures/rollout.gif", frames=3)
    table(tmp_path / "tables", "results", {"algorithm": ["A"]})
    made = [
        make(tmp_path / "report.html", tmp_path / "tables", tmp_path / "figures")
        .path.read_bytes() for _ in range(2)
    ]  # fmt: skip
    assert made[0] == made[1]


def test_a_printed_table_is_read_as_it_was_shown(tmp_path: Path) -> None:
    cells = [["a|b", "", "1.0 ± 0.2"], ["**x**", "–", "<i>"]]
    shown = pd.DataFrame(cells, columns=["one", "two [95% interval]", "three"])
    written = Table("t", "Caption.", shown, shown, ["A note.", "Another."])
    written.write(tmp_path)
    content = printed.read(tmp_path / "t.md")
    assert content.head == tuple(shown.columns)
    assert [list(row) for row in content.rows] == cells
    assert (content.caption, content.notes) == ("Caption.", ("A note.", "Another."))
    for text in ("", "# Title\n\ntext\n", "**C.**\n\n| a | b |\n| --- | --- |\n| 1 |\n"):
        (tmp_path / "t.md").write_text(text)
        with pytest.raises(UserError, match=r"t\.md is no table"):
            printed.read(tmp_path / "t.md")


@pytest.mark.parametrize(
    ("cell", "number", "intervals"),
    [
        ("19.53 ± 2.89 [19.68]", 19.53, [" ± 2.89"]),
        ("-0.14 ± 1.14", -0.14, [" ± 1.14"]),
        ("+22.7% [+4.2, +43.6]", 22.7, [" [+4.2, +43.6]"]),
        ("1,234 of 2,000", 1234.0, []),
        ("none of 8079", 0.0, []),
        ("SafeMR[0.45,0.15]", None, []),
        ("[0.201, 0.835, 2.084]", None, []),
        ("–", None, []),
    ],
)
def test_what_a_cell_is_sorted_by_and_where_its_interval_is(
    cell: str, number: float | None, intervals: list[str]
) -> None:
    assert printed.number(cell) == number
    cut = printed.pieces(cell)
    assert "".join(text for _, text in cut) == cell
    assert [text for is_interval, text in cut if is_interval] == intervals


@pytest.mark.slow
@pytest.mark.parametrize("name", browsers.KNOWN)
def test_the_page_in_a_browser(name: str, tmp_path: Path) -> None:
    """Offline, from a file: every category is reached, a table sorts, a film stops, keys work."""
    figures, tables = tmp_path / "figures", tmp_path / "results/tables"
    for stem in ("training_curves", "return_against_cost", "aircraft_frontier"):
        picture(figures / f"{stem}.png")
    picture(figures / "rollout.gif", frames=3)
    cells = {"algorithm": ["B", "A", "C"], "return": ["9 ± 1", "–", "10 ± 2"]}
    cells |= {f"column {index}": ["1"] * 3 for index in range(20)}
    table(tables, "results", cells)
    runs = pd.DataFrame(
        [["T", "A", 0, 5, "runs/0"]], columns=["task", "variant", "seed", "steps", "folder"]
    )
    target = tmp_path / "results/report.html"
    make(target, tables, figures, runs, expected=1)
    with browsers.opened(name, target) as browser:
        # Its own style applies, and nothing was asked of anywhere.
        assert browser("getComputedStyle(document.querySelector('nav')).position") == "sticky"
        loaded = "performance.getEntriesByType('resource').map(entry => entry.name)"
        assert browser(f"{loaded}.every(name => name.startsWith('data:'))")
        assert browser("[...document.images].every(image => image.naturalWidth === 90)")

        for width in (1280, 390):
            browser.resize(width)
            assert browser("document.documentElement.scrollWidth") <= width
            links = int(browser("document.querySelectorAll('nav a').length"))
            assert links == 5
            for index in range(links):
                # In sight, not covered, and what it leads to then stands below the bar.
                assert browser(f"""(() => {{
                    const link = document.querySelectorAll('nav a')[{index}];
                    link.scrollIntoView({{inline: 'center'}});
                    const box = link.getBoundingClientRect();
                    const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
                    const inSight = link.contains(document.elementFromPoint(x, y));
                    link.click();
                    return inSight;
                }})()""")
                top, bar = browser("""(() => {
                    const place = document.getElementById(location.hash.slice(1));
                    const [top, bar] = [place, document.querySelector('nav')].map(
                        element => element.getBoundingClientRect());
                    return `${top.top} ${bar.bottom}`;
                })()""").split()
                assert float(bar) - 2 <= float(top) < 800
        wide = "document.querySelector('#table-results .box')"
        assert browser(f"{wide}.scrollWidth > {wide}.clientWidth && {wide}.tabIndex === 0")

        def column() -> str:
            return browser("[...document.querySelectorAll('#table-results tbody tr')]"
                           ".map(row => row.cells[0].textContent).join('')")  # fmt: skip

        press = "document.querySelectorAll('#table-results th button')[{}].click()"
        orders = []
        for index in (1, 1, 1, 0):
            browser(press.format(index))
            orders.append(column())
        assert orders == ["BCA", "CBA", "BAC", "ABC"]  # a dash stays last
        assert browser("document.querySelector('[aria-sort]').innerText") == "algorithm"
        assert "10 ± 2" in browser("document.querySelector('#table-results').innerText")

        film = "document.querySelector('picture img')"
        assert "image/gif" in browser(f"{film}.currentSrc.slice(0, 20)")
        browser("document.querySelector('button.film').click()")
        assert browser.until(f"{film}.currentSrc.startsWith('data:image/png')")

        browser("history.replaceState(null, '', '#')")
        browser.reload()
        browser.press("Tab")
        assert browser("document.activeElement.className") == "skip"
        assert browser("document.activeElement.getBoundingClientRect().left") >= 0
        assert browser("parseFloat(getComputedStyle(document.activeElement).outlineWidth)") >= 2
        browser.press("Enter")
        assert browser.until("document.activeElement.id === 'main'")
