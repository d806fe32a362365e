"""The verdict on each claim of the paper."""

from pathlib import Path

import pandas as pd

from safemr.report import claims, second_protocol
from safemr.report.findings import Evidence

given, params = snakemake.input, snakemake.params
evidence = Evidence(
    scores=pd.read_csv(given.scores),
    progress=pd.read_csv(given.progress),
    expected=pd.DataFrame(params.expected, columns=["task", "variant", "seed"]),
    points={variant: (a, b) for variant, (a, b) in params.points.items()},
    aircraft=pd.read_csv(given.aircraft) if given.aircraft else None,
    certificates=pd.read_csv(given.certificates) if given.certificates else None,
    rule=second_protocol.rule_of(params.protocol, params.tolerance, params.clean_share),
)
claims.claims_table(evidence, params.protocol).write(Path(snakemake.output.markdown).parent)
