"""Return of the deterministic policy against the processor time that training had taken."""

from pathlib import Path

import pandas as pd

from safemr.report import statistics
from safemr.report.figures import curves, style

params = snakemake.params
progress, runs = pd.read_csv(snakemake.input.progress), pd.read_csv(snakemake.input.runs)
chosen = progress[progress["task"].isin(params.tasks) & progress["variant"].isin(params.variants)]
figure = curves.compute_curves(
    statistics.learning_curves(chosen, "eval_return"),
    statistics.core_minutes(chosen, runs),
    params.tasks,
)
style.save(figure, Path(snakemake.output.pdf[0]).with_suffix(""))
