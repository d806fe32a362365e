"""Returns of every two algorithms compared: score tables -> `tables.Table`."""

from __future__ import annotations

import pandas as pd

from safemr.report import statistics
from safemr.report.absence import missing_notes
from safemr.report.tables import FEW, Table, entries, plus_minus


def differences(
    scores: pd.DataFrame,
    *,
    missing: pd.DataFrame | None = None,
    name: str = "differences",
    source: str = "final evaluations",
) -> Table:
    """Every two algorithms of a task compared: difference of their returns, Welch's interval.

    scores: a score table with `eval_return`. missing: runs of the grid without a
    record. `data` has one row a pair (variant minus other).
    """
    present = entries(scores[scores["metric"] == "eval_return"], None)
    columns = list(dict.fromkeys(variant for _, variant in present))
    rows, lines = [], []
    for task, variant in present:
        ours = statistics.scores_of(scores, task, variant, "eval_return")
        line = {"task": task, "algorithm": variant}
        for other in columns[: columns.index(variant)]:
            theirs = statistics.scores_of(scores, task, other, "eval_return")
            if len(theirs):
                gap = statistics.difference_interval(ours, theirs)
                rows.append([task, variant, other, *gap])
                told_apart = gap.low > 0 or gap.high < 0
                line[other] = plus_minus(*gap[:3], 2) + (" †" if told_apart else "")
        if len(line) > 2:  # not the first of its task
            lines.append(line)
    data = pd.DataFrame(
        rows, columns=["task", "variant", "other", "difference", "low", "high", "count"]
    )
    display = pd.DataFrame(lines, columns=["task", "algorithm", *columns[:-1]]).fillna("")
    caption = (
        f"Returns in {source}, compared in pairs: the row's minus the column's, mean over seeds ± "
        f"half width of Welch's 95% interval. {FEW} †: the interval does not contain 0. Not "
        "corrected for the number of pairs, and whether an algorithm is safe is not asked here."
    )
    return Table(name, caption, data, display, missing_notes(missing, None, None))
