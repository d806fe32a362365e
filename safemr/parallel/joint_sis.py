"""JointSIS (`safemr.algorithms.joint_sis`) by the parallel trainer."""

from __future__ import annotations

from dataclasses import dataclass

from safemr.algorithms import joint_sis
from safemr.parallel import trainer

VERSION = 1
ROLE, LEARNS = "ablation", "zeta"
CERTIFICATE = "energy"


@dataclass(frozen=True)
class Config(trainer.Parallel, joint_sis.Config):
    """JointSIS's hyperparameters and those of the parallel trainer."""


class Trainer(trainer.Trainer):
    agent_type = joint_sis.Agent
