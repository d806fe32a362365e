"""Table I and the full results."""

import pandas as pd

from safemr import statistics, tables

params = snakemake.params
scores = pd.read_csv(snakemake.input.scores)
scores = scores[scores["task"].isin(params.tasks) & scores["variant"].isin(params.variants)]
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
missing = statistics.missing_runs(expected, pd.read_csv(snakemake.input.runs))
rule = tables.SafetyRule(tolerance=params.tolerance, clean_share=params.clean_share)
tables.table_one(scores, missing=missing, rule=rule, tasks=params.tasks).write(params.folder)
tables.full_results(scores, missing=missing, rule=rule).write(params.folder)
