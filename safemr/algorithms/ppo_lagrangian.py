"""PPO-Lagrangian: proximal policy optimisation with a learned penalty on the cost.

Ray, Achiam & Amodei, "Benchmarking safe exploration in deep reinforcement learning" (2019), on top
of Schulman et al., "Proximal policy optimization algorithms" (arXiv:1707.06347).

| equation | function |
|---|---|
| L^CLIP (PPO, eq. 7) | `clipped_surrogate` |
| (surrogate - lambda cost surrogate) / (1 + lambda) (Ray et al.) | `lagrange.penalised` |
| dual ascent on lambda (EpCost - cost_limit) | `lagrange.Multiplier` |
| advantages and returns (GAE, eq. 16) | `rollouts.gae` |

Differences from the papers and from safety-starter-agents: minibatches instead of full-batch
passes (``PUBLISHED`` restores them), orthogonal initialisation with a last policy layer of gain
0.01, fixed observation scaling, the early stop is checked on each minibatch before its step, and
values are bootstrapped from the final observation of every truncated episode. The divergence is
KL(pi_old || pi), in closed form.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from safemr.learning import on_policy
from safemr.learning.adam import Adam
from safemr.learning.contract import MakeEnvs
from safemr.learning.gaussian import ratio_and_kl
from safemr.learning.lagrange import Multiplier, MultiplierConfig, penalised
from safemr.learning.on_policy import OnPolicyConfig, OnPolicyTrainer
from safemr.learning.rollouts import Batch, minibatches

VERSION = 1

PUBLISHED: dict[str, Any] = {
    **on_policy.PUBLISHED,
    "policy_passes": 80,
    "policy_batch": 8_000,
}


@dataclass(frozen=True)
class Config(MultiplierConfig, OnPolicyConfig):
    """Hyperparameters; `OnPolicyConfig` and `MultiplierConfig` have the shared ones."""

    clip: float = 0.2  # epsilon of the clipped objective
    policy_lr: float = 3e-4  # learning rate of the policy
    policy_passes: int = 10  # at most, over the epoch's data
    policy_batch: int = 500  # samples a policy step; at most the whole epoch
    kl_stop: float = 1.2  # stop the passes where KL > kl_stop * target_kl

    RANGES: ClassVar[Mapping[str, str]] = {
        "clip": "(0, 1)",
        "policy_lr": "(0, 1]",
        **dict.fromkeys(("policy_passes", "policy_batch"), "[1, inf)"),
        "kl_stop": "(0, 100]",
    }


def clipped_surrogate(ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """L^CLIP = E[min(r A, clip(r, 1 - eps, 1 + eps) A)] (PPO, eq. 7); ratio, advantages [B]."""
    clipped = ratio.clamp(1.0 - clip, 1.0 + clip)
    return torch.minimum(ratio * advantages, clipped * advantages).mean()


def policy_loss(ratio: Tensor, batch: Batch, clip: float, multiplier: float) -> Tensor:
    """-(L^CLIP - lambda E[r A_cost]) / (1 + lambda): the cost surrogate is not clipped."""
    reward = clipped_surrogate(ratio, batch.advantages, clip)
    return -penalised(reward, (ratio * batch.cost_advantages).mean(), multiplier)


class Trainer(OnPolicyTrainer):
    """`OnPolicyTrainer` with minibatch steps on `policy_loss` and an early stop."""

    config: Config

    def __init__(self, config: Config, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        super().__init__(config, make_envs, seed, total_steps)
        self.multiplier = Multiplier(config)
        self.policy_optimizer = Adam(self.actor.parameters, config.policy_lr)

    def update_policy(self, batch: Batch) -> dict[str, float]:
        self.multiplier.update(batch.episode_cost, self.config.cost_limit)
        multiplier = self.multiplier.value
        losses, clipped = self._passes(batch, multiplier)
        steps_a_pass = max(1, round(len(batch.actions) / self.config.policy_batch))
        return {
            "multiplier": multiplier,
            "policy_loss": float(torch.stack(losses).mean()) if losses else 0.0,
            "policy_passes": len(losses) / steps_a_pass,
            "clip_share": float(torch.stack(clipped).mean()) if clipped else 0.0,
        }

    def _passes(self, batch: Batch, multiplier: float) -> tuple[list[Tensor], list[Tensor]]:
        """Steps until the KL bound or the last pass; the loss and clipped share of each step."""
        config = self.config
        losses: list[Tensor] = []
        clipped: list[Tensor] = []
        for _ in range(config.policy_passes):
            for indices in minibatches(len(batch.actions), config.policy_batch, self.order):
                step = self._step(batch, indices, multiplier)
                if step is None:
                    return losses, clipped
                losses.append(step[0])
                clipped.append(step[1])
        return losses, clipped

    def _step(
        self, batch: Batch, indices: Tensor | slice, multiplier: float
    ) -> tuple[Tensor, Tensor] | None:
        """One step on a minibatch; loss and clipped share, or None where KL is above its bound."""
        config, optimizer = self.config, self.policy_optimizer
        bound = config.kl_stop * config.target_kl
        if self.fused:
            settings = (config.clip, multiplier, bound)
            return self.fused.clipped_step(batch, indices, optimizer, *settings)
        part = batch.select(indices)
        ratio, kl = ratio_and_kl(self.actor, part)
        if float(kl.detach()) > bound:
            return None
        loss = policy_loss(ratio, part, config.clip, multiplier)
        gradients = torch.autograd.grad(loss, self.actor.parameters)
        for parameter, gradient in zip(self.actor.parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()
        return loss.detach(), ((ratio.detach() - 1.0).abs() > config.clip).float().mean()

    def state_dict(self) -> dict[str, Any]:
        return {
            **super().state_dict(),
            "multiplier": self.multiplier.state_dict(),
            "policy_optimizer": copy.deepcopy(self.policy_optimizer.state_dict()),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.multiplier.load_state_dict(state["multiplier"])
        self.policy_optimizer.load_state_dict(state["policy_optimizer"])
