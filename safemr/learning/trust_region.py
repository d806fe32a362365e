"""What the trust-region methods share: conjugate gradient, Fisher products, the line search.

TRPO is Schulman et al. (arXiv:1502.05477), appendix C. At the old policy the Hessian of the mean
KL divergence is J^T M J, where J is the Jacobian of the distribution's parameters and M the Fisher
matrix of a Gaussian in them: first derivatives of the divergence vanish there, so the Gauss-Newton
form is exact and no second derivative of the network is needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from safemr.learning.gaussian import GaussianActor, ratio_and_kl
from safemr.learning.rollouts import Batch

Product = Callable[[Tensor], Tensor]
Loss = Callable[[Any, Any], Any]  # linear in the two surrogates E[r A] and E[r A_cost]


@dataclass(frozen=True)
class TrustRegionConfig:
    """The trust region's part of an algorithm's hyperparameters; its radius is ``target_kl``."""

    damping: float = 0.1  # added to the diagonal of the Fisher matrix
    conjugate_gradient_iterations: int = 10  # for a product with the inverse Fisher matrix
    backtrack_factor: float = 0.8  # by which the line search shortens a refused step
    backtrack_iterations: int = 10  # trials of the line search

    RANGES: ClassVar[Mapping[str, str]] = {
        "damping": "[0, 1000]",
        **dict.fromkeys(("conjugate_gradient_iterations", "backtrack_iterations"), "[1, 1000]"),
        "backtrack_factor": "(0, 1)",
    }


def dot(a: Tensor, b: Tensor) -> float:
    """Inner product accumulated in double precision."""
    return float(torch.dot(a.double(), b.double()))


def fisher_vector_product(actor: GaussianActor, observations: Tensor, damping: float) -> Product:
    """v -> (H + damping I) v, H the Hessian of E_s[KL(pi_old || pi)] at pi_old = ``actor``.

    observations [B, D]; v [P] in the order of `GaussianActor.flat`. M is diag(1 / std^2) / B in the
    mean actions and 2 I in the log standard deviations. The actor must not change while the result
    is in use.
    """
    mean = actor.mean(observations)
    weight = torch.exp(-2.0 * actor.log_std.detach()) / len(observations)
    network, log_std = actor.parameters

    def product(v: Tensor) -> Tensor:
        tangent, log_std_tangent = v.split([network.numel(), log_std.numel()])
        moved = actor.network.jvp(observations, tangent)[0] * weight
        # Not of `mean` along `moved`, which is the same: for that PyTorch imports sympy.
        along = (mean * moved).sum()
        (pulled,) = torch.autograd.grad(along, network, retain_graph=True)
        return torch.cat([pulled, 2.0 * log_std_tangent]).add_(v, alpha=damping)

    return product


class Region(Protocol):
    """The surrogates of a batch and their derivatives at the actor that took it."""

    old: tuple[Any, Any]  # E[r A], E[r A_cost] before the actor is moved

    def surrogates(self) -> tuple[Any, Any, Any]:
        """E[r A], E[r A_cost] and E_s[KL(pi_old || pi)] of the actor as it is now."""

    def gradient(self, loss: Loss) -> Tensor:
        """That of a loss, [P]; to be asked for before the actor is moved."""

    def product(self, damping: float) -> Product:
        """`fisher_vector_product`; to be used before the actor is moved."""


class TorchRegion:
    """`Region` by differentiable operations, the definition."""

    def __init__(self, actor: GaussianActor, batch: Batch) -> None:
        self.actor, self.batch = actor, batch
        self._graph = self._evaluate()[:2]
        self.old = (self._graph[0].detach(), self._graph[1].detach())

    def _evaluate(self) -> tuple[Tensor, Tensor, Tensor]:
        batch = self.batch
        ratio, kl = ratio_and_kl(self.actor, batch)
        return (ratio * batch.advantages).mean(), (ratio * batch.cost_advantages).mean(), kl

    @torch.no_grad()
    def surrogates(self) -> tuple[Tensor, Tensor, Tensor]:
        return self._evaluate()

    def gradient(self, loss: Loss) -> Tensor:
        return self.actor.gradient(loss(*self._graph), retain_graph=True)

    def product(self, damping: float) -> Product:
        return fisher_vector_product(self.actor, self.batch.observations, damping)


def conjugate_gradient(
    product: Product, b: Tensor, iterations: int, tolerance: float = 1e-10
) -> Tensor:
    """x with A x = b for a symmetric positive definite A given as ``product``; b [P] -> [P].

    Stops early once |A x - b|^2 <= tolerance |b|^2; returns 0 for b = 0.
    """
    x = torch.zeros_like(b)
    residual, direction = b.clone(), b.clone()
    squared = dot(residual, residual)
    enough = tolerance * squared
    for _ in range(iterations):
        if squared <= enough:
            break
        image = product(direction)
        rate = squared / dot(direction, image)
        x.add_(direction, alpha=rate)
        residual.sub_(image, alpha=rate)
        previous, squared = squared, dot(residual, residual)
        direction.mul_(squared / previous).add_(residual)
    return x


def natural_step(product: Product, gradient: Tensor, radius: float, iterations: int) -> Tensor:
    """argmin_x g.x subject to x.Hx / 2 <= radius: -sqrt(2 radius / v.Hv) v with v = H^-1 g.

    g is the gradient [P], H is given as ``product``; the step is 0 where the gradient is 0.
    """
    direction = conjugate_gradient(product, gradient, iterations)
    curvature = dot(direction, product(direction))
    return direction * (-math.sqrt(2.0 * radius / curvature) if curvature > 0 else 0.0)


def line_search(
    actor: GaussianActor,
    step: Tensor,
    accept: Callable[[], bool],
    config: TrustRegionConfig,
) -> dict[str, float]:
    """Adds factor^j step to the actor's parameters, j = 0, 1, ..., until ``accept()`` holds.

    When no trial is accepted the actor is where it was. Returns the metrics ``line_search_steps``
    (trials made) and ``step_fraction`` (0 when none was accepted).
    """
    start = actor.flat()
    for trial in range(config.backtrack_iterations):
        fraction = config.backtrack_factor**trial
        actor.load_flat(start + fraction * step)
        if accept():
            return {"line_search_steps": trial + 1.0, "step_fraction": fraction}
    actor.load_flat(start)
    return {"line_search_steps": float(config.backtrack_iterations), "step_fraction": 0.0}
