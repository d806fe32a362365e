"""Return and cost of the deterministic policy during training, one column a task."""

from pathlib import Path

import pandas as pd

from safemr.report import statistics
from safemr.report.figures import curves, style

params = snakemake.params
progress = pd.read_csv(snakemake.input.progress)
chosen = progress[progress["task"].isin(params.tasks) & progress["variant"].isin(params.variants)]
returns, costs = (
    statistics.learning_curves(chosen, metric) for metric in ("eval_return", "eval_cost")
)
figure = curves.training_curves(returns, costs, params.tasks)
style.save(figure, Path(snakemake.output.pdf).with_suffix(""))
