"""SafeMR (`safemr.algorithms.safemr`) by the parallel trainer: the paper's own PABAL."""

from __future__ import annotations

from dataclasses import dataclass

from safemr.algorithms import safemr
from safemr.parallel import trainer

VERSION = 1
ROLE, LEARNS = "method", "zeta"
CERTIFICATE = "energy"


@dataclass(frozen=True)
class Config(trainer.Parallel, safemr.Config):
    """SafeMR's hyperparameters and those of the parallel trainer."""


class Trainer(trainer.Trainer):
    agent_type = safemr.Agent
