"""Final returns against costs, and aggregated over the tasks: all runs, and the safe ones alone."""

from pathlib import Path

import numpy as np
import pandas as pd

from safemr import reference, statistics
from safemr.plotting import scores as drawing
from safemr.plotting import style
from safemr.tables import SafetyRule

params = snakemake.params
final = pd.read_csv(snakemake.input.scores)
final = final[final["task"].isin(params.tasks) & final["variant"].isin(params.variants)]
rule = SafetyRule(tolerance=params.tolerance, clean_share=params.clean_share)
scale = {task: reference.TABLE_I[task].safemr for task in params.tasks if task in reference.TABLE_I}
returns = final[final["metric"] == "eval_return"]
highest = (returns["value"] / returns["task"].map(scale)).max()
# To the next half above every run's score: a profile that ends earlier hides the best runs.
thresholds = np.linspace(-0.5, max(2.0, np.ceil(2 * np.nan_to_num(highest)) / 2), 101)
figures = [drawing.return_against_cost(final, params.tasks, tolerance=params.tolerance)]
for chosen, name in ((final, "return"), (rule.safe_returns(final), "safe return")):
    aggregates = statistics.aggregate(chosen, params.variants, reference.METHOD, scale, thresholds)
    figures.append(drawing.aggregate_scores(aggregates, name=name))
for figure, path in zip(figures, snakemake.output.pdf, strict=True):
    style.save(figure, Path(path).with_suffix(""))
