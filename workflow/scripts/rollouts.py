"""Episodes and multiplier maps of the learned certificates' policies on one task."""

from pathlib import Path

from safemr import rollouts
from safemr.certify import certificate_of_record
from safemr.cli import reported_errors
from safemr.measurements import Measurements
from safemr.plotting import data

params = snakemake.params
measurements = Measurements(params.root)
arrays = {}
with reported_errors():
    for variant, folder in params.folders.items():
        certificate, entry = certificate_of_record(Path(params.root, folder))
        if certificate.policy is None:
            print(f"no policy in {folder}")
            continue
        made = rollouts.measured(
            measurements, certificate, entry, layouts=params.layouts, steps=params.steps
        )
        arrays |= {f"{variant}/{name}": values for name, values in made.items()}
data.save(snakemake.output[0], arrays)
