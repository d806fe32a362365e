"""TRPO-Lagrangian: trust region policy optimisation with a learned penalty on the cost.

Ray, Achiam & Amodei, "Benchmarking safe exploration in deep reinforcement learning" (2019), on top
of Schulman et al., "Trust region policy optimization" (arXiv:1502.05477).

| equation | function |
|---|---|
| surrogate E[r A], bound on the mean KL (TRPO, eq. 14) | `policy_loss`, `Trainer.update_policy` |
| natural gradient step, line search (appendix C) | `trust_region.natural_step`, `line_search` |
| (surrogate - lambda cost surrogate) / (1 + lambda) (Ray et al.) | `lagrange.penalised` |
| dual ascent on lambda (EpCost - cost_limit) | `lagrange.Multiplier` |
| advantages and returns (GAE, eq. 16) | `rollouts.gae` |

Differences from the papers and from safety-starter-agents: those of `ppo_lagrangian` as far as
they concern critics, networks and time limits; Fisher products in Gauss-Newton form, exact here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from safemr.learning import on_policy
from safemr.learning.contract import MakeEnvs
from safemr.learning.lagrange import Multiplier, MultiplierConfig, penalised
from safemr.learning.on_policy import OnPolicyConfig, OnPolicyTrainer
from safemr.learning.rollouts import Batch
from safemr.learning.trust_region import TrustRegionConfig, line_search, natural_step

VERSION = 1

PUBLISHED = on_policy.PUBLISHED


@dataclass(frozen=True)
class Config(TrustRegionConfig, MultiplierConfig, OnPolicyConfig):
    """Hyperparameters: those of the three parents."""


def policy_loss(reward: Any, cost: Any, multiplier: float) -> Any:
    """-(E[r A] - lambda E[r A_cost]) / (1 + lambda), linear in both surrogates."""
    return -penalised(reward, cost, multiplier)


class Trainer(OnPolicyTrainer):
    """`OnPolicyTrainer` with one natural-gradient step on `policy_loss` an epoch."""

    config: Config

    def __init__(self, config: Config, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        super().__init__(config, make_envs, seed, total_steps)
        self.multiplier = Multiplier(config)

    def update_policy(self, batch: Batch) -> dict[str, float]:
        config = self.config
        self.multiplier.update(batch.episode_cost, config.cost_limit)
        multiplier = self.multiplier.value
        region = self.region(batch)

        def loss(reward: Any, cost: Any) -> Any:
            return policy_loss(reward, cost, multiplier)

        before = float(loss(*region.old))
        gradient, product = region.gradient(loss), region.product(config.damping)
        step = natural_step(
            product, gradient, config.target_kl, config.conjugate_gradient_iterations
        )

        def accept() -> bool:
            reward, cost, kl = region.surrogates()
            return float(loss(reward, cost)) <= before and float(kl) <= config.target_kl

        search = line_search(self.actor, step, accept, config)
        return {
            **search,
            "multiplier": multiplier,
            "policy_loss": before,
            "policy_grad_norm": float(gradient.norm()),
        }

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "multiplier": self.multiplier.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        self.multiplier.load_state_dict(state["multiplier"])
