"""Slices of the unsafe sets, one of them in the paper's style, and the runs on the frontier."""

from dataclasses import replace
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
head_on = cuts[3]
learned = {name: head_on.learned[name] for name in params.pair if name in head_on.learned}
figures = (
    aircraft.slices(x, y, cuts, d_min),
    aircraft.single(x, y, replace(head_on, learned=learned), d_min),
    aircraft.frontier(frontier, comparison, COVERS, params.handcrafted),
)
for figure, path in zip(figures, snakemake.output.pdf, strict=True):
    style.save(figure, Path(path).with_suffix(""))
