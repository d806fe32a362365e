"""Episodes and multiplier maps of the learned certificates' policies on one task."""

from pathlib import Path

from safemr import rollouts
from safemr.certify import certificate_of_record
from safemr.cli import reported_errors
from safemr.plotting import data
from safemr.policies import load_policy

params, task = snakemake.params, snakemake.wildcards.task
arrays = {}
with reported_errors():
    for variant, folder in params.folders.items():
        certificate, _, settings = certificate_of_record(Path(params.root, folder))
        if certificate.policy is None:
            print(f"no policy in {folder}")
            continue
        policy = load_policy(certificate.policy)
        parts = {
            "episodes": rollouts.episodes(
                policy, task, seeds=params.layouts, steps=params.steps, settings=settings
            ),
            "map": rollouts.multiplier_map(
                policy, certificate.zeta, task, seed=params.layouts[0], settings=settings
            ),
        }
        arrays |= {
            f"{variant}/{part}/{name}": values
            for part, made in parts.items()
            for name, values in made.items()
        }
data.save(snakemake.output[0], arrays)
