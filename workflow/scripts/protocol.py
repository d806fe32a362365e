"""Windows of final evaluations, violations while training, and what this many seeds can see."""

from pathlib import Path

import pandas as pd

from safemr.report import power, second_protocol, sensitivity_of_protocol, statistics
from safemr.report.absence import missing_notes, unflown_notes

given, params = snakemake.input, snakemake.params
judged, progress = pd.read_csv(given.judged), pd.read_csv(given.progress)
progress = progress[progress["task"].isin(params.tasks)]
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
runs = pd.read_csv(given.runs)
notes = missing_notes(statistics.missing_runs(expected, runs), params.tasks, None)
notes += unflown_notes(expected, runs, judged)
rule = second_protocol.rule_of(params.protocol, params.tolerance, params.clean_share)
for table in (
    sensitivity_of_protocol.windows(
        progress, judged, params.tasks, params.method, params.baselines
    ),
    sensitivity_of_protocol.training_violations(progress),
    power.of_returns(judged, params.tasks, params.method, params.baselines),
    power.of_safety(judged, params.tasks, rule),
):
    table.noted(*notes).write(Path(snakemake.output.table[0]).parent)
