"""Neural energy functions against the true unsafe set: rows, table and figure."""

from pathlib import Path

import pandas as pd
import torch

from safemr import neural_evidence, reachability, records, statistics
from safemr.aircraft import COVERS, Truth
from safemr.cli import reported_errors
from safemr.plotting import aircraft, style

PAPER = ("SafeMR", "JointSIS")  # the learners of zeta that stand beside

torch.set_num_threads(1)
given, params, output = snakemake.input, snakemake.params, snakemake.output
solution = reachability.load_or_solve(Path(params.cache), reachability.CONSTANT)
truth = Truth.sample(solution, neural_evidence.LOG2_STATES)
frontier, reference = pd.read_csv(given.frontier), pd.read_csv(given.comparison)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
root = Path(params.root)
with reported_errors():
    runs, _ = records.read_records(root, params.folders)
    runs = runs.reindex(columns=runs.columns.union(expected.columns))
    control = neural_evidence.fit_to_truth(truth, **neural_evidence.settings_of(params.energy[0]))
    comparison = neural_evidence.compare(truth, solution, frontier, root, runs, control)
    certificates = neural_evidence.recorded_certificates(truth.dynamics, root, runs)
comparison.to_csv(output.comparison, index=False)
missing = statistics.missing_runs(expected, runs)
neural_evidence.comparison_table(comparison, missing).write(Path(output.markdown).parent)
# One seed of each in the slice, every seed on the trade-off, beside the learners of zeta.
shown = {variant: found[:1] for variant, found in certificates.items()}
x, y, cut = neural_evidence.slice_at(solution, shown)
beside = reference[reference["variant"].isin(PAPER) | (reference["kind"] == "certificate")]
points = pd.concat([beside, comparison[comparison["kind"] != "certificate"]])
figure = aircraft.neural(x, y, cut, truth.dynamics.d_min, frontier, points, COVERS)
style.save(figure, Path(output.pdf).with_suffix(""))
