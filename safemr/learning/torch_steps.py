"""The torch backend of the soft actor-critic family: steps on the losses' derivatives by PyTorch.

It is the definition of a step and works on every device; `safemr.learning.numba_steps` does the
same by gradients that are written out and tested against it.
"""

from __future__ import annotations

from typing import Any, Protocol

import torch
from torch import Tensor

from safemr.learning import losses
from safemr.learning.adam import Adam
from safemr.learning.networks import StackedMLP, squashed_gaussian
from safemr.learning.replay import Batch


class Stepped(Protocol):
    """What steps need of an agent: its networks, optimisers and noise."""

    config: Any
    critics: StackedMLP
    targets: StackedMLP
    policy: StackedMLP
    multiplier: StackedMLP
    log_temperature: Tensor
    optimisers: dict[str, Adam]

    def noise(self, count: int) -> Tensor: ...

    def multiplier_inputs(self, observations: Tensor) -> Tensor: ...

    def multipliers(self, observations: Tensor) -> Tensor: ...

    def constraint_of(self, observations: Tensor, actions: Tensor) -> Tensor: ...


class TorchSteps:
    """Sampling and gradient steps of an agent, written with differentiable operations."""

    def __init__(self, agent: Stepped) -> None:
        self.agent = agent

    @torch.no_grad()
    def sample(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Actions [B, A] of the policy for standard normal noise, and log-densities [B]."""
        return squashed_gaussian(self.agent.policy(observations)[0], noise)

    @torch.no_grad()
    def next_values(self, observations: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
        """Target critics' values [K, B] of sampled actions, and log-densities [B] of these."""
        action, log_density = self.sample(observations, noise)
        return self.agent.targets(torch.cat((observations, action), 1))[..., 0], log_density

    def follow_critics(self, rate: float) -> None:
        """Polyak averaging of the target critics."""
        self.agent.targets.follow(self.agent.critics, rate)

    def update_critics(self, batch: Batch, target: Tensor, measure: bool) -> losses.Info:
        """A step on `losses.critic_loss`; target [3, B]."""
        critics = self.agent.critics
        values = critics(torch.cat((batch.observations, batch.actions), 1))[..., 0]
        loss = losses.critic_loss(values, target)
        gradient = self._step("critics", critics.parameters, loss)
        if not measure:
            return {}
        return {
            "critic_loss": loss.detach(),
            "critic_grad_norm": gradient.norm(),
            "value_mean": values[0].detach().mean(),
        }

    def update_policy(self, batch: Batch, with_multiplier: bool, measure: bool) -> losses.Info:
        """Steps on `losses.policy_loss`, `losses.temperature_loss` and, maybe,
        `losses.multiplier_loss`."""
        agent, config, observations = self.agent, self.agent.config, batch.observations
        output = agent.policy(observations)[0]
        action, log_density = squashed_gaussian(output, agent.noise(len(output)))
        values = agent.critics.frozen(torch.cat((observations, action), 1))[..., 0]
        constraint = values[losses.REWARD_CRITICS] / config.constraint_scale
        with torch.set_grad_enabled(with_multiplier):
            multipliers = agent.multipliers(observations)
        loss = losses.policy_loss(
            log_density,
            values[: losses.REWARD_CRITICS],
            constraint,
            multipliers.detach(),
            agent.log_temperature.detach().exp(),
        )
        gradient = self._step("policy", agent.policy.parameters, loss)
        self._step(
            "temperature",
            agent.log_temperature,
            losses.temperature_loss(agent.log_temperature, log_density, config.target_entropy),
        )
        info: losses.Info = {}
        if measure:
            info = {
                "policy_loss": loss.detach(),
                "policy_grad_norm": gradient.norm(),
                "entropy": -log_density.detach().mean(),
                "multiplier_mean": multipliers.detach().mean(),
                "multiplier_max": multipliers.detach().amax(),
                "constraint_mean": constraint.detach().mean(),
            }
        if with_multiplier:
            if config.multiplier_action == "replay":
                constraint = agent.constraint_of(observations, batch.actions)
            dual = losses.multiplier_loss(multipliers, constraint)
            gradient = self._step(
                "multiplier", agent.multiplier.parameters, dual, config.multiplier_grad_norm
            )
            if measure:
                info["multiplier_grad_norm"] = gradient.norm()
        return info

    def _step(
        self, name: str, parameters: Tensor, loss: Tensor, max_norm: float | None = None
    ) -> Tensor:
        """One optimiser step on ``loss``; returns the gradient."""
        (gradient,) = torch.autograd.grad(loss, [parameters])
        if max_norm is not None:
            gradient.mul_((max_norm / (gradient.norm() + 1e-6)).clamp_max(1.0))
        parameters.grad = gradient
        self.agent.optimisers[name].step()
        return gradient
