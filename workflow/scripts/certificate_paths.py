"""zeta against the sum of its learning rates: does it settle, or only drift?"""

from pathlib import Path

import pandas as pd

from safemr.algorithms import joint_sis
from safemr.experiment import planning
from safemr.report.figures import curves, style

params = snakemake.params
progress = pd.read_csv(snakemake.input.progress)
progress = progress[progress["task"] == params.task]
rows = []
for variant, described in params.algorithms.items():
    algorithm = planning.load_algorithm(described["name"])
    config = algorithm.hyperparameters(**described["hyperparameters"])
    log = progress[(progress["variant"] == variant) & (progress["metric"] == "updates")]
    total = (described["steps"] - config.start_steps) // config.update_every
    for step, updates in log.groupby("step")["value"].mean().items():
        rows.append((variant, step, joint_sis.travelled(config, updates, total)))
travelled = pd.DataFrame(rows, columns=["variant", "step", "travel"])
figure = curves.certificate_paths(
    progress, travelled, groups=params.groups, parameters=params.parameters
)
style.save(figure, Path(snakemake.output.pdf[0]).with_suffix(""))
