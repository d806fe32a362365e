"""Feasible actor-critic with the oracle's certificate: the best that its family can give.

The energy function is the paper's, fixed as in `fac`; its zeta is not handcrafted but looked for
before training: of the box in which JointSIS and SafeMR keep theirs, the member of the least unsafe
area that is feasible in every motion that the robot can get into (`safemr.certificates.oracle`).
What a policy returns with it bounds what a better learned zeta could bring. The search takes
seconds, needs a model of the point robot, and draws nothing: the same task and interface give the
same zeta, which progress and policy file say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch

from safemr.algorithms import fac, joint_sis
from safemr.certificates.families import Parameters
from safemr.certificates.oracle import Encounters, smallest
from safemr.learning.contract import MakeEnvs

VERSION = 1
ROLE = "handcrafted"
CERTIFICATE = "energy"


@dataclass(frozen=True)
class Config(fac.Config):
    """FAC's hyperparameters; the certificate's are found."""

    UNUSED: ClassVar[Mapping[str, str]] = dict.fromkeys(
        fac.Config.PAPERS, "the certificate is looked for"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("start", not self.start, "not used: the certificate is looked for")
        self.require("length_scale", self.length_scale == 1.0, "must be 1: metres are looked in")


class Agent(fac.Agent):
    """Feasible actor-critic whose zeta its trainer has found."""


class Trainer(fac.Trainer):
    agent_type = Agent

    def __init__(self, config: Any, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        super().__init__(config, make_envs, seed, total_steps)
        envs: Any = self.envs
        envs, interface = envs.unwrapped, self.interface
        key = (getattr(envs, "task", None), interface, config.family, config.eta)
        if key not in _FOUND:
            encounters = Encounters(envs, interface.action_repeat, interface.action_scale)
            box = joint_sis.Config(family=config.family).box
            _FOUND[key] = smallest(encounters, config.energy_family, box, eta=config.eta).zeta
        self.agent.zeta.copy_(torch.tensor(list(_FOUND[key])))


_FOUND: dict[Any, Parameters] = {}  # of this process, by task, decisions, family and eta
