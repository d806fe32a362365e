"""Slices of the unsafe sets, and the runs on the frontier."""

from pathlib import Path

import pandas as pd

from safemr.aircraft import reachability, scoring
from safemr.conventions import COVERS
from safemr.errors import reported_errors
from safemr.measure.store import Measurements
from safemr.report.figures import aircraft, style

params = snakemake.params
comparison = pd.read_csv(snakemake.input.comparison)
frontier = pd.read_csv(snakemake.input.frontier)
with reported_errors():
    sets = scoring.TrueSets.cached(params.cache, task=params.task)
    x, y, cuts = scoring.slices(
        sets,
        comparison,
        Measurements(params.root),
        method=params.method,
        handcrafted=params.handcrafted,
    )
d_min = reachability.CONSTANT.d_min
figures = (
    aircraft.slices(x, y, cuts, d_min),
    aircraft.frontier(frontier, comparison, COVERS, params.handcrafted),
)
for figure, path in zip(figures, snakemake.output.pdf, strict=True):
    style.save(figure, Path(path).with_suffix(""))
