"""Neural energy functions against the true unsafe set: rows, table and figure."""

from pathlib import Path

import pandas as pd
import torch

from safemr.aircraft import neural, reachability
from safemr.aircraft.scoring import TrueSets
from safemr.conventions import COVERS
from safemr.errors import reported_errors
from safemr.experiment import records
from safemr.measure.store import Measurements
from safemr.report import statistics
from safemr.report.aircraft import neural_table
from safemr.report.figures import aircraft, style

torch.set_num_threads(1)
given, params, output = snakemake.input, snakemake.params, snakemake.output
frontier, others = pd.read_csv(given.frontier), pd.read_csv(given.comparison)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
root = Path(params.root)
with reported_errors():
    runs, _ = records.read_records(root, params.folders)
    runs = runs.reindex(columns=runs.columns.union(expected.columns))
    comparison, x, y, cut = neural.measured(
        Measurements(root),
        TrueSets.cached(params.cache, neural.LOG2_STATES, params.task),
        frontier,
        root,
        runs,
        params.energy[0],
    )
comparison.to_csv(output.comparison, index=False)
missing = statistics.missing_runs(expected, runs)
neural_table(comparison, missing).write(Path(output.markdown).parent)
# One seed of each in the slice, every seed on the trade-off, beside the learners of zeta.
learned = others["variant"].isin(params.pair)
beside = others[learned | (others["kind"] == "certificate")]
points = pd.concat([beside, comparison[comparison["kind"] != "certificate"]])
d_min = reachability.CONSTANT.d_min
figure = aircraft.neural(x, y, cut, d_min, frontier, points, COVERS)
style.save(figure, Path(output.pdf).with_suffix(""))
