"""SafeMR whose certificate stays feasible: zeta descends along the boundary of what is feasible.

The paper's descent on a (sigma + d_min)^n + b k ends where the learning rate does: the constraint's
part of the loss (Eq. SL2add) has no force that would stop it where a smaller certificate is no
longer feasible. Here a step is taken as it is where, of the point robot's reachable motions near
an obstacle, each still has an action that keeps the constraint (`safemr.certificates.oracle`, on
the grid by which certificates are judged). Where one has none, the step is brought back to the
nearest zeta at which, to first order, the worst of those found has one again: the component along
the boundary is left of it. So the descent ends where the boundary is at right angles to it, a
constrained minimum of the loss, and not where its learning rate does. From a start that is not
feasible a step that cannot be brought back is taken where the worst encounter gets better.

Not in the paper. It needs a model of the robot, which model-free SafeMR does not; zeta moves less
often, since each step is checked, and equally far.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from safemr.algorithms import safemr
from safemr.certificates.oracle import Encounters
from safemr.errors import UserError
from safemr.learning.contract import MakeEnvs
from safemr.learning.losses import Info
from safemr.learning.replay import Batch

VERSION = 2  # 1 refused such steps part by part, and checked them on a coarser grid
ROLE, LEARNS = "method", "zeta"
CERTIFICATE = "energy"

ATTEMPTS = 6  # to bring a step back
DIFFERENCE = 0.005  # of each parameter, for the boundary's direction
SLACK = 1e-4  # g below 0 that is aimed at


@dataclass(frozen=True)
class Config(safemr.Config):
    """SafeMR's hyperparameters; each of its steps of zeta is checked, hence fewer."""

    certificate_delay: int = 512  # m_phi: gradient steps for one of zeta


class Agent(safemr.Agent):
    """Its trainer gives it ``encounters``, on which zeta has to be feasible."""

    config: Config
    encounters: Encounters

    def update_certificate(self, batch: Batch) -> Info:
        """JointSIS's; the metrics say whether the step was brought back, and how far zeta moved."""
        before, self._brought_back = self.zeta.clone(), 0.0
        info = super().update_certificate(batch)
        if info:
            info["certificate_brought_back"] = self._brought_back
            info["certificate_moved"] = (self.zeta - before).norm()
        return info

    def admitted(self, proposed: Tensor) -> Tensor:
        """The proposal, or what is left of it along the boundary."""
        tried: Tensor | None = proposed
        for attempt in range(ATTEMPTS):
            if tried is None:
                break
            if self._feasible(tried):
                self._brought_back = float(attempt > 0)
                return tried
            tried = self._brought_nearer(tried)
        self._brought_back = 1.0
        return proposed if self._better(proposed) else self.zeta.clone()

    def _feasible(self, zeta: Tensor) -> bool:
        asked, eta = self._parameters(zeta), self.config.eta
        try:
            return not self.encounters.refuted(asked, eta) and (
                self.encounters.verdict(asked, eta).feasible
            )
        except UserError:  # phi is positive far away from every obstacle
            return False

    def _better(self, zeta: Tensor) -> bool:
        """Whether the present zeta is not feasible, and the worst encounter of this less bad."""
        eta = self.config.eta
        before = self.encounters.verdict(self._parameters(self.zeta), eta)
        if before.feasible:
            return False
        try:
            return self.encounters.verdict(self._parameters(zeta), eta).worst < before.worst
        except UserError:
            return False

    def _brought_nearer(self, zeta: Tensor) -> Tensor | None:
        """The nearest zeta in the box at which, to first order, the worst encounter known has
        g = -SLACK; None where there is no such direction."""
        worst = self._worst(zeta)
        normal = torch.zeros_like(zeta)
        for index in range(len(zeta)):
            offset = torch.zeros_like(zeta)
            offset[index] = DIFFERENCE
            normal[index] = (self._worst(zeta + offset) - self._worst(zeta - offset)) / (
                2.0 * DIFFERENCE
            )
        # What the box holds back cannot help.
        held = ((zeta <= self._low) & (normal > 0)) | ((zeta >= self._high) & (normal < 0))
        normal[held] = 0.0
        length = float(normal @ normal)
        if not np.isfinite([worst, length]).all() or length == 0.0:
            return None
        return (zeta - (worst + SLACK) / length * normal).clamp(self._low, self._high)

    def _worst(self, zeta: Tensor) -> float:
        try:
            return self.encounters.remembered_worst(self._parameters(zeta), self.config.eta)
        except UserError:
            return float("inf")

    def _parameters(self, zeta: Tensor) -> Any:
        return self.config.energy_family.at(zeta.tolist())

    def state_dict(self) -> dict[str, Any]:
        """With the encounters that refuted certificates, by which steps are brought back."""
        return {**super().state_dict(), "encounters": self.encounters.hard}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.encounters.hard = np.array(state["encounters"])


class Trainer(safemr.Trainer):
    agent_type = Agent

    def __init__(self, config: Any, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        super().__init__(config, make_envs, seed, total_steps)
        envs: Any = self.envs
        self.agent.encounters = Encounters(
            envs.unwrapped,
            self.interface.action_repeat,
            self.interface.action_scale,
        )
