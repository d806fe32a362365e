"""The final policies on unseen layouts, beside their final evaluations."""

from pathlib import Path

import pandas as pd

from safemr import unseen
from safemr.tables import SafetyRule

params = snakemake.params
table = unseen.table(
    pd.concat([pd.read_csv(path) for path in snakemake.input.flown], ignore_index=True),
    pd.read_csv(snakemake.input.scores),
    episodes=params.episodes,
    rule=SafetyRule(params.tolerance, params.clean_share),
)
table.write(Path(snakemake.output.markdown).parent)
