"""Episodes and multiplier maps of the learned certificates' policies on one task."""

from pathlib import Path

from safemr import files
from safemr.errors import reported_errors
from safemr.measure import trajectories
from safemr.measure.certify import certificate_of_record, trained_policy
from safemr.measure.store import Measurements

params = snakemake.params
measurements = Measurements(params.root)
arrays = {}
with reported_errors():
    for variant, folder in params.folders.items():
        certificate, entry = certificate_of_record(Path(params.root, folder))
        if trained_policy(certificate) is None:
            print(f"no policy in {folder}")
            continue
        made = trajectories.measured(
            measurements, certificate, entry, layouts=params.layouts, steps=params.steps
        )
        arrays |= {f"{variant}/{name}": values for name, values in made.items()}
files.save_arrays(snakemake.output[0], arrays)
