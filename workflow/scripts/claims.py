"""The verdict on each claim of the paper."""

from pathlib import Path

import pandas as pd

from safemr.report import claims, tables
from safemr.report.findings import Evidence

given, params = snakemake.input, snakemake.params
evidence = Evidence(
    scores=pd.read_csv(given.scores),
    progress=pd.read_csv(given.progress),
    expected=pd.DataFrame(params.expected, columns=["task", "variant", "seed"]),
    points={variant: (a, b) for variant, (a, b) in params.points.items()},
    aircraft=pd.read_csv(given.aircraft) if given.aircraft else None,
    certificates=pd.read_csv(given.certificates) if given.certificates else None,
    rule=tables.SafetyRule(tolerance=params.tolerance, clean_share=params.clean_share),
)
claims.claims_table(evidence).write(Path(snakemake.output.markdown).parent)
