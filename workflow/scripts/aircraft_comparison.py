"""Every learner's certificate and policy, and the references, against the true unsafe set."""

from pathlib import Path

import pandas as pd

from safemr import aircraft_evidence, records, statistics
from safemr.cli import reported_errors
from safemr.tasks import name_of

params, output = snakemake.params, snakemake.output
frontier = pd.read_csv(snakemake.input.frontier)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
with reported_errors():
    runs, _ = records.read_records(Path(params.root), params.folders)
    runs = runs.reindex(columns=runs.columns.union(expected.columns))
    sets = aircraft_evidence.TrueSets.cached(params.cache, task=params.task)
    comparison = aircraft_evidence.compare(sets, frontier, Path(params.root), runs)
comparison.to_csv(output.comparison, index=False)
aircraft_evidence.as_scores(comparison, name_of(params.task)).to_csv(output.scores, index=False)
missing = statistics.missing_runs(expected, runs)
aircraft_evidence.comparison_table(comparison, missing, params.task).write(
    Path(output.markdown).parent
)
