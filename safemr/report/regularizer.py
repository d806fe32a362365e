"""Is it the regularizer, or the size of the unsafe set that it leads to?

Return against the unsafe area of the run's final certificate, with and without weights [a, b] in
the loss: the rule stands in docs/claims.md, "The second protocol".
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import pandas as pd

from safemr import paper
from safemr.report import statistics
from safemr.report.second_protocol import PRIMARY_LEVEL
from safemr.report.statistics import Estimate
from safemr.report.tables import ABSENT, FEW, MISSING, Table

SHARE = 0.5  # of the difference to be explained: what the size may leave over
FEWEST = 8  # certificates, four more than there are coefficients


def at_equal_size(points: pd.DataFrame) -> Estimate:
    """gamma of return = c0 + c1 A + c2 A^2 + gamma R, what the regularizer adds at equal area A.

    A point a certificate, the mean of its runs: these have nearly one area, so that what tells
    gamma from the size is how certificates differ, not runs.

    points: runs on one task, with variant, area, regularized (R) and return. nan where certificates
    are too few, or all alike in R.
    """
    means = _means(points)
    factors = _factors(means["area"].to_numpy(), means["regularized"].to_numpy())
    return statistics.linear_effects(factors, means["return"].to_numpy())[-1]


def curves(points: pd.DataFrame, areas: np.ndarray) -> np.ndarray:
    """[2, n] what the fit of `at_equal_size` says of areas [n] without and with the regularizer."""
    means = _means(points)
    found, values = means["area"].to_numpy(), means["return"].to_numpy()
    design = np.insert(_factors(found, means["regularized"].to_numpy()), 0, 1.0, axis=1)
    fitted = np.linalg.lstsq(design, values, rcond=None)[0]
    return np.stack(
        [fitted[0] + _factors(areas, np.full(len(areas), made)) @ fitted[1:] for made in (0.0, 1.0)]
    )


def _means(points: pd.DataFrame) -> pd.DataFrame:
    chosen = points[["variant", "area", "regularized", "return"]].astype({"regularized": float})
    return chosen.groupby("variant").mean()


def _factors(area: np.ndarray, regularized: np.ndarray) -> np.ndarray:
    return np.column_stack([area, area**2, regularized])


def pair(points: pd.DataFrame, method: str, ablation: str) -> tuple[str, str]:
    """The two variants whose difference is to be explained, by their names.

    The paper's where both were flown, since a configuration beside the grid has other ablations of
    its own; else the configuration's.
    """
    flown = set(points["variant"])
    papers = (paper.METHOD, paper.ABLATION)
    return papers if flown.issuperset(papers) else (method, ablation)


def answer(gap: Estimate, added: Estimate) -> str:
    """What the rule says of SafeMR's difference to JointSIS and of gamma; size: certificates."""
    if np.isnan(gap.low) or np.isnan(added.low) or added.size < FEWEST:
        return ABSENT
    if gap.low <= 0:
        return "no difference shown"
    if max(-added.low, added.high) <= SHARE * gap.mean:
        return "the size"
    if added.low > 0:
        return "the regularizer, too"
    return "less than the size promises" if added.high < 0 else "not decided"


def table(
    points: pd.DataFrame,
    tasks: Sequence[str],
    method: str,
    ablation: str,
    *,
    incomplete: Collection[str] = (),
) -> Table:
    """A row a task.

    points: `safemr.report.sizes.merged`; method, ablation: as `pair` takes them; incomplete: tasks
    on which runs are missing, of which nothing is answered.
    """
    method, ablation = pair(points, method, ablation)
    rows: list[dict[str, Any]] = []
    for task in tasks:
        runs = points[(points["task"] == task) & (points["k"] > 0)]  # all but phi_0
        ours, theirs = (
            runs.loc[runs["variant"] == name, "return"].to_numpy(float)
            for name in (method, ablation)
        )
        gap = statistics.difference_interval(ours, theirs, PRIMARY_LEVEL)
        added = at_equal_size(runs)
        rows.append(
            {
                "task": task, "runs": len(runs), "regularized": int(runs["regularized"].sum()),
                "certificates": runs["variant"].nunique(),
                "difference": gap.mean, "difference_low": gap.low, "difference_high": gap.high,
                "added": added.mean, "added_low": added.low, "added_high": added.high,
                "answer": MISSING if task in incomplete else answer(gap, added),
            }
        )  # fmt: skip

    def shown(mean: float, low: float, high: float) -> str:
        if np.isnan(mean):
            return ABSENT
        return f"{mean:.2f}" if np.isnan(low) else f"{mean:.2f} [{low:.2f}, {high:.2f}]"

    display = pd.DataFrame(
        [
            [
                row["task"], f"{row['runs']} of {row['certificates']}", str(row["regularized"]),
                *(
                    shown(*(row[f"{name}{end}"] for end in ("", "_low", "_high")))
                    for name in ("difference", "added")
                ),
                row["answer"],
            ]
            for row in rows
        ],
        columns=["task", "runs of certificates", "with [a, b]", f"{method} minus {ablation}",
                 "with [a, b] minus without, at equal size", "what explains it"],
    )  # fmt: skip
    caption = (
        "Is it the regularizer, or the size of the unsafe set? "
        f"{method} minus {ablation}: returns on unseen layouts, with Welch's "
        f"{100 * PRIMARY_LEVEL:g}% interval. At equal size: by least squares over all certificates "
        "with a speed term, a point each, return on unsafe area, its square and whether [a, b] are "
        "in the loss; 95% t interval. The size: that interval lies within half of the difference "
        f"(docs/claims.md). No answer stands with fewer than {FEWEST} certificates."
    )
    return Table("regularizer", caption, pd.DataFrame(rows), display, [FEW])


def in_words(table: Table) -> dict[str, str]:
    """Of each task what a figure's title says: gamma and its interval, if it has an answer."""
    words = {}
    for row in table.data.itertuples():
        if row.answer == MISSING:
            words[row.task] = "runs are missing"
        elif row.certificates >= FEWEST:
            ends = f"{row.added_low:.2f}, {row.added_high:.2f}"
            words[row.task] = f"with [a, b] minus without, at equal size: {row.added:.2f} [{ends}]"
        else:
            words[row.task] = ""
    return words


def fitted(table: Table) -> set[str]:
    """The tasks of which a figure shows the fit: all runs are there, and enough certificates."""
    rows = table.data
    return set(rows.loc[(rows["answer"] != MISSING) & (rows["certificates"] >= FEWEST), "task"])
