"""The equations of the soft actor-critic family, one function each, differentiable.

Both backends step on these: `safemr.learning.torch_steps` by PyTorch's derivatives, the
definition of a step, and `safemr.learning.numba_steps` by gradients that are written out and tested
against it. What the constraint is, the change of an energy or a cost, the algorithm says.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

Info = dict[str, Any]  # metrics: numbers, or tensors that hold one

REWARD_CRITICS = 2  # twin critics; the constraint critic is the third member of the stack


def reward_target(
    returns: Tensor,
    discounts: Tensor,
    next_values: Tensor,
    next_log_densities: Tensor,
    temperature: Tensor,
) -> Tensor:
    """y = R^(m) + gamma^m (min_j Q_wj(s', a') - alpha log pi(a'|s')), [B].

    next_values [2, B] from the target networks; discounts are 0 after a termination.
    """
    soft = next_values.amin(0) - temperature * next_log_densities
    return torch.addcmul(returns, discounts, soft)


def critic_loss(predictions: Tensor, targets: Tensor) -> Tensor:
    """Sum over the stack of mean squared errors; predictions, targets [K, B]."""
    return (predictions - targets).square().mean(1).sum()


def policy_loss(
    log_densities: Tensor,
    values: Tensor,
    constraint: Tensor,
    multipliers: Tensor,
    temperature: Tensor,
) -> Tensor:
    """J_pi = E[alpha log pi(a|s) - min_j Q_wj(s, a) + lambda(s) Q_phi(s, a)] (Eq. losspi).

    values [2, B]; the rest [B]; lambda and alpha detached.
    """
    return (temperature * log_densities - values.amin(0) + multipliers * constraint).mean()


def multiplier_loss(multipliers: Tensor, constraint: Tensor) -> Tensor:
    """-E[lambda(s) Q_phi(s, a)] with Q_phi detached: descending it is dual ascent."""
    return -(multipliers * constraint.detach()).mean()


def temperature_loss(
    log_temperature: Tensor, log_densities: Tensor, target_entropy: float
) -> Tensor:
    """-log alpha (E[log pi(a|s)] + target entropy)."""
    return -log_temperature * (log_densities.detach().mean() + target_entropy)
