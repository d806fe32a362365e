"""What the best energy functions of the paper's family can do against the true unsafe set."""

from safemr.aircraft.scoring import TrueSets, measured_frontier
from safemr.errors import reported_errors
from safemr.measure.store import Measurements

params = snakemake.params
with reported_errors():
    sets = TrueSets.cached(params.cache, task=params.task)
    frontier = measured_frontier(Measurements(params.root), sets)
frontier.to_csv(snakemake.output[0], index=False)
