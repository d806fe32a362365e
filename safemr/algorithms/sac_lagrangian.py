"""SAC-Lagrangian: soft actor-critic with one multiplier on the expected discounted cost.

Ha et al., "Learning to walk in the real world with minimal human effort" (arXiv:2002.08550), on top
of Haarnoja et al., "Soft actor-critic algorithms and applications" (arXiv:1812.05905).
It says what the constraint of `safemr.learning.soft_actor_critic` is, and is the example of how to
add a baseline: this file and a line in the configuration are all of it.

| equation | function |
|---|---|
| Q_c(s, a) = E[sum_t gamma^t (c_t - cost_rate_limit)] (bootstrapped, off-policy) | `cost_target` |
| policy loss E[alpha log pi - min_j Q_j + lambda Q_c] | `losses.policy_loss` |
| dual ascent on lambda E[Q_c(s, pi(s))] | `Agent.multiplier_inputs`, `losses.multiplier_loss` |

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

from safemr.learning import off_policy
from safemr.learning.losses import REWARD_CRITICS
from safemr.learning.networks import StackedMLP
from safemr.learning.replay import Batch
from safemr.learning.soft_actor_critic import SoftActorCritic, SoftActorCriticConfig

VERSION = 1


@dataclass(frozen=True)
class Config(SoftActorCriticConfig):
    """Soft actor-critic's hyperparameters and the limit."""

    cost_rate_limit: float = 0.0  # tolerated cost a decision
    n_step: int = 1  # the memory forms n-step sums of rewards only

    RANGES: ClassVar[Mapping[str, str]] = {"cost_rate_limit": "[0, 100]"}

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("n_step", self.n_step == 1, "sac_lagrangian needs 1")


def cost_target(costs: Tensor, discounts: Tensor, next_values: Tensor, rate_limit: float) -> Tensor:
    """y_c = c - cost_rate_limit + gamma Q_c(s', a'), [B]; ``discounts`` is 0 at a termination."""
    return torch.addcmul(costs - rate_limit, discounts, next_values)


class Agent(SoftActorCritic):
    """Soft actor-critic with a bootstrapped cost critic and a multiplier that sees no state."""

    config: Config
    targets_follow = REWARD_CRITICS + 1  # the cost critic bootstraps, too

    def __init__(self, config: Config, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
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
        (*rewards, cost), log_density = self.backend.next_values(batch.bootstraps, noise)
        soft = self.soft_target(batch, torch.stack(rewards), log_density)
        scale = self.config.constraint_scale
        limit = self.config.cost_rate_limit
        cost = scale * cost_target(batch.costs, batch.discounts, cost / scale, limit)
        return torch.stack((soft,) * REWARD_CRITICS + (cost,))


class Trainer(off_policy.Trainer):
    """The off-policy loop around this file's `Agent`."""

    agent_type: ClassVar[Any] = Agent
