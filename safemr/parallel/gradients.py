"""One gradient step of Algorithm 1 in two halves: a learner forms the gradients, the driver steps.

Both backends take a gradient and Adam's step in one go. A learner reads the gradient off Adam's
first moment: from moments at zero and with a learning rate of zero the step leaves the parameters
as they are and makes the first moment (1 - beta_1) times the gradient. So the equations, and the
compiled kernels, stay in one place, and what they say is what is sent, up to one rounding.

All gradients of a step belong to the same weights, whereas in one process the policy's is formed
after the critics' step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from safemr.learning.replay import Batch
from safemr.learning.soft_actor_critic import SoftActorCritic

Arrays = dict[str, NDArray[np.float32]]
NETWORKS = ("critics", "targets", "policy", "multiplier")
ZETA_NAME = "zeta"  # a certificate's parameters, which no optimiser of Adam moves


def weights(agent: SoftActorCritic, *names: str) -> Arrays:
    """Copies of some of an agent's tensors, or of all that a gradient depends on."""
    found = {name: getattr(agent, name).parameters for name in NETWORKS}
    found["temperature"] = agent.log_temperature
    if hasattr(agent, ZETA_NAME):
        found[ZETA_NAME] = getattr(agent, ZETA_NAME)
    return {name: found[name].detach().numpy().copy() for name in names or found}


def take_over(agent: SoftActorCritic, values: Mapping[str, NDArray[np.float32]]) -> None:
    """Overwrite an agent's tensors by `weights` of another one."""
    with torch.no_grad():
        for name, value in values.items():
            new = torch.from_numpy(np.array(value))  # what comes from another process is read-only
            if name in NETWORKS:
                getattr(agent, name).load(new)
            elif name == ZETA_NAME:
                getattr(agent, name).copy_(new)
            else:
                agent.log_temperature.copy_(new)


class Learning:
    """Forms the gradients of gradient steps without taking them."""

    def __init__(self, agent: SoftActorCritic) -> None:
        self.agent = agent
        for optimiser in agent.optimisers.values():
            optimiser.param_groups[0]["lr"] = 0.0
            self._moments(optimiser)

    @staticmethod
    def _moments(optimiser: Any) -> dict[str, Tensor]:
        (parameters,) = optimiser.param_groups[0]["params"]
        return optimiser.moments(parameters)

    def gradients(
        self, batch: Batch, number: int, measure: bool
    ) -> tuple[Arrays, dict[str, float]]:
        """Those of the ``number``-th gradient step, from 1 on, and with ``measure`` its metrics.

        Name of an optimiser, or ``zeta`` -> gradient, as Adam gets it (the multiplier's clipped).
        """
        agent, config = self.agent, self.agent.config
        for optimiser in agent.optimisers.values():
            for moment in self._moments(optimiser).values():
                moment.zero_()
        agent.updates = number
        target = agent.critic_targets(batch)
        info = dict(agent.backend.update_critics(batch, target, measure))
        names = ["critics"]
        if number % config.policy_delay == 0:
            with_multiplier = number % config.multiplier_delay == 0
            info |= agent.backend.update_policy(batch, with_multiplier, measure)
            names += ["policy", "temperature", *(["multiplier"] if with_multiplier else [])]
        found = {name: self._gradient(name) for name in names}
        if (certificate := agent.certificate_gradient(batch)) is not None:
            gradient, said = certificate
            found[ZETA_NAME], info = gradient.numpy(), info | said
        if not measure:
            return found, {}
        info["violating_share"] = (target[-1] > 0).float().mean()
        return found, {name: float(value) for name, value in info.items()}

    def _gradient(self, name: str) -> NDArray[np.float32]:
        optimiser = self.agent.optimisers[name]
        beta, _ = optimiser.param_groups[0]["betas"]
        return (self._moments(optimiser)["exp_avg"] / (1.0 - beta)).numpy()


def step(agent: SoftActorCritic, gradients: Mapping[str, NDArray[np.float32]]) -> None:
    """The gradient step: Adam, zeta's projected step, and the targets follow."""
    agent.set_learning_rates()
    agent.updates += 1
    for name, values in gradients.items():
        gradient = torch.from_numpy(np.array(values))
        if name == ZETA_NAME:
            agent.move_certificate(gradient)
            continue
        optimiser = agent.optimisers[name]
        (parameters,) = optimiser.param_groups[0]["params"]
        parameters.grad = gradient
        optimiser.step()
    agent.backend.follow_critics(agent.config.polyak)
