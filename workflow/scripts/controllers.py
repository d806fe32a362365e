"""Scores of the scripted controllers, in the same form as those of the learned policies."""

from safemr import controllers
from safemr.cli import reported_errors

params = snakemake.params
with reported_errors():
    scores = controllers.controller_scores(
        params.tasks,
        seeds=range(params.seeds),
        episodes=params.episodes,
        settings=params.settings,
    )
scores.to_csv(snakemake.output[0], index=False)
