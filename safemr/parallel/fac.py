"""Feasible actor-critic (`safemr.algorithms.fac`) by the parallel trainer."""

from __future__ import annotations

from dataclasses import dataclass

from safemr.algorithms import fac
from safemr.parallel import trainer

VERSION = 1
ROLE = "handcrafted"
CERTIFICATE = "energy"


@dataclass(frozen=True)
class Config(trainer.Parallel, fac.Config):
    """FAC's hyperparameters and those of the parallel trainer."""


class Trainer(trainer.Trainer):
    agent_type = fac.Agent
