"""The numba backend (``fused``) of the soft actor-critic family: steps by compiled kernels.

It owns no state. Networks, moments and step counts are the agent's own torch tensors, of which the
kernels see the memory, so saving, resuming and target networks are those of the other backend.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from safemr.learning import numba_kernels
from safemr.learning.adam import Adam
from safemr.learning.losses import Info
from safemr.learning.networks import ACTIVATIONS, StackedMLP
from safemr.learning.replay import Batch
from safemr.learning.torch_steps import TorchSteps


def network(stack: StackedMLP) -> numba_kernels.Network:
    """A stack of perceptrons as the kernels see it."""
    shape = stack.shape
    parameters = stack.parameters.detach().numpy()
    sizes = np.array(shape.sizes, np.int64)
    return numba_kernels.Network(
        parameters, sizes, shape.count, ACTIVATIONS.index(shape.activation)
    )


def optimisers(adam: Adam) -> list[numba_kernels.Optimiser]:
    """The state of an Adam for each of its tensors."""
    (group,) = adam.param_groups
    found = []
    for parameters in group["params"]:
        state = adam.moments(parameters)
        moments = (state[name].view(-1) for name in ("exp_avg", "exp_avg_sq", "step"))
        found.append(numba_kernels.Optimiser(*(moment.numpy() for moment in moments)))
    return found


def optimiser(adam: Adam) -> numba_kernels.Optimiser:
    """The state of an Adam over one tensor."""
    (only,) = optimisers(adam)
    return only


class NumbaSteps(TorchSteps):
    """`TorchSteps` with gradients written out: the same numbers up to the order of summation.

    Bound to the agent's tensors at the first step; an agent that exchanges them makes a new one.
    """

    @cached_property
    def _networks(self) -> dict[str, numba_kernels.Network]:
        names = ("critics", "targets", "policy", "multiplier")
        return {name: network(getattr(self.agent, name)) for name in names}

    @cached_property
    def _optimisers(self) -> dict[str, numba_kernels.Optimiser]:
        return {name: optimiser(adam) for name, adam in self.agent.optimisers.items()}

    @cached_property
    def _log_temperature(self) -> numba_kernels.Floats:
        return self.agent.log_temperature.detach().view(1).numpy()

    def sample(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        actions, log_densities = numba_kernels.sample(
            self._networks["policy"], observations.numpy(), noise.numpy()
        )
        return torch.from_numpy(actions), torch.from_numpy(log_densities)

    def next_values(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        policy, targets = self._networks["policy"], self._networks["targets"]
        values, log_densities = numba_kernels.next_values(
            policy, targets, observations.numpy(), noise.numpy()
        )
        return torch.from_numpy(values), torch.from_numpy(log_densities)

    def follow_critics(self, rate: float) -> None:
        numba_kernels.polyak(self._networks["targets"], self._networks["critics"], rate)

    def update_critics(self, batch: Batch, target: Tensor, measure: bool) -> Info:
        loss, norm, mean = numba_kernels.critic_step(
            self._networks["critics"],
            self._optimisers["critics"],
            self._lr("critics"),
            batch.observations.numpy(),
            batch.actions.numpy(),
            target.contiguous().numpy(),
        )
        return {"critic_loss": loss, "critic_grad_norm": norm, "value_mean": mean}

    def update_policy(self, batch: Batch, with_multiplier: bool, measure: bool) -> Info:
        agent, config = self.agent, self.agent.config
        inputs = agent.multiplier_inputs(batch.observations).contiguous().numpy()
        multipliers, constraint, raw, memory, loss, norm, log_density = numba_kernels.policy_step(
            self._networks["policy"],
            self._optimisers["policy"],
            self._lr("policy"),
            self._networks["critics"],
            self._networks["multiplier"],
            inputs,
            self._log_temperature,
            self._optimisers["temperature"],
            self._lr("temperature"),
            batch.observations.numpy(),
            agent.noise(len(batch.observations)).numpy(),
            config.constraint_scale,
            config.multiplier_cap,
            config.target_entropy,
        )
        info: Info = {}
        if measure:
            info = {
                "policy_loss": loss,
                "policy_grad_norm": norm,
                "entropy": -log_density,
                "multiplier_mean": multipliers.mean(),
                "multiplier_max": multipliers.max(),
                "constraint_mean": constraint.mean(),
            }
        if with_multiplier:
            if config.multiplier_action == "replay":
                constraint = agent.constraint_of(batch.observations, batch.actions).numpy()
            info["multiplier_grad_norm"] = numba_kernels.multiplier_step(
                self._networks["multiplier"],
                self._optimisers["multiplier"],
                self._lr("multiplier"),
                inputs,
                memory,
                raw,
                constraint,
                config.multiplier_cap,
                config.multiplier_grad_norm,
            )
        return info

    def _lr(self, name: str) -> float:
        return float(self.agent.optimisers[name].param_groups[0]["lr"])
