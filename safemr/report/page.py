"""The page of results: one HTML file with every table and picture of a configuration, by question.

It needs no server and loads nothing: pictures, style and script are in it, and its content policy
forbids everything else. Table I and the claims stand in front; a claim leads to its figure and to
the runs that its rule asks for. What a configuration has not made is left out with its heading, and
what no question names stands at the end, so that a new table or figure needs no edit here. Captions
are handed in as reStructuredText; table cells and names are text and escaped as such.
"""

from __future__ import annotations

import base64
import hashlib
import io
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
from docutils.core import publish_parts
from docutils.utils import SystemMessage
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from safemr import files
from safemr.errors import UserError
from safemr.report import printed
from safemr.report.claims import OURS
from safemr.report.grounds import Pair, grounds
from safemr.report.tables import ABSENT

ASSETS = Path(__file__).with_name("assets")
FRONT = ("finding", "table1", "claims")  # placed by the template
ELSEWHERE = ("verdicts",)  # the claims once more, for README


@dataclass(frozen=True)
class Question:
    """A section: heading, name in the navigation, and heading -> stems of what stands there."""

    title: str
    label: str
    parts: Mapping[str, tuple[str, ...]]


QUESTIONS = (
    Question("Is it efficient and safe?", "Efficient and safe", {
        "Final return against violations": ("return_against_cost",),
        "On layouts that no run was evaluated on": ("unseen_layouts",),
        "The same, every two algorithms": ("unseen_differences",),
        "By what is taken for final performance": ("windows",),
        "What this many seeds can see": ("power", "power_of_safety"),
        "Every algorithm on every task": ("results",),
        "Every two algorithms": ("differences",),
        "All tasks together": ("aggregate_scores", "aggregate_safe_scores"),
        "Behind the safety filter of a certificate": ("filters",),
        "What a return on Push is made of": ("push_split",),
    }),
    Question("Does it train?", "Training", {
        "Return and cost during training": ("training_curves",),
        "Violations while training": ("training_violations",),
        "The learned parameters": ("parameters",),
        "What moved the parameters": ("certificate_paths",),
    }),
    Question("How does it drive?", "Driving", {
        "Two policies side by side": ("side_by_side",),
        "An episode": ("rollout",),
        "The same layouts, driven by each": ("trajectories",),
        "The tasks": ("environments",),
    }),
    Question("Is the certificate small and feasible?", "Certificate", {
        "The check of the certificates": ("certificates",),
        "How small it may be": (
            "return_against_size",
            "return_at_equal_size",
            "regularizer",
            "sizes",
        ),
        "The multiplier and the learned safe set": ("multiplier_maps",),
        "The energy function": ("energy_and_safe_set",),
        "A narrow passage": ("narrow_passage",),
    }),
    Question("Which weights [a, b]?", "Weights [a, b]", {
        "The paper's weights": ("sensitivity", "table2"),
        "A map of weights": ("weight_map",),
    }),
    Question("How near to the truth is it on the aircraft?", "Aircraft", {
        "Unsafe sets against the true one": (
            "aircraft_frontier", "aircraft_slices", "aircraft_airplane", "aircraft",
        ),
        "Neural energy functions": ("aircraft_neural",),
    }),
    Question("What did it cost?", "Cost", {
        "Return for processor time": ("compute_curves",),
        "Time and memory of the runs": ("compute",),
        "One process and several": ("parallel",),
    }),
)  # fmt: skip
REST = ("What else was made?", "More")


@dataclass(frozen=True)
class Picture:
    """A picture to embed. name: its path below the figures' root without the ending."""

    path: Path
    name: str
    caption: str  # reStructuredText, or nothing

    @property
    def stem(self) -> str:
        return self.name.partition("/")[0]

    @property
    def title(self) -> str:
        """In words, for who does not see it: "Trajectories: Pillars-0.15-Goal"."""
        first, _, rest = self.name.partition("/")
        return humanised(first) + (f": {rest}" if rest else "")

    @property
    def source(self) -> str:
        return _embedded(self.path.read_bytes(), self.path.suffix[1:])

    @property
    def moves(self) -> bool:
        return self.path.suffix == ".gif"

    @cached_property
    def still(self) -> str:
        """The first frame of a film, for who wants nothing to move."""
        frame = io.BytesIO()
        with Image.open(self.path) as film:
            film.convert("RGB").save(frame, "PNG")
        return _embedded(frame.getvalue(), "png")

    @cached_property
    def size(self) -> tuple[int, int]:
        with Image.open(self.path) as image:
            return image.size


@dataclass(frozen=True)
class Panel:
    """A table to show: what is printed, what its cells are sorted by, what it comes as."""

    path: Path
    caption: str
    content: printed.Printed

    @property
    def stem(self) -> str:
        return self.path.stem

    @property
    def is_sortable(self) -> bool:
        """Not where each row is another quantity: Table I."""
        return self.stem != "table1"

    @cached_property
    def numeric(self) -> tuple[bool, ...]:
        """[columns] whether most cells that say something begin with a number."""
        # Not `zip`, which finds no columns where there are no rows.
        columns = [[row[i] for row in self.content.rows] for i in range(len(self.content.head))]
        said = [[cell for cell in column if cell not in ("", ABSENT)] for column in columns]
        return tuple(
            2 * sum(printed.number(cell) is not None for cell in cells) > len(cells)
            for cells in said
        )


class Run(NamedTuple):
    """A record: its folder is below the results root."""

    seed: int
    steps: int
    folder: str


COLUMNS = ("task", "variant", *Run._fields)  # of summary/runs.csv
Groups = dict[Pair, list[Run]]


@dataclass(frozen=True)
class Part:
    """A heading with its figures, each a caption and the pictures that share it, and its tables."""

    title: str
    figures: Sequence[tuple[str, Sequence[Picture]]]
    tables: Sequence[Panel]


def write(
    target: Path,
    *,
    tables: Iterable[Path],
    pictures: Mapping[Path, str],
    captions: Mapping[str, str],
    runs: pd.DataFrame,
    expected: int,
    points: Mapping[str, tuple[float, float]],
    lead: str = "",
) -> None:
    """Write the page of a results root to ``target``, from which its links to files are relative.

    tables: Markdown files of `Table.write`, with claims.csv beside claims.md. pictures: PNG and GIF
    files with their names below the figures' root, without ending. captions: path of either as text
    -> reStructuredText. runs: summary/runs.csv, a row a record. expected: how many runs the
    configuration asks for. points: variant -> [a, b] of the claims about them. lead:
    reStructuredText for the front.

    Raises:
        UserError: a table is none, a picture cannot be read, or a caption is no
            reStructuredText; each with its name.
    """
    panels = {
        path.stem: Panel(path, captions.get(str(path), ""), printed.read(path))
        for path in tables
        if path.stem not in ELSEWHERE
    }
    shown = [Picture(path, name, captions.get(str(path), "")) for path, name in pictures.items()]
    groups = _records(runs)
    texts = {path.name: path.read_text(encoding="utf-8") for path in sorted(ASSETS.iterdir())}
    environment = Environment(
        loader=FileSystemLoader(ASSETS), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters.update(
        anchor=anchor, key=printed.number, pieces=printed.pieces, rst=_html,
        link=lambda path: quote(os.path.relpath(path, target.parent)),
    )  # fmt: skip
    try:
        content = environment.get_template("page.html").render(
            name=target.parent.name,
            lead=lead,
            finding=[picture for picture in shown if picture.stem == "finding"],
            table1=panels.get("table1"),
            claims=_claims(panels.get("claims"), {p.name for p in shown}, groups, points),
            claims_table=panels.get("claims"),
            ours=OURS,
            sections=_sections(panels, shown),
            groups=groups,
            folder=target.parent,
            recorded=len(runs),
            expected=expected,
            style=Markup(texts["page.css"]),
            script=Markup(texts["page.js"]),
            policy=_policy(texts["page.css"], texts["page.js"]),
        )
    except OSError as error:
        raise UserError(f"a picture of the page cannot be read: {error}") from error
    files.write(target, content.encode(), durable=False)


def humanised(name: str) -> str:
    """ "return_against_cost" as a heading."""
    words = name.replace("_", " ")
    return words[:1].upper() + words[1:]


def anchor(name: str) -> str:
    """A name as part of an anchor: others may write anything into labels."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-")


def _sections(
    panels: Mapping[str, Panel], pictures: Sequence[Picture]
) -> list[tuple[str, str, list[Part]]]:
    """Title, label and parts of every question that has something to show."""
    placed = {*FRONT, *(stem for q in QUESTIONS for stems in q.parts.values() for stem in stems)}
    stems = [*(picture.stem for picture in pictures), *panels]
    rest = {humanised(stem): (stem,) for stem in stems if stem not in placed}
    sections = []
    for question in (*QUESTIONS, Question(*REST, rest)):
        parts = [_part(title, names, panels, pictures) for title, names in question.parts.items()]
        if parts := [part for part in parts if part.figures or part.tables]:
            sections.append((question.title, question.label, parts))
    return sections


def _part(
    title: str, stems: Sequence[str], panels: Mapping[str, Panel], pictures: Sequence[Picture]
) -> Part:
    """One caption is said once, whether pictures share it or a picture and its table."""
    figures: list[tuple[str, list[Picture]]] = []
    for picture in (p for stem in stems for p in pictures if p.stem == stem):
        if not figures or figures[-1][0] != picture.caption:
            figures.append((picture.caption, []))
        figures[-1][1].append(picture)
    said = {caption for caption, _ in figures}
    tables = [panels[stem] for stem in stems if stem in panels]
    return Part(
        title,
        figures,
        [Panel(t.path, "" if t.caption in said else t.caption, t.content) for t in tables],
    )


def _records(runs: pd.DataFrame) -> Groups:
    """Those of each (task, variant), in their order."""
    groups: Groups = {}
    for task, variant, seed, steps, folder in runs[list(COLUMNS)].itertuples(index=False):
        groups.setdefault((task, variant), []).append(Run(seed, steps, folder))
    return groups


def _claims(
    table: Panel | None,
    figures: set[str],
    groups: Groups,
    points: Mapping[str, tuple[float, float]],
) -> list[dict[str, Any]]:
    """A row a claim, with its figure if the page has it, and the recorded runs that it rests on."""
    if table is None:
        return []
    data = pd.read_csv(table.path.with_suffix(".csv"))
    rests = grounds(points)
    place = {pair: (index, len(runs)) for index, (pair, runs) in enumerate(groups.items())}
    return [
        {
            "name": name,
            "cells": dict(zip(table.content.head, row, strict=True)),
            "figure": figure if figure in figures else "",
            "runs": [(pair, *place[pair]) for pair in rests[name] if pair in place],
        }
        for row, name, figure in zip(table.content.rows, data["claim"], data["figure"], strict=True)
    ]


def _html(text: str) -> Markup:
    """A caption, of which nothing is taken as HTML and no file is read."""
    settings = {
        "raw_enabled": False, "file_insertion_enabled": False, "halt_level": 2, "report_level": 5,
        "initial_header_level": 4, "_disable_config": True,
    }  # fmt: skip
    try:
        parts = publish_parts(text, writer="html5", settings_overrides=settings)
    except SystemMessage as error:
        raise UserError(f"no reStructuredText ({error}) in the caption {text!r}") from error
    return Markup(parts["fragment"])


def _embedded(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _policy(style: str, script: str) -> str:
    """What the page may do: show what is in it, with its own style and script."""
    digests = (hashlib.sha256(text.encode()).digest() for text in (style, script))
    style_hash, script_hash = (base64.b64encode(digest).decode() for digest in digests)
    return (
        f"default-src 'none'; img-src data:; style-src 'sha256-{style_hash}'; "
        f"script-src 'sha256-{script_hash}'; base-uri 'none'; form-action 'none'"
    )
