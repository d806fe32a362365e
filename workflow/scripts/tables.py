"""Table I, the full results, all pairs, what they cost, and the parts of the Push returns."""

from pathlib import Path

import pandas as pd

from safemr.report import compute, differences, parallel, second_protocol, statistics, tables
from safemr.report.absence import unflown_notes

given, params = snakemake.input, snakemake.params
learned = pd.read_csv(given.scores)
learned = learned[learned["task"].isin(params.tasks) & learned["variant"].isin(params.variants)]
scores = pd.concat([learned, pd.read_csv(given.controllers)], ignore_index=True)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
runs = pd.read_csv(given.runs)
missing = statistics.missing_runs(expected, runs)
rule = second_protocol.rule_of(params.protocol, params.tolerance, params.clean_share)
source = f"{params.flown} unseen layouts" if params.flown else "final evaluations"
made = [
    tables.table_one(
        learned,
        missing=missing,
        rule=rule,
        tasks=params.tasks,
        method=params.method,
        baselines=params.baselines,
    ),
    tables.full_results(
        scores, missing=missing, rule=rule, layouts=params.layouts, flown=params.flown
    ),
    differences.differences(learned, missing=missing, source=source),
]
if params.push:
    made.append(tables.push_split(scores, params.push, missing=missing, rule=rule))
if params.flown:
    notes = unflown_notes(expected, runs, learned)
    made = [table.noted(*notes) for table in made]
made.append(compute.table(runs, workers=bool(given.progress)))
if given.progress:
    progress = pd.read_csv(given.progress)
    made.append(parallel.table(learned, progress, runs, missing=missing))
for table in made:
    table.write(Path(snakemake.output.table[0]).parent)
