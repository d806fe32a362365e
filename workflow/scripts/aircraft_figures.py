"""Slices of the unsafe sets, one of them in the paper's style, and the runs on the frontier."""

from dataclasses import replace
from pathlib import Path

import pandas as pd

from safemr import aircraft_evidence, reachability
from safemr.aircraft import COVERS
from safemr.plotting import aircraft, style

PAPER = ("SafeMR", "JointSIS")  # the learners of the paper's picture

constant, adversarial = (
    reachability.load_or_solve(Path(snakemake.params.cache), case)
    for case in (reachability.CONSTANT, reachability.ADVERSARIAL)
)
comparison = pd.read_csv(snakemake.input.comparison)
frontier = pd.read_csv(snakemake.input.frontier)
x, y, cuts = aircraft_evidence.slices(constant, adversarial, comparison)
d_min = constant.dynamics.d_min
head_on = cuts[3]
learned = {name: head_on.learned[name] for name in PAPER if name in head_on.learned}
figures = (
    aircraft.slices(x, y, cuts, d_min),
    aircraft.single(x, y, replace(head_on, learned=learned), d_min),
    aircraft.frontier(frontier, comparison, COVERS),
)
for figure, path in zip(figures, snakemake.output.pdf, strict=True):
    style.save(figure, Path(path).with_suffix(""))
