"""The on-policy family's actor: a Gaussian with a state-independent standard deviation.

Actions are not squashed; the environment clips them to its box, as in safety-starter-agents, so
the density used in the importance ratio is that of the unclipped action.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from safemr.learning.networks import StackedMLP
from safemr.learning.rollouts import Batch


def log_density(actions: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """log N(a; mean, diag(exp(log_std))^2): actions, mean [B, A], log_std [A] -> [B]."""
    z = (actions - mean) * torch.exp(-log_std)
    return (-0.5 * z.square() - log_std).sum(-1) - 0.5 * actions.shape[-1] * math.log(2 * math.pi)


def kl_divergence(mean_0: Tensor, log_std_0: Tensor, mean_1: Tensor, log_std_1: Tensor) -> Tensor:
    """KL(N_0 || N_1) of diagonal Gaussians: means [B, A], log standard deviations [A] -> [B]."""
    difference = log_std_0 - log_std_1
    scaled = (mean_0 - mean_1) * torch.exp(-log_std_1)
    return 0.5 * (torch.exp(2.0 * difference) + scaled.square() - 1.0 - 2.0 * difference).sum(-1)


def entropy(log_std: Tensor) -> float:
    """Differential entropy of a diagonal Gaussian, log_std [A], in nats."""
    return float(log_std.detach().sum()) + 0.5 * len(log_std) * math.log(2 * math.pi * math.e)


class GaussianActor:
    """pi(a|s) = N(mean(s), diag(exp(log_std))^2).

    ``network`` is one perceptron [B, D] -> [1, B, A]; ``log_std`` [A] is a leaf tensor.
    """

    def __init__(self, network: StackedMLP, log_std: Tensor) -> None:
        self.network = network
        self.log_std = log_std.detach().clone().requires_grad_(True)

    @property
    def parameters(self) -> list[Tensor]:
        """The two leaves, in the order in which `flat` joins them."""
        return [self.network.parameters, self.log_std]

    def mean(self, observations: Tensor) -> Tensor:
        """The mean action [B, A] at transformed observations [B, D]."""
        return self.network(observations)[0]

    def flat(self) -> Tensor:
        """All parameters in one detached vector [P]."""
        return torch.cat([parameter.detach() for parameter in self.parameters])

    def load_flat(self, values: Tensor) -> None:
        """Overwrites all parameters with one vector [P] in the order of `flat`."""
        weights, log_std = values.split([parameter.numel() for parameter in self.parameters])
        self.network.load(weights)
        with torch.no_grad():
            self.log_std.copy_(log_std)

    def gradient(self, loss: Tensor, *, retain_graph: bool = False) -> Tensor:
        """d loss / d parameters as one vector [P] in the order of `flat`."""
        gradients = torch.autograd.grad(
            loss, self.parameters, retain_graph=retain_graph, materialize_grads=True
        )
        return torch.cat(gradients)


def ratio_and_kl(actor: GaussianActor, batch: Batch) -> tuple[Tensor, Tensor]:
    """pi(a|s) / pi_old(a|s), [B], and E_s[KL(pi_old || pi)], both differentiable."""
    mean = actor.mean(batch.observations)
    ratio = torch.exp(log_density(batch.actions, mean, actor.log_std) - batch.log_density)
    return ratio, kl_divergence(batch.mean, batch.log_std, mean, actor.log_std).mean()
