"""Feasible actor-critic (FAC): soft actor-critic with a state-wise energy constraint.

Ma et al., "Feasible actor-critic: constrained reinforcement learning for ensuring statewise
safety" (2021), as used by the SafeMR paper with a fixed energy function: phi_0 = d_min - d is
zeta = [0, 0, 1] and phi_h = (0.3 + d_min)^2 - d^2 - k d_dot is zeta = [0.3, k, 2]. JointSIS and
SafeMR extend this file by their certificate loss. Another family of energy functions than that of
[sigma, k, n] is asked for by ``family`` (`safemr.certificates.families`).

| equation of the paper | function |
|---|---|
| phi (sis), constraint g (cstr0) | `energy`, `constraint` of `safemr.certificates.energy` |
| Q_w regression (soft Bellman target) | `reward_target` of `safemr.learning.losses` |
| Q_phi regression on g | `constraint_values`, the third member of the critic stack |
| J_pi (losspi) | `policy_loss` of `safemr.learning.losses` |
| dual ascent on E[lambda(s) Q_phi(s, a)] | `multiplier_loss` of `safemr.learning.losses` |
| temperature (Haarnoja et al. 2018) | `temperature_loss` of `safemr.learning.losses` |
| delays m_pi < m_lambda < m_phi (Alg. 1) | `SoftActorCritic.update` |

This file adds the energy to `safemr.learning.soft_actor_critic`. The gradients of the losses are
taken by `safemr.learning.torch_steps` or, equal but faster, by `safemr.learning.numba_steps`.

Deviations from the paper and from the authors' released code, each a field of `Config`:
minimum of two critics (usual practice; Eq. losspi has one), n-step returns, the multiplier is
trained on the current policy's action instead of the replayed one, larger learning rates and
smaller networks for a budget two orders of magnitude smaller.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from safemr.certificates import energy, families
from safemr.errors import UserError
from safemr.learning import off_policy
from safemr.learning.losses import REWARD_CRITICS
from safemr.learning.policies import network_arrays
from safemr.learning.replay import Batch
from safemr.learning.soft_actor_critic import SoftActorCritic, SoftActorCriticConfig

VERSION = 1
ROLE = "handcrafted"
CERTIFICATE = "energy"


@dataclass(frozen=True)
class Config(SoftActorCriticConfig):
    """Soft actor-critic's hyperparameters and those of the energy function.

    Lengths in units of ``length_scale`` metres.
    """

    # Energy function

    sigma: float = 0.3  # of zeta = [sigma, k, n]: margin of phi beyond d_min; FAC keeps zeta
    k: float = 1.0  # of zeta: weight of the closing speed in phi
    n: float = 2.0  # of zeta: exponent of phi
    eta: float = 0.0  # eta_D; the point robot cannot sustain a descent of 0.1 a step
    length_scale: float = 1.0  # unit of length in phi [m]; 1 = the paper's
    family: str = "paper"  # of energy functions; another one by its module, PACKAGE.MODULE
    start: tuple[float, ...] = ()  # another family's parameters, in its order; empty: its own start
    family_version: int = 0  # of another family; 0: that of the installed one, which a record says

    # Constraint

    # floor of the one function max(g, constraint_floor) in critic, multiplier and certificate:
    # far from danger g is large and negative, and without a floor it outweighs the rare violations
    # in the shared multiplier network, and lambda dies
    constraint_floor: float = -0.001
    constraint_scale: float = 10.0  # Q_phi learns scale * g, so that its errors count beside Q_w's
    multiplier_bias: float = -3.0  # start of the last layer's bias
    record_critic: bool = False  # keep Q_phi in the policy file, as a model of the safety filter

    RANGES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("sigma", "n", "eta"), "[0, 10]"),
        "k": "[0, 100]",
        "length_scale": "[0.001, 1000]",
        "family_version": "[0, inf)",
        "constraint_floor": "[-inf, 0]",
    }
    ADDED: ClassVar[frozenset[str]] = frozenset(
        {"family", "start", "family_version", "record_critic"}
    )
    # What says the parameters of the paper's family, and no other's.
    PAPERS: ClassVar[tuple[str, ...]] = ("sigma", "k", "n")

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "start", tuple(map(float, self.start)))  # a record has a list
        family = families.named(self.family)
        object.__setattr__(self, "family", family.name)
        if family is families.PAPER:
            self.require("start", not self.start, "of another family; here set sigma, k and n")
            self.require("family_version", not self.family_version, "another family has one")
            return
        defaults = {field.name: field.default for field in fields(self)}
        for name in self.PAPERS:
            self.require(
                name,
                getattr(self, name) == defaults[name],
                f"is of the paper's family; the start of {family.name} is set by start, its box in "
                "its file",
            )
        self.require(
            "start",
            len(self.start) in (0, len(family.names)),
            f"must be {len(family.names)} numbers: {', '.join(family.names)}",
        )
        self.require(
            "family_version",
            self.family_version in (0, family.version),
            f"the installed {family.name} is version {family.version}; install the one that the "
            "record was made with, or resolve the configuration anew",
        )
        object.__setattr__(self, "family_version", family.version)

    @property
    def energy_family(self) -> families.EnergyFamily:
        """The family of energy functions."""
        return families.named(self.family)

    @property
    def first_zeta(self) -> tuple[float, ...]:
        """The parameters at the start, in the family's order."""
        if self.energy_family is families.PAPER:
            return self.sigma, self.k, self.n
        return self.start or tuple(each.start for each in self.energy_family.parameters)


def constraint_values(batch: Batch, zeta: Tensor, d_min: float, config: Config) -> Tensor:
    """max(g(s, a), constraint_floor) with the current zeta (Eq. cstr0), [B].

    No bootstrap: the constraint is about one step. Differentiable in zeta.
    """
    d = torch.stack((batch.d, batch.d_next))
    d_dot = torch.stack((batch.d_dot, batch.d_dot_next))
    lengths = energy.scaled(d, d_dot, d_min, config.length_scale)
    phi, phi_next = energy.largest(config.energy_family.phi(*lengths, *zeta.unbind()))
    return energy.constraint(phi, phi_next, config.eta).clamp_min(config.constraint_floor)


def _try_on_tensors(config: Config) -> None:
    """Raises UserError where another family's phi is no differentiable function of tensors."""
    family = config.energy_family
    zeta = torch.tensor(config.first_zeta, dtype=torch.float64, requires_grad=True)
    d, d_dot = torch.meshgrid(
        torch.linspace(0.5, 4.0, 5).double(), torch.linspace(-1.0, 1.0, 5).double(), indexing="ij"
    )
    try:
        phi = family.phi(d, d_dot, 0.5, *zeta.unbind())
        term = family.magnitude(0.5, *zeta.unbind(), 1.0, 1.0)
        (gradient,) = torch.autograd.grad(phi.sum() + term, [zeta])
    except (TypeError, AttributeError, RuntimeError, ValueError) as error:
        reason = str(error).partition("\n")[0]
        raise UserError(
            f"{family.name}: phi does not work on torch tensors: {type(error).__name__}: {reason}; "
            "write it with operators (+, *, **, <), as safemr.certificates.energy does"
        ) from error
    with_arrays = family.phi(d.numpy(), d_dot.numpy(), 0.5, *config.first_zeta)
    if not np.allclose(phi.detach().numpy(), with_arrays) or not bool(gradient.isfinite().all()):
        raise UserError(
            f"{family.name}: phi of torch tensors is not that of numpy arrays, or its gradient is "
            "not finite"
        )


class Agent(SoftActorCritic):
    """Soft actor-critic whose constraint is the change of an energy function of zeta.

    zeta are the parameters of the family, the paper's [sigma, k, n] where no other is asked for.
    JointSIS and SafeMR move zeta in `update_certificate`; `constraint_target` is what another
    energy function overrides.
    """

    config: Config

    def __init__(self, config: Config, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.zeta = torch.tensor(config.first_zeta, device=config.device)
        _try_on_tensors(config)

    def constraint_target(self, batch: Batch) -> Tensor:
        """What Q_phi regresses on, [B]; here max(g, floor), no bootstrap."""
        return constraint_values(batch, self.zeta, self.d_min, self.config)

    @torch.no_grad()
    def critic_targets(self, batch: Batch) -> Tensor:
        """Twice the soft return, then the constraint, [3, B]."""
        noise = self.noise(len(batch.returns))
        following, log_density = self.backend.next_values(batch.bootstraps, noise)
        soft = self.soft_target(batch, following, log_density)
        constraint = self.config.constraint_scale * self.constraint_target(batch)
        return torch.stack((soft,) * REWARD_CRITICS + (constraint,))

    def metrics(self) -> dict[str, float]:
        """zeta beside the base's."""
        names = self.config.energy_family.names
        return {**dict(zip(names, self.zeta.tolist(), strict=True)), **super().metrics()}

    def extras(self) -> dict[str, Any]:
        """zeta and its unit beside the base's, its family where it is not the paper's, and Q_phi
        where it is asked for."""
        name = self.config.energy_family.name
        critic: dict[str, Any] = {}
        if self.config.record_critic:
            critic |= network_arrays("critic", self.critics.member(REWARD_CRITICS))
            critic["critic_scale"] = np.array(self.config.constraint_scale)
        return {
            **super().extras(),
            **critic,
            **({"family": np.array(name)} if name != families.PAPER.name else {}),
            "zeta": self.zeta.detach().cpu().numpy().copy(),
            "length_scale": np.array(self.config.length_scale),
        }

    def state_dict(self) -> dict[str, Any]:
        return {**super().state_dict(), "zeta": self.zeta.detach()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        super().load_state_dict(state)
        with torch.no_grad():
            self.zeta.copy_(state["zeta"])


class Trainer(off_policy.Trainer):
    """The off-policy loop around this file's `Agent`."""

    agent_type: ClassVar[Any] = Agent
