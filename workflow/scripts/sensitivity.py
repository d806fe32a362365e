"""Return, cost and learned parameters at each point [a, b]."""

from pathlib import Path

import pandas as pd

from safemr.report import sensitivity, statistics
from safemr.report.figures import curves, style

params = snakemake.params
points = {variant: (a, b) for variant, (a, b) in params.points.items()}
progress = pd.read_csv(snakemake.input.progress)
chosen = progress[progress["task"] == params.task]
returns, costs = (
    statistics.learning_curves(chosen, metric) for metric in ("eval_return", "eval_cost")
)
figure = curves.sensitivity(returns, costs, points, method=params.method, baseline=params.ablation)
style.save(figure, Path(snakemake.output.pdf[0]).with_suffix(""))
learned = statistics.last_values(chosen, params.parameters)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
missing = statistics.missing_runs(expected, pd.read_csv(snakemake.input.runs))
table = sensitivity.table_two(
    learned, points, missing=missing, task=params.task, parameters=params.parameters
)
table.write(Path(snakemake.output.table[0]).parent)
