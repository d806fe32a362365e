"""Scores of one task's final policies on layouts that no run was evaluated on."""

from pathlib import Path

from safemr.errors import reported_errors
from safemr.measure import unseen_layouts
from safemr.measure.store import Measurements

params = snakemake.params
with reported_errors():
    scores = unseen_layouts.measured_scores(
        Measurements(params.root),
        [Path(params.root, folder) for folder in params.folders],
        episodes=params.episodes,
        seed=params.seed,
        own=params.own,
    )
scores.to_csv(snakemake.output[0], index=False)
