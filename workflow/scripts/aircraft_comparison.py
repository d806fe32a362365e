"""Every learner's certificate and policy, and the references, against the true unsafe set."""

from pathlib import Path

import pandas as pd

from safemr.aircraft import scoring
from safemr.errors import reported_errors
from safemr.experiment import records
from safemr.report import aircraft as tables
from safemr.report import statistics
from safemr.tasks import name_of

params, output = snakemake.params, snakemake.output
frontier = pd.read_csv(snakemake.input.frontier)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
with reported_errors():
    runs, _ = records.read_records(Path(params.root), params.folders)
    runs = runs.reindex(columns=runs.columns.union(expected.columns))
    sets = scoring.TrueSets.cached(params.cache, task=params.task)
    comparison = scoring.compare(sets, frontier, Path(params.root), runs)
comparison.to_csv(output.comparison, index=False)
scoring.as_scores(comparison, name_of(params.task)).to_csv(output.scores, index=False)
missing = statistics.missing_runs(expected, runs)
table = tables.comparison_table(comparison, missing, params.task, params.pair)
table.write(Path(output.markdown).parent)
