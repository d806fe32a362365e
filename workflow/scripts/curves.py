"""What changes during training: returns and costs, the same against processor time, parameters."""

from pathlib import Path

import pandas as pd

from safemr.report import statistics
from safemr.report.figures import curves, style

params = snakemake.params
progress, runs = pd.read_csv(snakemake.input.progress), pd.read_csv(snakemake.input.runs)
chosen = progress[progress["task"].isin(params.tasks) & progress["variant"].isin(params.variants)]
returns, costs = (
    statistics.learning_curves(chosen, metric) for metric in ("eval_return", "eval_cost")
)
drawn = {
    "training_curves": lambda: curves.training_curves(returns, costs, params.tasks),
    "compute_curves": lambda: curves.compute_curves(
        returns, statistics.core_minutes(chosen, runs), params.tasks
    ),
    "parameters": lambda: curves.parameter_evolution(
        progress, params.tasks, variants=params.learned, parameters=params.parameters
    ),
}
for path in map(Path, snakemake.output.pdf):
    style.save(drawn[path.stem](), path.with_suffix(""))
