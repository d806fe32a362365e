"""The true unsafe sets of both cases, and the best that the energy family can do in case A."""

from pathlib import Path

from safemr import aircraft_evidence, reachability
from safemr.aircraft import Truth

cache = Path(snakemake.params.cache)
reachability.load_or_solve(cache, reachability.ADVERSARIAL)
truth = Truth.sample(reachability.load_or_solve(cache, reachability.CONSTANT))
aircraft_evidence.frontier_table(truth).to_csv(snakemake.output[0], index=False)
