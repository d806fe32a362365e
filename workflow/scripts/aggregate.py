"""Verify and read the records of the configured runs; write the tidy tables."""

from pathlib import Path

import pandas as pd

from safemr.errors import reported_errors
from safemr.experiment import records
from safemr.report import statistics

with reported_errors():
    runs, progress = records.read_records(Path(snakemake.params.root), snakemake.params.folders)
runs.to_csv(snakemake.output.runs, index=False)
progress.to_csv(
    snakemake.output.progress, index=False, compression={"method": "gzip", "compresslevel": 1}
)
minutes = runs[["task", "variant", "seed"]].assign(metric="minutes", value=runs["cpu_s"] / 60)
parts = [
    statistics.final_scores(progress),
    statistics.training_violations(progress),
    minutes.dropna(),
]
scores = pd.concat(parts, ignore_index=True)
scores.to_csv(snakemake.output.scores, index=False)
