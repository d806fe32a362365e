"""Final policies on unseen layouts, with and without the filters of certificates."""

from pathlib import Path

import pandas as pd

from safemr.errors import reported_errors
from safemr.measure import filters
from safemr.measure.store import Measurements
from safemr.report.figures import style
from safemr.report.figures.filters import behind_filters
from safemr.report.filters import table

params = snakemake.params


def folders(runs):
    return [Path(params.root, run) for run in runs]


with reported_errors():
    flown = [
        filters.measured_scores(
            Measurements(params.root),
            folders(task["policies"]),
            {name: folders(runs) for name, runs in task["certificates"].items()},
            episodes=params.episodes,
            seed=params.seed,
            unlearned=params.unlearned,
            task=task["task"],
            seeds=params.seeds,
        )
        for task in params.tasks
    ]
scores = pd.concat(flown, ignore_index=True)
scores.to_csv(snakemake.output.scores, index=False)
table(scores, episodes=params.episodes).write(Path(snakemake.output.markdown).parent)
style.save(behind_filters(scores), Path(snakemake.output.pdf).with_suffix(""))
