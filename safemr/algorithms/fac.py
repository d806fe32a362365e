"""Feasible actor-critic (FAC): soft actor-critic with a state-wise energy constraint.

Ma et al., "Feasible actor-critic: constrained reinforcement learning for ensuring statewise
safety" (2021), as used by the SafeMR paper with a fixed energy function: phi_0 = d_min - d is
zeta = [0, 0, 1] and phi_h = (0.3 + d_min)^2 - d^2 - k d_dot is zeta = [0.3, k, 2]. JointSIS and
SafeMR extend this file by their certificate loss.

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
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from safemr.certificates import energy
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
        "constraint_floor": "[-inf, 0]",
    }
    ADDED: ClassVar[frozenset[str]] = frozenset({"record_critic"})


def constraint_values(batch: Batch, zeta: Tensor, d_min: float, config: Config) -> Tensor:
    """max(g(s, a), constraint_floor) with the current zeta (Eq. cstr0), [B].

    No bootstrap: the constraint is about one step. Differentiable in zeta.
    """
    d = torch.stack((batch.d, batch.d_next))
    d_dot = torch.stack((batch.d_dot, batch.d_dot_next))
    lengths = energy.scaled(d, d_dot, d_min, config.length_scale)
    phi, phi_next = energy.largest(energy.energy(*lengths, *zeta.unbind()))
    return energy.constraint(phi, phi_next, config.eta).clamp_min(config.constraint_floor)


class Agent(SoftActorCritic):
    """Soft actor-critic whose constraint is the change of an energy function, zeta = [sigma, k, n].

    JointSIS and SafeMR move zeta in `update_certificate`; `constraint_target` is what another
    energy function overrides.
    """

    config: Config

    def __init__(self, config: Config, *args: Any, **kwargs: Any) -> None:
        super().__init__(config, *args, **kwargs)
        self.zeta = torch.tensor([config.sigma, config.k, config.n], device=config.device)

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
        sigma, k, n = self.zeta.tolist()
        return {"sigma": sigma, "k": k, "n": n, **super().metrics()}

    def extras(self) -> dict[str, Any]:
        """zeta and its unit beside the base's, and Q_phi where it is asked for."""
        critic: dict[str, Any] = {}
        if self.config.record_critic:
            critic |= network_arrays("critic", self.critics.member(REWARD_CRITICS))
            critic["critic_scale"] = np.array(self.config.constraint_scale)
        return {
            **super().extras(),
            **critic,
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
