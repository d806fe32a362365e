"""The verdicts on the paper's claims in a few rows."""

import os
from pathlib import Path, PurePath

import pandas as pd

from safemr import files
from safemr.report.verdicts import verdicts

given, (output,) = snakemake.input, snakemake.output
figures = PurePath(os.path.relpath(snakemake.params.figures, Path(output).parent))
text = verdicts(pd.read_csv(given.claims), pd.read_csv(given.runs), figures)
files.write(Path(output), text.encode())
