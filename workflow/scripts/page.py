"""The page of results."""

from pathlib import Path

import pandas as pd

from safemr.report import page

given, params = snakemake.input, snakemake.params
page.write(
    Path(snakemake.output[0]),
    tables=[Path(path) for path in given.tables],
    pictures={
        Path(path): Path(path).relative_to(params.figures_root).with_suffix("").as_posix()
        for path in given.pictures
    },
    captions=params.captions,
    runs=pd.read_csv(given.runs),
    expected=params.expected,
    points={variant: (a, b) for variant, (a, b) in params.points.items()},
    lead=params.lead,
)
