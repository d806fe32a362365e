"""SAC-Lagrangian: soft actor-critic with one multiplier on the expected discounted cost.

Ha et al., "Learning to walk in the real world with minimal human effort" (arXiv:2002.08550), on top
of Haarnoja et al., "Soft actor-critic algorithms and applications" (arXiv:1812.05905).
It is `fac` with two parts exchanged, and the example of how to add a baseline: this file and a line
in the configuration are all of it.

| equation | function |
|---|---|
| Q_c(s, a) = E[sum_t gamma^t (c_t - cost_rate_limit)] (bootstrapped, off-policy) | `cost_target` |
| policy loss E[alpha log pi - min_j Q_j + lambda Q_c] | `fac.policy_loss` |
| dual ascent on lambda E[Q_c(s, pi(s))] | `Agent.multiplier_inputs`, `fac.multiplier_loss` |

Q_c is learned by one-step temporal differences: `Batch.costs` holds the cost of a transition's
first step, which belongs to `Batch.discounts` and `Batch.bootstraps` only where these are one step
ahead, too. Hence n_step = 1, and any other value is refused. Q_c has a target network, no entropy
term, and is bootstrapped through truncation but not through termination.

Differences from the paper: the discounted cost of the current policy is taken at states of the
replay memory instead of starting states, as usual off-policy; the constraint critic is not doubled.
The limit is a rate (cost a step), so that it needs no conversion between episode and discount.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from safemr.algorithms import fac
from safemr.learning.networks import StackedMLP
from safemr.learning.replay import Batch

VERSION = 1

# What FAC's configuration says about its energy function: there is none here.
ENERGY_FIELDS = ("sigma", "k", "n", "eta", "length_scale", "constraint_floor")


@dataclass(frozen=True)
class Config(fac.Config):
    """FAC's hyperparameters, of which the energy's are not used."""

    cost_rate_limit: float = 0.0  # tolerated cost a step
    n_step: int = 1  # the memory forms n-step sums of rewards only
    constraint_scale: float = 1.0  # a discounted cost is of the size of a discounted reward
    multiplier_bias: float = 0.0  # softplus(0) = 0.69: felt from the start, as in PPO-Lagrangian

    RANGES: ClassVar[Mapping[str, str]] = {"cost_rate_limit": "[0, 100]"}
    UNUSED: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ENERGY_FIELDS, "there is no energy function"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("n_step", self.n_step == 1, "sac_lagrangian needs 1")


def cost_target(costs: Tensor, discounts: Tensor, next_values: Tensor, rate_limit: float) -> Tensor:
    """y_c = c - cost_rate_limit + gamma Q_c(s', a'), [B]; ``discounts`` is 0 at a termination."""
    return torch.addcmul(costs - rate_limit, discounts, next_values)


class Agent(fac.Agent):
    """`fac.Agent` with a bootstrapped cost critic and a multiplier that sees no state."""

    config: Config

    def __init__(self, config: Config, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.targets = self.critics.copy()  # with the cost critic, which FAC need not follow
        # A perceptron without inputs is a scalar: its bias.
        self.multiplier = StackedMLP(
            1, (0, 1), output_bias=config.multiplier_bias, device=config.device
        )
        self.optimisers["multiplier"] = self.adam(self.multiplier.parameters, config.multiplier_lr)

    def multiplier_inputs(self, observations: Tensor) -> Tensor:
        """Nothing: the same lambda for every state."""
        return observations[:, :0]

    @torch.no_grad()
    def critic_targets(self, batch: Batch) -> Tensor:
        """Twice the soft return, then the discounted cost, [3, B]."""
        noise = self.noise(len(batch.returns))
        (*rewards, cost), log_density = self.steps.next_values(batch.bootstraps, noise)
        temperature = self.log_temperature.exp()
        soft = fac.reward_target(
            batch.returns, batch.discounts, torch.stack(rewards), log_density, temperature
        )
        scale = self.config.constraint_scale
        limit = self.config.cost_rate_limit
        cost = scale * cost_target(batch.costs, batch.discounts, cost / scale, limit)
        return torch.stack((soft,) * fac.REWARD_CRITICS + (cost,))

    def metrics(self) -> dict[str, float]:
        energy = ("sigma", "k", "n")
        return {name: value for name, value in super().metrics().items() if name not in energy}

    def extras(self) -> dict[str, Any]:
        return {name: value for name, value in super().extras().items() if name != "zeta"}


class Trainer(fac.Trainer):
    """The off-policy loop around this file's `Agent`."""

    agent_type = Agent
