"""How small certificates are, how small they may be, and what the policies behind them return."""

from pathlib import Path

import pandas as pd

from safemr.errors import reported_errors
from safemr.measure.oracle import ORACLE, measured_sizes
from safemr.measure.store import Measurements
from safemr.report import regularizer, sizes, statistics
from safemr.report.absence import missing_notes, unflown_notes
from safemr.report.figures import style
from safemr.report.figures.regularizer import at_equal_size
from safemr.report.figures.sizes import against_size

params, output = snakemake.params, snakemake.output
with reported_errors():
    found = measured_sizes(
        Measurements(params.root), [Path(params.root, folder) for folder in params.folders]
    )
    flown = pd.concat(map(pd.read_csv, snakemake.input.flown))
    others = params.beside and sizes.Others.read(*map(Path, params.beside), ours=found, flown=flown)
found.to_csv(output.sizes, index=False)
expected = pd.DataFrame(params.expected, columns=["task", "variant", "seed"])
measured = found.dropna(subset="variant").astype({"seed": int})
notes = missing_notes(statistics.missing_runs(expected, measured), None, None)
sizes.table(found, others).noted(*notes).write(Path(output.markdown).parent)
yardsticks = found[found["certificate"] == ORACLE].set_index("task")["area"].to_dict()
points = sizes.merged(found, flown)
if others:
    points = pd.concat([points, sizes.merged(others.sizes, others.flown)])
absent = statistics.missing_runs(expected, points)
notes += unflown_notes(expected, measured, points)
made = regularizer.table(
    points, params.tasks, params.method, params.ablation, incomplete=set(absent["task"])
)
made.noted(*notes).write(Path(output.markdown).parent)
figure = at_equal_size(points, params.tasks, made)
style.save(figure, Path(output.fit_pdf).with_suffix(""))
figure = against_size(points, params.tasks, yardsticks)
style.save(figure, Path(output.pdf).with_suffix(""))
