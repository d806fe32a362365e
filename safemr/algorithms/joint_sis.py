"""JointSIS: joint synthesis of safe policy and energy function, without regard to efficiency.

Ma et al., "Joint synthesis of safety certificate and safe control policy using constrained
reinforcement learning" (L4DC 2022): feasible actor-critic plus a descent step on the energy's
parameters zeta = [sigma, k, n].

| equation of the paper | function |
|---|---|
| Lagrangian's dependence on zeta (SL2) | `certificate_loss` |
| projection of zeta to a box | `Agent.move_certificate` |

Deviations. The same constraint function max(g, constraint_floor) as in critic and multiplier also
enters here (``certificate_constraint = "floored"``), since all three belong to one Lagrangian; the
literal Eq. SL2 is ``"literal"``, and the loss of the authors' released code, E[max(g, 0)] without
the multiplier, is ``"released"``. Plain gradient steps instead of Adam: Adam moves every parameter
at one speed and so hides what the loss says. zeta's total travel is what `certificate_travel`
allows it to be: see docs/tuning.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from safemr.algorithms import fac
from safemr.certificates import families
from safemr.learning.losses import Info
from safemr.learning.replay import Batch

VERSION = 1
ROLE, LEARNS = "ablation", "zeta"
CERTIFICATE = "energy"


@dataclass(frozen=True)
class Config(fac.Config):
    """FAC's hyperparameters and those of the certificate; sigma, k, n are zeta's start."""

    # g in the certificate's loss: max(g, constraint_floor), the paper's g, or the released code's
    # max(g, 0) without lambda
    certificate_constraint: Literal["floored", "literal", "released"] = "floored"
    certificate_delay: int = 16  # m_phi: gradient steps for one of zeta
    # sum over the run of zeta's learning rates (they fall linearly to 0), so that budgets of
    # different length move zeta equally far; equal for JointSIS and SafeMR
    certificate_travel: float = 0.33
    certificate_start: float = 0.05  # share of training before zeta moves
    sigma_min: float = 0.05  # box of zeta: least sigma, which keeps a margin beyond contact
    sigma_max: float = 1.0  # box of zeta: largest sigma
    k_min: float = 0.1  # box of zeta: least k
    k_max: float = 3.0  # box of zeta: largest k
    n_min: float = 0.1  # box of zeta: least n
    n_max: float = 4.0  # box of zeta: largest n

    RANGES: ClassVar[Mapping[str, str]] = {
        "certificate_delay": "[1, inf)",
        "certificate_travel": "[0, 1e6]",
        "certificate_start": "[0, 1)",
        **dict.fromkeys(("sigma_min", "sigma_max", "n_min", "n_max"), "[0, 10]"),
        **dict.fromkeys(("k_min", "k_max"), "[0, 100]"),
    }
    CHOICES: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "certificate_constraint": ("floored", "literal", "released"),
    }

    PAPERS: ClassVar[tuple[str, ...]] = (
        *fac.Config.PAPERS,
        *(f"{name}_{end}" for end in ("min", "max") for name in fac.Config.PAPERS),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        names, papers = self.energy_family.names, self.energy_family is families.PAPER
        for name, value, low, high in zip(names, self.first_zeta, *self.box, strict=True):
            field, remedy = name, f"must lie in [{low}, {high}]"
            if not papers:
                field, remedy = "start", f"{name} {remedy}"
            self.require(field, low <= value <= high, remedy)

    @property
    def box(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Least and largest value of each of the family's parameters."""
        if self.energy_family is families.PAPER:
            return (
                (self.sigma_min, self.k_min, self.n_min),
                (self.sigma_max, self.k_max, self.n_max),
            )
        parameters = self.energy_family.parameters
        return tuple(each.low for each in parameters), tuple(each.high for each in parameters)

    def delays(self) -> tuple[str, ...]:
        return (*super().delays(), "certificate_delay")


def certificate_loss(
    batch: Batch, multipliers: Tensor, zeta: Tensor, d_min: float, config: Config
) -> Tensor:
    """E[lambda(s) (phi(s') - max(phi(s) - eta_D, 0))] as a function of zeta (Eq. SL2).

    ``floored`` and ``released`` replace g by max(g, floor) and lambda g by max(g, 0).
    """
    if config.certificate_constraint == "released":
        return fac.constraint_values(
            batch, zeta, d_min, replace(config, constraint_floor=0.0)
        ).mean()
    if config.certificate_constraint == "literal":
        config = replace(config, constraint_floor=-torch.inf)
    return (multipliers * fac.constraint_values(batch, zeta, d_min, config)).mean()


def travelled(config: Config, updates: float, total_updates: int) -> float:
    """Sum of zeta's learning rates over the first ``updates`` of ``total_updates`` gradient steps:
    how far a gradient of 1 would have moved it. `certificate_travel` at the end of the run."""
    first = int(config.certificate_start * total_updates)
    share = min(max((updates - first) / (total_updates - first), 0.0), 1.0)
    return config.certificate_travel * (1.0 - (1.0 - share) ** 2)


class Agent(fac.Agent):
    """Feasible actor-critic whose zeta descends `certificate_loss`."""

    config: Config

    def __init__(self, config: Config, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self._low, self._high = torch.tensor(config.box, device=config.device)
        first = int(config.certificate_start * self.total_updates)
        moves = max((self.total_updates - first) // config.certificate_delay, 1)
        self._first_update = first
        # A rate falling linearly from r to 0 sums to r * moves / 2.
        self._rate = 2.0 * config.certificate_travel / moves

    def certificate_loss(self, batch: Batch, zeta: Tensor, multipliers: Tensor) -> Tensor:
        return certificate_loss(batch, multipliers, zeta, self.d_min, self.config)

    def admitted(self, proposed: Tensor) -> Tensor:
        """What zeta becomes where a step proposes a value in the box; here that value."""
        return proposed

    def update_certificate(self, batch: Batch) -> Info:
        """A projected gradient step on zeta every m_phi updates (Algorithm 1, last line)."""
        found = self.certificate_gradient(batch)
        if found is None:
            return {}
        gradient, info = found
        self.move_certificate(gradient)
        return info

    def certificate_gradient(self, batch: Batch) -> tuple[Tensor, Info] | None:
        """That of `certificate_loss` in zeta, with what is logged of it."""
        if self.updates <= self._first_update or self.updates % self.config.certificate_delay:
            return None
        with torch.no_grad():
            multipliers = self.multipliers(batch.observations)
        zeta = self.zeta.clone().requires_grad_(True)
        loss = self.certificate_loss(batch, zeta, multipliers)
        (gradient,) = torch.autograd.grad(loss, [zeta])
        names = self.config.energy_family.names
        return gradient, {
            "certificate_loss": loss.detach(),
            "certificate_grad_norm": gradient.norm(),
            **{f"certificate_grad_{name}": g for name, g in zip(names, gradient, strict=True)},
        }

    def move_certificate(self, gradient: Tensor) -> None:
        left = (self.total_updates - self.updates) / (self.total_updates - self._first_update)
        moved = self.zeta.clone().sub_(gradient, alpha=self._rate * max(left, 0.0))
        self.zeta.copy_(self.admitted(torch.clamp(moved, self._low, self._high)))


class Trainer(fac.Trainer):
    agent_type = Agent
