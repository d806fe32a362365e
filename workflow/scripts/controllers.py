"""Scores of the scripted controllers, in the same form as those of the learned policies."""

from safemr.errors import reported_errors
from safemr.measure import controllers
from safemr.measure.store import Measurements

params = snakemake.params
with reported_errors():
    scores = controllers.measured_scores(
        Measurements(params.root),
        params.tasks,
        seeds=params.seeds,
        episodes=params.episodes,
    )
scores.to_csv(snakemake.output[0], index=False)
