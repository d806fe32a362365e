"""SafeMR with a small neural energy function, the extension that the paper names as future work.

A network f corrects the handcrafted energy, whose zeta = [sigma, k, n] stays fixed; what it cannot
touch is contact:

    phi(s) = softmax_tau(phi_0(s), phi_zeta(s) + gate(d) f_theta(s)),    gate(d <= d_min) = 0.

So phi > 0 wherever d < d_min, whatever theta, and phi = phi_zeta at the start, where f = 0. The
rest is feasible actor-critic with this phi; theta takes the place of zeta in the last step.

| equation of the paper | function |
|---|---|
| phi (sis), neural | `safemr.certificates.energy.corrected`, `neural_energy` |
| a (sigma + d_min)^n + b k (sisadd) | `safemr.certificates.energy.mean_positive_part` |
| certificate loss (SL2add) | `certificate_loss` |

Magnitude. The paper's term is the energy at two points: (sigma + d_min)^n is phi at d = d_dot = 0,
and k is what one unit of closing speed adds. Three parameters move with them, a network would not.
Here it is a times the mean of phi's positive part over the states in memory (smoothed by tau). For
eta_D = 0 this has the right solution: of all functions that are at least the energy at contact
and keep g <= 0 under the best policy, the least has the true unsafe set as its positive set.

Deviations. (1) The derivative of max(phi(s) - eta_D, 0) is taken as 1 everywhere (``through``).
By the paper's own (``literal``) no state outside the unsafe set is ever moved into it: where a
flight enters, phi(s') falls and phi(s) stays. (2) The constraint enters as max(g, 0): with a floor
below 0 phi would have to fall along every flight that keeps it. (3) Adam, since theta has no scale
of its own. docs/aircraft.md reports what this does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from safemr.algorithms import fac
from safemr.certificates import energy
from safemr.certificates.certificate import (
    NETWORK,
    Certificate,
    Recorded,
    refuse_other_family,
)
from safemr.certificates.families import PAPER, EnergyFamily, named
from safemr.errors import UserError
from safemr.learning.contract import generator
from safemr.learning.losses import Info
from safemr.learning.networks import StackedMLP
from safemr.learning.observation import ObservationTransform
from safemr.learning.policies import Policy, network_arrays, network_from_arrays
from safemr.learning.replay import Batch

VERSION = 1
ROLE, LEARNS = "method", "network"
CERTIFICATE = "neural"
CHUNK = 2**16  # states whose phi is computed at once, which bounds the memory


@dataclass(frozen=True)
class Config(fac.Config):
    """FAC's hyperparameters, sigma, k, n being the fixed handcrafted part, and those of f."""

    n_step: int = 1  # the energy needs the next state, which the bootstrap then is
    a: float = 10.0  # weight of the magnitude term
    smoothing: float = 0.1  # tau, in units of length_scale
    certificate_hidden: int = 32  # width of f's two hidden layers (tanh)
    certificate_lr: float = 1e-3  # learning rate of f
    certificate_delay: int = 4  # m_phi: gradient steps for one of theta
    certificate_start: float = 0.05  # share of training before theta moves
    # of max(phi(s) - eta_D, 0) in the certificate's loss: 1 everywhere, or the paper's own
    certificate_derivative: Literal["through", "literal"] = "through"

    RANGES: ClassVar[Mapping[str, str]] = {
        "a": "[0, 1e6]",
        "smoothing": "(0, 1000]",
        "certificate_hidden": "[1, 4096]",
        "certificate_lr": "(0, 1]",
        "certificate_delay": "[1, inf)",
        "certificate_start": "[0, 1)",
    }
    CHOICES: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "certificate_derivative": ("through", "literal"),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("n_step", self.n_step == 1, "must be 1: the energy needs the next state")

    def delays(self) -> tuple[str, ...]:
        return (*super().delays(), "certificate_delay")


def neural_energy(
    network: StackedMLP,
    observations: Tensor,
    d: Tensor,
    d_dot: Tensor,
    d_min: float,
    *,
    zeta: Tensor,
    length_scale: float,
    smoothing: float,
    energy_family: EnergyFamily = PAPER,
) -> Tensor:
    """phi [B] at transformed observations [B, D] with d, d_dot [B, M], differentiable in theta.

    Over M obstacles phi_0 and phi_zeta, which is of ``energy_family``, are the largest.
    """
    d, d_dot, least = energy.scaled(d, d_dot, d_min, length_scale)
    handcrafted = energy.largest(energy_family.phi(d, d_dot, least, *zeta.unbind()))
    contact = energy.largest(least - d)
    return energy.corrected(handcrafted, contact, network(observations)[0, :, 0], smoothing)


@dataclass(frozen=True, eq=False)
class NeuralCertificate(Certificate, family="neural"):
    """`neural_energy` with its network f, as it was recorded or fitted."""

    kind: ClassVar[str] = "a network beside a fixed [sigma, k, n]"
    arrays: ClassVar[tuple[str, ...]] = ("zeta", "length_scale", "smoothing", NETWORK)
    observes: ClassVar[bool] = True

    name: str
    network: StackedMLP
    transform: ObservationTransform
    zeta: Tensor  # fixed; the paper's [3], or another family's
    smoothing: float  # tau, in units of length_scale
    eta: float = 0.0
    length_scale: float = 1.0
    record: Recorded | None = None
    energy_family: EnergyFamily = PAPER  # of the fixed part

    @classmethod
    def from_record(cls, record: Recorded) -> Self:
        """The energy that its policy file holds."""
        refuse_other_family(record, cls)
        eta = float(record.hyperparameters.get("eta", 0.0))
        return cls.from_policy(record.policy(), record.name, eta, record)

    @classmethod
    def from_policy(
        cls, policy: Policy, name: str, eta: float = 0.0, record: Recorded | None = None
    ) -> Self:
        """The energy that a policy was trained with. Raises UserError where it keeps none."""
        saved = policy.extras
        if lacking := [array for array in cls.arrays if array not in saved]:
            raise UserError(f"{name}: its policy file has no {', '.join(lacking)}")
        return cls(
            name,
            network_from_arrays("certificate", saved),
            policy.transform,
            torch.from_numpy(saved["zeta"]),
            float(saved["smoothing"]),
            eta,
            float(saved["length_scale"]),
            record,
            named(str(saved.get("family", PAPER.name))),
        )

    @property
    def parameters(self) -> Mapping[str, float]:
        """The fixed zeta and the smoothing; f's are in ``network``."""
        zeta = dict(zip(self.energy_family.names, self.zeta.tolist(), strict=True))
        return {**zeta, "smoothing": self.smoothing}

    @torch.no_grad()
    def phi(
        self,
        d: NDArray[Any],
        d_dot: NDArray[Any],
        d_min: float,
        observations: NDArray[Any] | None = None,
    ) -> NDArray[np.float64]:
        """phi [...]; computed in single precision. Raises ValueError without observations."""
        if observations is None:
            raise ValueError("a neural energy function asks for the observations")
        shape, obstacles = d.shape[:-1], d.shape[-1]
        rows = (
            observations.reshape(-1, observations.shape[-1]),
            d.reshape(-1, obstacles),
            d_dot.reshape(-1, obstacles),
        )
        parts = []
        for at in range(0, len(rows[0]), CHUNK):
            seen, near, closing = (values[at : at + CHUNK] for values in rows)
            phi = neural_energy(
                self.network,
                torch.from_numpy(self.transform(seen)),
                torch.from_numpy(near).float(),
                torch.from_numpy(closing).float(),
                d_min,
                zeta=self.zeta,
                length_scale=self.length_scale,
                smoothing=self.smoothing,
                energy_family=self.energy_family,
            )
            parts.append(phi.numpy())
        return np.concatenate(parts).astype(float).reshape(shape)


def certificate_loss(phi: Tensor, phi_next: Tensor, multipliers: Tensor, config: Config) -> Tensor:
    """E[lambda(s) max(phi(s') - max(phi(s) - eta_D, 0), 0)] + a E[phi's positive part] (SL2add)."""
    g = energy.constraint(phi, phi_next, config.eta)
    if config.certificate_derivative == "through":
        g = energy.constraint(phi.detach(), phi_next, config.eta) - (phi - phi.detach())
    magnitude = energy.mean_positive_part(phi, config.smoothing)
    return (multipliers * g.clamp_min(0.0)).mean() + config.a * magnitude


class Agent(fac.Agent):
    """Feasible actor-critic whose energy's correction descends `certificate_loss`."""

    config: Config

    def __init__(
        self,
        config: Config,
        observation_dim: int,
        action_dim: int,
        d_min: float,
        seed: int,
        total_updates: int,
    ) -> None:
        super().__init__(config, observation_dim, action_dim, d_min, seed, total_updates)
        width = config.certificate_hidden
        self.certificate = StackedMLP(
            1,
            (observation_dim, width, width, 1),
            "tanh",
            generator=generator(seed, 5),
            output_gain=0.0,
            device=config.device,
        )
        self.optimisers["certificate"] = self.adam(
            self.certificate.parameters, config.certificate_lr
        )
        self._first_update = int(config.certificate_start * self.total_updates)

    def energies(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """phi(s) and phi(s'), [B] each."""
        phi = neural_energy(
            self.certificate,
            torch.cat((batch.observations, batch.bootstraps)),
            torch.cat((batch.d, batch.d_next)),
            torch.cat((batch.d_dot, batch.d_dot_next)),
            self.d_min,
            zeta=self.zeta,
            length_scale=self.config.length_scale,
            smoothing=self.config.smoothing,
            energy_family=self.config.energy_family,
        )
        now, following = phi.chunk(2)
        return now, following

    def constraint_target(self, batch: Batch) -> Tensor:
        g = energy.constraint(*self.energies(batch), self.config.eta)
        return g.clamp_min(self.config.constraint_floor)

    def update_certificate(self, batch: Batch) -> Info:
        """A step of Adam on theta every m_phi updates (Algorithm 1, last line)."""
        if self.updates <= self._first_update or self.updates % self.config.certificate_delay:
            return {}
        with torch.no_grad():
            multipliers = self.multipliers(batch.observations)
        phi, phi_next = self.energies(batch)
        loss = certificate_loss(phi, phi_next, multipliers, self.config)
        parameters = self.certificate.parameters
        (gradient,) = torch.autograd.grad(loss, [parameters])
        parameters.grad = gradient
        self.optimisers["certificate"].step()
        return {
            "certificate_loss": loss.detach(),
            "certificate_grad_norm": gradient.norm(),
            "certificate_unsafe_share": (phi.detach() > 0).float().mean(),
        }

    def extras(self) -> dict[str, Any]:
        """FAC's, with f's network: what `NeuralCertificate` reads."""
        return {
            **super().extras(),
            **network_arrays("certificate", self.certificate),
            "smoothing": np.array(self.config.smoothing),
        }

    def state_dict(self) -> dict[str, Any]:
        state = super().state_dict()
        state["networks"]["certificate"] = self.certificate.parameters.detach()
        return state


class Trainer(fac.Trainer):
    agent_type = Agent
