"""Final returns against costs, and aggregated over the tasks: all runs, and the safe ones alone."""

from pathlib import Path

import numpy as np
import pandas as pd

from safemr import paper
from safemr.report import second_protocol, statistics
from safemr.report.figures import scores as drawing
from safemr.report.figures import style

params = snakemake.params
final = pd.read_csv(snakemake.input.scores)
final = final[final["task"].isin(params.tasks) & final["variant"].isin(params.variants)]
rule = second_protocol.rule_of(params.protocol, params.tolerance, params.clean_share)
scale = {task: paper.TABLE_I[task].safemr for task in params.tasks if task in paper.TABLE_I}
pairs = final[["task", "variant"]].drop_duplicates().itertuples(index=False, name=None)
figures = {
    "return_against_cost": drawing.return_against_cost(
        final,
        params.tasks,
        tolerance=params.tolerance if params.protocol == 1 else None,
        clean_share=params.clean_share,
        unsafe=[pair for pair in pairs if not rule.is_safe(final, *pair)],
        hollow_means=rule.marks[1],
    )
}
if scale:  # the paper's return is the unit
    returns = final[(final["metric"] == "eval_return") & final["task"].isin(list(scale))]
    normalised = np.nan_to_num((returns["value"] / returns["task"].map(scale)).agg(["min", "max"]))
    # To the next half beyond every run's score: a profile that ends earlier hides runs.
    low, high = np.floor(2 * normalised[0]) / 2, np.ceil(2 * normalised[1]) / 2
    thresholds = np.linspace(min(-0.5, low), max(2.0, high), 121)
    unsafe = "safe return: 0 where the run is not safe, or its task's lowest if that is negative"
    for chosen, file, name, meaning in (
        (final, "aggregate_scores", "return", ""),
        (rule.safe_returns(final), "aggregate_safe_scores", "safe return", unsafe),
    ):
        aggregates = statistics.aggregate(chosen, params.variants, params.method, scale, thresholds)
        figures[file] = drawing.aggregate_scores(
            aggregates,
            method=params.method,
            name=name,
            absent=[variant for variant in params.variants if variant not in aggregates.profiles],
            meaning=meaning,
            tasks=() if len(scale) == len(params.tasks) else tuple(scale),
        )
for path in map(Path, snakemake.output.pdf):
    style.save(figures[path.stem], path.with_suffix(""))
