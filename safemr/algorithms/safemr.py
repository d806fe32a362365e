"""SafeMR: JointSIS plus magnitude regularization of the energy function (the paper's method).

| equation of the paper | function |
|---|---|
| a (sigma + d_min)^n + b k (sisadd) | `safemr.certificates.energy.magnitude` |
| certificate loss (SL2add) | `certificate_loss` |

With a = b = 0 this is JointSIS, number for number. Deviations: those of `joint_sis` and `fac`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from safemr.algorithms import joint_sis
from safemr.learning.replay import Batch

VERSION = 1
ROLE, LEARNS = "method", "zeta"
CERTIFICATE = "energy"


@dataclass(frozen=True)
class Config(joint_sis.Config):
    """JointSIS's hyperparameters and the weights of the magnitude term."""

    a: float = 0.35  # weight of (sigma + d_min)^n
    b: float = 0.15  # weight of k

    RANGES: ClassVar[Mapping[str, str]] = {"a": "[0, 1e6]", "b": "[0, 1e6]"}


def certificate_loss(
    batch: Batch, multipliers: Tensor, zeta: Tensor, d_min: float, config: Config
) -> Tensor:
    """E[lambda(s) (phi(s') - max(phi(s) - eta_D, 0))] + a (sigma + d_min)^n + b k (Eq. SL2add).

    Of another family than the paper's, the last two are its own `magnitude`.
    """
    data = joint_sis.certificate_loss(batch, multipliers, zeta, d_min, config)
    scaled_d_min = d_min / config.length_scale
    return data + config.energy_family.magnitude(scaled_d_min, *zeta.unbind(), config.a, config.b)


class Agent(joint_sis.Agent):
    config: Config

    def certificate_loss(self, batch: Batch, zeta: Tensor, multipliers: Tensor) -> Tensor:
        return certificate_loss(batch, multipliers, zeta, self.d_min, self.config)


class Trainer(joint_sis.Trainer):
    agent_type = Agent
