"""SafeMR whose certificate stays feasible: a step of zeta that would lose feasibility is refused.

The paper's descent on a (sigma + d_min)^n + b k ends where the learning rate does: the constraint's
part of the loss (Eq. SL2add) has no force that would stop it where a smaller certificate is no
longer feasible. Here a step is taken only where, of the point robot's reachable motions near an
obstacle, each still has an action that keeps the constraint (`safemr.certificates.oracle`), or,
from a start that lacks this, where the worst of them gets better. Of a step that is refused as a
whole its parts are tried, one parameter after the other, so that the descent may slide along the
boundary. Where no part is admitted, it has stopped by itself.

Not in the paper. It needs a model of the robot, which model-free SafeMR does not; zeta moves less
often, since each step is checked, and equally far.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from safemr.algorithms import safemr
from safemr.certificates.oracle import Encounters
from safemr.errors import UserError
from safemr.learning.contract import MakeEnvs
from safemr.learning.losses import Info
from safemr.learning.replay import Batch

VERSION = 1
ROLE, LEARNS = "method", "zeta"
CERTIFICATE = "energy"

# Of the check: a hundred are made in a run, each in a tenth of a second.
CELL, BEARINGS, SPACING = (0.15, 0.15, 0.75), 24, 0.04


@dataclass(frozen=True)
class Config(safemr.Config):
    """SafeMR's hyperparameters; each of its steps of zeta is checked, hence fewer."""

    certificate_delay: int = 512  # m_phi: gradient steps for one of zeta


class Agent(safemr.Agent):
    """Its trainer gives it ``encounters``, on which zeta has to be feasible."""

    config: Config
    encounters: Encounters

    def update_certificate(self, batch: Batch) -> Info:
        """JointSIS's, with the share of zeta's parts that moved among the metrics."""
        before = self.zeta.clone()
        info = super().update_certificate(batch)
        if info:
            info["certificate_moved"] = (self.zeta != before).float().mean()
        return info

    def admitted(self, proposed: Tensor) -> Tensor:
        """The proposal, or as many of its parts as feasibility allows."""
        if self._holds(proposed):
            return proposed
        admitted = self.zeta.clone()
        for index in range(len(proposed)):
            part = admitted.clone()
            part[index] = proposed[index]
            if part[index] != admitted[index] and self._holds(part):
                admitted = part
        return admitted

    def _holds(self, zeta: Tensor) -> bool:
        """Whether zeta is feasible, or at its worst state less infeasible than it is now."""
        family, eta = self.config.energy_family, self.config.eta
        asked, now = (family.at(values.tolist()) for values in (zeta, self.zeta))
        try:
            refuted = self.encounters.refuted(asked, eta)
            if not refuted and self.encounters.verdict(asked, eta).feasible:
                return True
        except UserError:  # phi is positive far away from every obstacle
            return False
        before = self.encounters.verdict(now, eta)
        return not before.feasible and self.encounters.verdict(asked, eta).worst < before.worst


class Trainer(safemr.Trainer):
    agent_type = Agent

    def __init__(self, config: Any, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        super().__init__(config, make_envs, seed, total_steps)
        envs: Any = self.envs
        self.agent.encounters = Encounters(
            envs.unwrapped,
            self.interface.action_repeat,
            self.interface.action_scale,
            cell=CELL,
            bearings=BEARINGS,
            spacing=SPACING,
        )
