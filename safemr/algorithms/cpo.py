"""Constrained policy optimisation (CPO).

Achiam, Held, Tamar & Abbeel, "Constrained policy optimization" (arXiv:1705.10528). An epoch solves

    min_x g.x   subject to   c + b.x <= 0   and   x.Hx / 2 <= delta,

g the gradient of -E[r A], b that of the predicted change of an episode's cost, L E[r A_cost] with L
the episode's length in decisions, c = EpCost - cost_limit, H the Fisher matrix, delta = target_kl.

| equation | function |
|---|---|
| the problem above (CPO, eq. 11) | `Trainer.update_policy` |
| its dual and the feasible cases (eq. 12, theorem 2) | `solve_dual` |
| recovery when nothing is feasible (eq. 14) | `solve_dual`, case 0 |
| backtracking (section 6.1) | `trust_region.line_search`, `Trainer._accepts` |
| advantages and returns (GAE, eq. 16) | `rollouts.gae` |

Differences from the paper: the cost is an episode's undiscounted sum, as the limit is, so b is
scaled by its length rather than by 1 / (1 - gamma); no shaping of the cost. From
safety-starter-agents: the dual is solved geometrically (`solve_dual`), which gives c = 0 a value
instead of r / c; c = 0 counts as feasible (case 2, not the recovery of case 1); and
``cost_tolerance`` keeps a policy that has reached c = 0 able to learn. The other differences are
those of `trpo_lagrangian`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from safemr.learning import on_policy
from safemr.learning.on_policy import OnPolicyConfig, OnPolicyTrainer
from safemr.learning.rollouts import Batch
from safemr.learning.trust_region import (
    Region,
    TrustRegionConfig,
    conjugate_gradient,
    dot,
    line_search,
)

VERSION = 1

PUBLISHED: dict[str, Any] = {**on_policy.PUBLISHED, "cost_tolerance": 0.0}


@dataclass(frozen=True)
class Config(TrustRegionConfig, OnPolicyConfig):
    """Hyperparameters; the two parents have the shared ones."""

    # predicted changes of an episode's cost below this count as none: a trust region that promises
    # no more has no cost gradient (case 4), and the line search forgives as much. With 0 (as
    # published) an epoch without violations can end learning: c = 0 makes a plane of whatever noise
    # is left in the cost critic, and the surrogate's curvature refuses every step along that plane
    cost_tolerance: float = 0.01

    RANGES: ClassVar[Mapping[str, str]] = {"cost_tolerance": "[0, inf)"}


@dataclass(frozen=True)
class Dual:
    """Solution of the linear-quadratic problem: x = -(along_reward v + along_cost w).

    v = H^-1 g, w = H^-1 b. ``case`` is 4 (no cost gradient, feasible: plain TRPO step), 3 (the
    whole trust region is feasible), 2 (the current policy is feasible, part of the region is), 1
    (it is not, part of the region is) or 0 (nothing is: the step of largest predicted decrease of
    the cost, none without a cost gradient). ``reach`` is the largest change of the cost that the
    region allows. The multipliers of the KL bound and of the cost are None in case 0: no dual.
    """

    case: int
    reach: float
    along_reward: float
    along_cost: float
    kl_multiplier: float | None
    cost_multiplier: float | None


def solve_dual(
    q: float, r: float, s: float, c: float, delta: float, tolerance: float = 0.0
) -> Dual:
    """The step of CPO from q = g.H^-1 g, r = g.H^-1 b, s = b.H^-1 b (eq. 12 and theorem 2).

    If the TRPO step satisfies the linearised cost, it is optimal. Otherwise the optimum lies on the
    plane c + b.x = 0, at the point of it that is nearest to 0, -(c / s) w, plus the step of
    length sqrt(2 delta - c^2 / s) along the part of -v within the plane, whose squared length is
    A = q - r^2 / s. No case divides by c. All lengths are in the norm of H; delta > 0. A cost
    gradient with a reach of at most ``tolerance`` counts as zero.
    """
    trpo = math.sqrt(2.0 * delta / q) if q > 0.0 else 0.0
    trpo_multiplier = math.sqrt(max(q, 0.0) / (2.0 * delta))
    reach = math.sqrt(2.0 * delta * max(s, 0.0))
    if reach <= tolerance:
        if c <= 0.0:
            return Dual(4, reach, trpo, 0.0, trpo_multiplier, 0.0)
        return Dual(0, reach, 0.0, 0.0, None, None)
    if c > reach:
        return Dual(0, reach, 0.0, math.sqrt(2.0 * delta / s), None, None)
    case = 3 if c < -reach else 2 if c <= 0.0 else 1
    if c - trpo * r <= 0.0:
        return Dual(case, reach, trpo, 0.0, trpo_multiplier, 0.0)
    remaining = max(2.0 * delta - c * c / s, 0.0)
    in_plane = max(q - r * r / s, 0.0)
    # g parallel to b: every point of the plane is as good, the nearest one is taken
    along_reward = math.sqrt(remaining / in_plane) if in_plane > 1e-12 * q else 0.0
    along_cost = (c - along_reward * r) / s
    if remaining == 0.0:
        return Dual(case, reach, along_reward, along_cost, math.inf, math.inf)
    kl_multiplier = math.sqrt(in_plane / remaining)
    return Dual(case, reach, along_reward, along_cost, kl_multiplier, (kl_multiplier * c - r) / s)


class Trainer(OnPolicyTrainer):
    """`OnPolicyTrainer` with one constrained trust-region step an epoch."""

    config: Config

    def update_policy(self, batch: Batch) -> dict[str, float]:
        config = self.config
        c = batch.episode_cost - config.cost_limit
        region, length = self.region(batch), batch.episode_decisions
        before = (float(-region.old[0]), float(length * region.old[1]))
        g = region.gradient(lambda reward, _: -reward)
        b = region.gradient(lambda _, cost: length * cost)
        product = region.product(config.damping)
        v = conjugate_gradient(product, g, config.conjugate_gradient_iterations)
        w = conjugate_gradient(product, b, config.conjugate_gradient_iterations)
        image_v, image_w = product(v), product(w)
        products = (dot(v, image_v), dot(w, image_v), dot(w, image_w))
        dual = solve_dual(*products, c, config.target_kl, config.cost_tolerance)
        allowed = max(-c, 0.0) + config.cost_tolerance

        def accept() -> bool:
            return self._accepts(region, length, dual.case, allowed, before)

        step = -(dual.along_reward * v + dual.along_cost * w)
        metrics = line_search(self.actor, step, accept, config)
        metrics |= {f"cpo_case_{case}": float(case == dual.case) for case in range(5)}
        metrics |= {
            "infeasible_share": float(dual.case == 0),
            "cost_reach": dual.reach,
            "policy_loss": before[0],
            "policy_grad_norm": float(g.norm()),
            "cost_grad_norm": float(b.norm()),
        }
        for name in ("kl_multiplier", "cost_multiplier"):
            value = getattr(dual, name)
            if value is not None and math.isfinite(value):
                metrics[name] = value
        return metrics

    def _accepts(
        self,
        region: Region,
        length: float,
        case: int,
        allowed: float,
        before: tuple[float, float],
    ) -> bool:
        """Whether the moved actor obeys the KL bound, and the surrogates what the case asks.

        The predicted cost of an episode of ``length`` decisions may rise by ``allowed`` at most;
        the reward must not fall unless the case is a recovery (0, 1). ``before`` holds the loss and
        the cost at the old policy.
        """
        reward, cost_a_decision, kl = region.surrogates()
        loss, cost = -float(reward), length * float(cost_a_decision)
        return (
            float(kl) <= self.config.target_kl
            and (case <= 1 or loss <= before[0])
            and cost - before[1] <= allowed
        )
