"""Final performance and learned parameters over a grid of weights [a, b]."""

from pathlib import Path

import pandas as pd

from safemr.report import second_protocol, sensitivity, statistics
from safemr.report.figures import scores as drawings
from safemr.report.figures import style

params = snakemake.params
points = {variant: (a, b) for variant, (a, b) in params.points.items()}
learned = statistics.last_values(pd.read_csv(snakemake.input.progress), params.parameters)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
table = sensitivity.weight_map(
    pd.read_csv(snakemake.input.scores),
    learned,
    points,
    missing=statistics.missing_runs(expected, pd.read_csv(snakemake.input.runs)),
    rule=second_protocol.rule_of(params.protocol, params.tolerance, params.clean_share),
    task=params.task,
    method=params.method,
    baseline=params.ablation,
    parameters=params.parameters,
)
table.write(Path(snakemake.output.table[0]).parent)
figure = drawings.weight_map(table.data, params.parameters)
style.save(figure, Path(snakemake.output.pdf[0]).with_suffix(""))
