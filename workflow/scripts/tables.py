"""Table I and the full results."""

import pandas as pd

from safemr import tables

params = snakemake.params
scores = pd.read_csv(snakemake.input.scores)
scores = scores[scores["task"].isin(params.tasks) & scores["variant"].isin(params.variants)]
rule = tables.SafetyRule(tolerance=params.tolerance, clean_share=params.clean_share)
tables.table_one(scores, rule=rule, tasks=params.tasks).write(params.folder)
tables.full_results(scores, rule=rule).write(params.folder)
