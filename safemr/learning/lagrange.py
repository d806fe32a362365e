"""The scalar multiplier of the -Lagrangian baselines: dual ascent on an episode's cost.

lambda = softplus(p), and the optimiser minimises -p (EpCost - cost_limit) over the raw parameter p,
as in safety-starter-agents (``penalty_param``; Ray, Achiam & Amodei 2019, section 5). The gradient
does not carry softplus' slope, so a multiplier near zero is not stuck there.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from safemr.learning.adam import Adam

MultiplierOptimizer = Literal["adam", "sgd"]


@dataclass(frozen=True)
class MultiplierConfig:
    """The multiplier's part of a -Lagrangian baseline's hyperparameters."""

    multiplier_initial: float = 1.0  # lambda at the start
    multiplier_lr: float = 5e-2  # learning rate of lambda's raw parameter, a step an epoch
    multiplier_optimizer: MultiplierOptimizer = "adam"  # sgd: steps in proportion to the violation

    RANGES: ClassVar[Mapping[str, str]] = {
        "multiplier_initial": "[0, 1e6]",
        "multiplier_lr": "(0, 1]",
    }
    CHOICES: ClassVar[Mapping[str, tuple[str, ...]]] = {"multiplier_optimizer": ("adam", "sgd")}


def penalised(reward: Tensor, cost: Tensor, multiplier: float) -> Tensor:
    """(reward - lambda cost) / (1 + lambda): a large multiplier does not scale the step up."""
    return (reward - multiplier * cost) / (1.0 + multiplier)


class Multiplier:
    """A non-negative scalar, raised while the cost is above its limit and lowered below it.

    Adam steps by about its learning rate whatever the size of the violation, and its momentum
    delays a turn: after ``n`` updates with violation G > 0 followed by slack g > 0, lambda falls
    from the first update k with 0.9^k < g / (g + (1 - 0.9^n) G) on. "sgd" moves p in proportion
    to the violation instead.
    """

    def __init__(self, config: MultiplierConfig) -> None:
        initial = config.multiplier_initial
        # log(exp(x) - 1) inverts softplus; written so that a large x does not overflow
        raw = initial + math.log(-math.expm1(-max(initial, 1e-8)))
        self.raw = torch.tensor(raw, dtype=torch.float64, requires_grad=True)
        self.optimizer: Adam | torch.optim.SGD
        if config.multiplier_optimizer == "adam":
            self.optimizer = Adam([self.raw], config.multiplier_lr, fused=False)
        else:
            self.optimizer = torch.optim.SGD([self.raw], lr=config.multiplier_lr)

    @property
    def value(self) -> float:
        """lambda >= 0."""
        return float(torch.nn.functional.softplus(self.raw.detach()))

    def update(self, episode_cost: float, cost_limit: float) -> None:
        """One step of dual ascent on the loss -p (episode_cost - cost_limit)."""
        self.raw.grad = torch.tensor(cost_limit - episode_cost, dtype=torch.float64)
        self.optimizer.step()

    def state_dict(self) -> dict[str, Any]:
        state = {"raw": self.raw.detach(), "optimizer": self.optimizer.state_dict()}
        return copy.deepcopy(state)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        with torch.no_grad():
            self.raw.copy_(state["raw"])
        self.optimizer.load_state_dict(state["optimizer"])
