"""The final policies on unseen layouts, beside their final evaluations."""

from pathlib import Path

import pandas as pd

from safemr.report import differences, second_protocol, statistics, unseen_layouts
from safemr.report.absence import missing_notes, unflown_notes

params = snakemake.params
flown = pd.concat([pd.read_csv(path) for path in snakemake.input.flown], ignore_index=True)
table = unseen_layouts.table(
    flown,
    pd.read_csv(snakemake.input.scores),
    episodes=params.episodes,
    layouts=params.layouts,
    own=params.own,
    method=params.method,
    rule=second_protocol.rule_of(params.protocol, params.tolerance, params.clean_share),
)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
runs = pd.read_csv(snakemake.input.runs)
notes = missing_notes(statistics.missing_runs(expected, runs), None, None)
notes += unflown_notes(expected, runs, flown)
source = f"{params.episodes} unseen layouts"
for made in (table, differences.differences(flown, name="unseen_differences", source=source)):
    made.noted(*notes).write(Path(snakemake.output.table[0]).parent)
