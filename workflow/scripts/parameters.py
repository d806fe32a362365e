"""The learned parameters of the energy function during training."""

from pathlib import Path

import pandas as pd

from safemr.report.figures import curves, style

params = snakemake.params
progress = pd.read_csv(snakemake.input.progress)
figure = curves.parameter_evolution(
    progress, params.tasks, variants=params.learned, parameters=params.parameters
)
style.save(figure, Path(snakemake.output.pdf[0]).with_suffix(""))
