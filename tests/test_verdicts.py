"""The short table of verdicts says what the table of claims says, of every claim."""

from __future__ import annotations

from pathlib import Path, PurePath

import pandas as pd
import pytest

from safemr import paper
from safemr.report import claims, documents
from safemr.report.findings import NOTHING, Finding, overall
from safemr.report.verdicts import ROWS, verdicts

FIGURES = PurePath("../../paper_figures")
RUNS = pd.DataFrame(
    {"task": "t", "variant": "v", "seed": [0, 1, 2], "cpu_s": [3600.0, 1800.0, float("nan")]}
)


def table(**changed: str) -> pd.DataFrame:
    """All claims, confirmed, but for those changed by name."""
    rows = [
        (claim.name, changed.get(claim.name, "confirmed"), "why", claim.figure)
        for claim in claims.claims()
    ]
    assert changed.keys() <= {name for name, *_ in rows}
    return pd.DataFrame(rows, columns=["claim", "verdict", "reason", "figure"])


def cells(text: str) -> dict[str, list[str]]:
    lines = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    return {first.strip(): [cell.strip() for cell in rest] for first, *rest in lines[2:]}


def test_every_claim_is_in_the_table_which_has_at_most_eight_rows() -> None:
    text = verdicts(table(), RUNS, FIGURES)
    assert list(cells(text)) == list(ROWS)
    assert len(ROWS) <= 8
    assert {verdict.partition(":")[0] for verdict, _ in cells(text).values()} == {"**confirmed**"}
    assert "3 recorded runs (seeds 0 to 2; 1.5 core-hours in all)" in text
    more = pd.concat([RUNS, RUNS.assign(variant="w").iloc[:2]])
    told = verdicts(table(), more, FIGURES)
    assert "5 recorded runs (seeds 0 to 2, 2 to 3 of them each; 3.0 core-hours" in told
    with pytest.raises(KeyError):
        verdicts(
            pd.DataFrame([["new[x]", "refuted", "why", "f"]], columns=table().columns),
            RUNS,
            FIGURES,
        )


def test_parts_stand_behind_their_verdict() -> None:
    changed = {
        "highest_return[Hazards-0.15-Push]": "inconclusive",
        "highest_return[Hazards-0.30-Push]": "refuted",
        "zero_violations": "refuted",
        "sensitivity_return": "not run",
        "sensitivity_cost": "not run",
    }
    found = cells(verdicts(table(**changed), RUNS, FIGURES))
    assert found["SafeMR returns the most of all safe algorithms"][0] == (
        "**confirmed**: Pillars-0.15-Goal, Pillars-0.30-Goal; **refuted**: Hazards-0.30-Push; "
        "**inconclusive**: Hazards-0.15-Push"
    )
    assert found["SafeMR ends without any violation"] == [
        "**refuted**", "[training_curves](../../paper_figures/training_curves.png)"
    ]  # fmt: skip
    of_all = overall(
        {task: Finding(NOTHING, said, f"a: {said} b, c; d: e") for task, said in
         zip(paper.TASKS, ("confirmed", "refuted", "confirmed", "inconclusive"), strict=True)}
    )  # fmt: skip
    judged = table(**changed)
    judged.loc[judged["claim"] == "zero_violations", "reason"] = of_all.reason
    named = cells(verdicts(judged, RUNS, FIGURES))["SafeMR ends without any violation"][0]
    assert named == (
        f"**confirmed**: {paper.TASKS[0]}, {paper.TASKS[2]}; **refuted**: {paper.TASKS[1]}; "
        f"**inconclusive**: {paper.TASKS[3]}"
    )
    # A figure is linked where something was run that it shows.
    assert "parameters.png" in found["All three [a, b] work, and training does not diverge"][1]
    assert "sensitivity.png" not in found["All three [a, b] work, and training does not diverge"][1]


def test_links_in_a_table_lead_where_they_led(tmp_path: Path) -> None:
    folder = tmp_path / "results" / "tables"
    folder.mkdir(parents=True)
    text = "[a](../../figures/a.png) [0.3, 1](b.md#c) [d](https://x.org/y) [e](#f)"
    (folder / "t.md").write_text(text)
    (tmp_path / "docs").mkdir()
    for document, path, there in (
        (tmp_path / "R.md", "results/tables/t.md", ("figures/a.png", "results/tables/b.md#c")),
        (tmp_path / "docs/r.md", "../results/tables/t.md",
         ("../figures/a.png", "../results/tables/b.md#c")),
    ):  # fmt: skip
        document.write_text(f"<!-- table: {path} -->\n<!-- end of table -->\n")
        moved = documents.with_tables(document).splitlines()[1]
        assert moved == "[a]({}) [0.3, 1]({}) [d](https://x.org/y) [e](#f)".format(*there)
