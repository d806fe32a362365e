"""The numba backend (``fused``) of the on-policy family: its steps by compiled kernels.

It owns no state. Networks, moments and step counts are the trainer's own torch tensors, of which
the kernels see the memory, so saving and resuming are those of the torch backend.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from safemr.learning import on_policy_kernels as kernels
from safemr.learning.adam import Adam
from safemr.learning.gaussian import GaussianActor
from safemr.learning.networks import StackedMLP
from safemr.learning.numba_kernels import Floats, Optimiser
from safemr.learning.numba_steps import network, optimisers
from safemr.learning.rollouts import Batch
from safemr.learning.trust_region import Loss, Product


def _samples(batch: Batch) -> kernels.Samples:
    names = kernels.Samples._fields
    return kernels.Samples(*(getattr(batch, name).contiguous().numpy() for name in names))


def _rows(batch: Batch, indices: Tensor | slice) -> kernels.Rows:
    return np.arange(len(batch.actions)) if isinstance(indices, slice) else indices.numpy()


def _adam(optimizer: Adam) -> tuple[list[Optimiser], float]:
    """The states of its tensors, which loading a checkpoint replaces, and its learning rate."""
    return optimisers(optimizer), float(optimizer.param_groups[0]["lr"])


class FusedSteps:
    """What `on_policy.OnPolicyTrainer` and its algorithms define, up to the order of summation.

    Bound to the memory of the networks' parameters, which loading overwrites in place.
    """

    def __init__(self, actor: GaussianActor, critics: StackedMLP) -> None:
        self._actor, self._critics = network(actor.network), network(critics)
        self._log_std: Floats = actor.log_std.detach().numpy()

    def act(self, observations: Floats, perturbation: Floats) -> Floats:
        """Mean actions plus a perturbation, [N, A], for transformed observations [N, D]."""
        actions: Floats = kernels.act(self._actor, np.ascontiguousarray(observations), perturbation)
        return actions

    def mean(self, observations: Tensor) -> Tensor:
        """The actor's mean actions [B, A]."""
        means = kernels.evaluate(self._actor, observations.numpy())[0]
        return torch.from_numpy(np.ascontiguousarray(means.T))

    def values(self, observations: Tensor) -> Tensor:
        """The critics' values [2, B, 1]."""
        return torch.from_numpy(kernels.evaluate(self._critics, observations.numpy())).mT

    def value_step(self, batch: Batch, indices: Tensor | slice, optimizer: Adam) -> Tensor:
        """One step of both critics on a minibatch; their losses before it, [2]."""
        (state,), lr = _adam(optimizer)
        samples = (batch.observations.numpy(), batch.returns.numpy(), _rows(batch, indices))
        return torch.from_numpy(kernels.value_step(self._critics, state, lr, *samples))

    def clipped_step(
        self,
        batch: Batch,
        indices: Tensor | slice,
        optimizer: Adam,
        clip: float,
        multiplier: float,
        bound: float,
    ) -> tuple[Tensor, Tensor] | None:
        """`ppo_lagrangian.Trainer._step`: loss and clipped share, None beyond the KL bound."""
        states, lr = _adam(optimizer)
        taken, loss, clipped = kernels.clipped_step(
            self._actor,
            self._log_std,
            *states,
            lr,
            _samples(batch),
            _rows(batch, indices),
            clip,
            multiplier,
            bound,
        )
        return (torch.tensor(loss), torch.tensor(clipped)) if taken else None

    def surrogates(self, batch: Batch) -> tuple[float, float, float]:
        """E[r A], E[r A_cost] and E_s[KL(pi_old || pi)]."""
        return kernels.surrogates(self._actor, self._log_std, _samples(batch))

    def region(self, batch: Batch) -> FusedRegion:
        """`trust_region.Region` by kernels."""
        return FusedRegion(self._actor, self._log_std, _samples(batch))


class FusedRegion:
    """`trust_region.Region` at an actor that the kernels see."""

    def __init__(self, actor: kernels.Network, log_std: Floats, samples: kernels.Samples) -> None:
        self._at = (actor, log_std)
        self._samples = samples
        self.old = self.surrogates()[:2]

    def surrogates(self) -> tuple[float, float, float]:
        return kernels.surrogates(*self._at, self._samples)

    def gradient(self, loss: Loss) -> Tensor:
        along = (float(loss(1.0, 0.0)), float(loss(0.0, 1.0)))
        return torch.from_numpy(kernels.surrogate_gradient(*self._at, self._samples, *along))

    def product(self, damping: float) -> Product:
        x = self._samples.observations
        memories = kernels.hidden_states(self._at[0], x)

        def product(v: Tensor) -> Tensor:
            image = kernels.fisher_product(*self._at, x, memories, v.numpy(), damping)
            return torch.from_numpy(image)

        return product
