"""Soft actor-critic under a constraint: the agent that every off-policy algorithm adds to.

Haarnoja et al., "Soft actor-critic algorithms and applications" (arXiv:1812.05905), with a critic
of a constraint beside the twin critics of the return, and a multiplier lambda(s) on it. What the
constraint is, is not said here: feasible actor-critic (`safemr.algorithms.fac`) regresses on the
change of an energy function, SAC-Lagrangian (`safemr.algorithms.sac_lagrangian`) on a bootstrapped
cost. The equations are in `safemr.learning.losses`, the steps on them in a backend.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from safemr.learning.adam import Adam
from safemr.learning.contract import generator
from safemr.learning.hyperparameters import Hyperparameters, Setting
from safemr.learning.losses import REWARD_CRITICS, Info, reward_target
from safemr.learning.networks import ACTIVATIONS, Activation, StackedMLP
from safemr.learning.policies import network_arrays
from safemr.learning.replay import Batch
from safemr.learning.torch_steps import TorchSteps


@dataclass(frozen=True)
class SoftActorCriticConfig(Hyperparameters):
    """What the off-policy algorithms share.

    A decision is an action held for the interface's ``action_repeat`` control steps
    (`safemr.learning.interface`), usually one.
    """

    constraint_scale: float = 1.0  # the constraint critic learns this times the constraint

    # Multiplier network lambda(s) = softplus(.), capped

    multiplier_bias: float = 0.0  # start of the last layer's bias
    multiplier_cap: float = 100.0  # largest lambda(s)
    multiplier_lr: float = 3e-4  # learning rate of the multiplier network
    multiplier_grad_norm: float = 3.0  # its gradient is clipped to this norm
    multiplier_action: Literal["policy", "replay"] = "policy"  # where it is trained

    # Soft actor-critic

    # discount of the reward, a decision; below 1, as time limits are bootstrapped through
    gamma: float = 0.99
    polyak: float = 0.005  # share by which the target critics follow in a gradient step
    n_step: int = 5  # decisions whose rewards are summed before the bootstrap
    critic_lr: float = 1e-3  # learning rate of the three critics
    policy_lr: float = 1e-3  # learning rate of the policy
    temperature_lr: float = 3e-4  # learning rate of log alpha
    initial_log_temperature: float = -4.0  # log alpha at the start
    target_entropy: float = -2.0  # of the policy [nats]; below A log 2, that of random actions
    lr_final: float = 0.1  # every learning rate falls linearly to this share of its start
    hidden: int = 64  # units of each of the two hidden layers
    activation: Activation = "relu"  # of the hidden layers

    # Delays in gradient steps (Algorithm 1)

    policy_delay: int = 2  # m_pi: gradient steps for one of the policy
    multiplier_delay: int = 4  # m_lambda: gradient steps for one of the multiplier

    # Experience

    num_envs: int = 16  # environments stepped together
    update_every: int = 8  # decisions per gradient step
    updates_together: int = 4  # gradient steps done in one go, sharing one draw and its targets
    batch_size: int = 256  # transitions a gradient step
    replay_capacity: int = 500_000  # transitions kept
    start_steps: int = 5_000  # control steps of random actions first, without learning
    start_hold: int = 10  # decisions for which each of them is held
    # probability that a decision of an environment begins a random action that is held for several;
    # it falls linearly to 0
    explore_share: float = 0.0
    explore_hold_min: int = 3  # least number of decisions for which it is held
    explore_hold_max: int = 15  # largest number
    explore_until: float = 0.8  # share of the run's steps at which the probability is 0
    device: str = "cpu"  # PyTorch's name of the device that learns
    backend: Literal["fused", "torch"] = "fused"  # numba's kernels (CPU only), or PyTorch

    RANGES: ClassVar[Mapping[str, str]] = {
        "constraint_scale": "[0.001, 1000]",
        "multiplier_bias": "[-100, 100]",
        **dict.fromkeys(("multiplier_cap", "multiplier_grad_norm"), "(0, 1e6]"),
        # Adam moves every parameter by about its rate a step: beyond 1 it only jumps about.
        **dict.fromkeys(("critic_lr", "policy_lr", "multiplier_lr", "temperature_lr"), "(0, 1]"),
        "gamma": "[0, 1)",
        "polyak": "(0, 1]",
        "lr_final": "[0, 1]",
        "n_step": "[1, 1000]",
        "initial_log_temperature": "[-30, 5]",
        "target_entropy": "[-1000, inf)",
        "hidden": "[1, 4096]",
        **dict.fromkeys(("policy_delay", "multiplier_delay"), "[1, inf)"),
        "num_envs": "[1, 4096]",
        **dict.fromkeys(("update_every", "updates_together", "start_hold"), "[1, inf)"),
        "batch_size": "[1, 1e6]",
        "replay_capacity": "[1, 1e8]",
        "start_steps": "[0, inf)",
        "explore_share": "[0, 1]",
        **dict.fromkeys(("explore_hold_min", "explore_hold_max"), "[1, 1000]"),
        "explore_until": "(0, 1]",
    }
    ADDED: ClassVar[frozenset[str]] = frozenset(
        {"explore_share", "explore_hold_min", "explore_hold_max", "explore_until"}
    )
    CHOICES: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "activation": ACTIVATIONS,
        "multiplier_action": ("policy", "replay"),
        "backend": ("fused", "torch"),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            torch.device(self.device)
        except RuntimeError:
            self.require("device", False, "not a device of PyTorch; use cpu, cuda or cuda:1")
        self.require(
            "multiplier_delay",
            self.multiplier_delay % self.policy_delay == 0,
            f"must be a multiple of policy_delay = {self.policy_delay}: the multiplier uses that "
            "step's policy action",
        )
        self.require(
            "batch_size",
            self.batch_size <= self.replay_capacity,
            f"must not exceed replay_capacity = {self.replay_capacity}",
        )
        self.require(
            "explore_hold_max",
            self.explore_hold_max >= self.explore_hold_min,
            f"must be at least explore_hold_min = {self.explore_hold_min}",
        )

    def delays(self) -> tuple[str, ...]:
        """Fields that hold numbers of gradient steps between two of one kind."""
        return ("updates_together", "policy_delay", "multiplier_delay")

    def check_setting(self, setting: Setting) -> None:
        most = setting.action_dim * math.log(2.0)
        self.require(
            "target_entropy",
            self.target_entropy < most,
            f"must lie below A log 2 = {most:.4g}, the entropy of random actions in "
            f"[-1, 1]^{setting.action_dim}: no policy has more, and the temperature would grow "
            "without end",
        )
        self.require(
            "n_step",
            self.n_step <= setting.episode_decisions,
            f"must not exceed the {setting.episode_decisions} decisions of an episode",
        )
        self.require(
            "start_steps",
            self.start_steps < setting.total_steps,
            f"must lie below the budget of {setting.total_steps} steps, or nothing is learned",
        )
        steps_an_update = self.update_every * setting.action_repeat
        updates = (setting.total_steps - self.start_steps) // steps_an_update
        for name in self.delays():
            self.require(
                name,
                getattr(self, name) <= updates,
                f"must not exceed the run's {updates} gradient steps ((budget - start_steps) / "
                "(update_every x action_repeat))",
            )


def _usable(device: str) -> bool:
    """Whether numbers can be drawn and computed there."""
    try:
        torch.randn(1, generator=torch.Generator(device), device=device).item()
    except (RuntimeError, NotImplementedError, AssertionError):
        return False
    return True


class SoftActorCritic(ABC):
    """Networks, optimisers and the order of Algorithm 1; a backend does the arithmetic.

    An algorithm says what the constraint critic regresses on (`critic_targets`, with `soft_target`
    for the others). It may override `multiplier_inputs` and `update_certificate`, and add to
    `metrics`, `extras` and the state.
    """

    targets_follow: ClassVar[int] = REWARD_CRITICS  # critics that have a target network

    def __init__(
        self,
        config: SoftActorCriticConfig,
        observation_dim: int,
        action_dim: int,
        d_min: float,
        seed: int,
        total_updates: int,
    ) -> None:
        # A configuration may be resolved on one machine and trained on another.
        config.require(
            "device",
            _usable(config.device),
            "PyTorch finds no such device on this machine; use cpu, or install a build for it",
        )
        self.config, self.d_min, self.total_updates = config, d_min, max(total_updates, 1)
        self.updates = 0
        options: dict[str, Any] = {"generator": generator(seed, 0), "device": config.device}
        self._generator = generator(seed, 1, config.device)
        self.action_dim = action_dim

        def network(count: int, inputs: int, outputs: int, **kwargs: Any) -> StackedMLP:
            sizes = (inputs, config.hidden, config.hidden, outputs)
            return StackedMLP(count, sizes, config.activation, **options, **kwargs)

        both = observation_dim + action_dim
        self.critics = network(REWARD_CRITICS + 1, both, 1)
        self.policy = network(1, observation_dim, 2 * action_dim, output_gain=0.1)
        self.multiplier = network(
            1, observation_dim, 1, output_gain=0.1, output_bias=config.multiplier_bias
        )
        self.targets = self.critics.copy(self.targets_follow)
        self.log_temperature = torch.tensor(
            config.initial_log_temperature, device=config.device, requires_grad=True
        )
        self.optimisers = {
            "critics": self.adam(self.critics.parameters, config.critic_lr),
            "policy": self.adam(self.policy.parameters, config.policy_lr),
            "multiplier": self.adam(self.multiplier.parameters, config.multiplier_lr),
            "temperature": self.adam(self.log_temperature, config.temperature_lr),
        }
        self.backend = self._make_backend()

    @staticmethod
    def adam(parameters: Tensor, lr: float) -> Adam:
        return Adam([parameters], lr)

    def _make_backend(self) -> TorchSteps:
        if self.config.backend == "fused" and self.config.device == "cpu":
            from safemr.learning.numba_steps import NumbaSteps  # compiled when it is asked for

            return NumbaSteps(self)
        return TorchSteps(self)

    def noise(self, count: int) -> Tensor:
        """Standard normal [count, A]."""
        size, device = (count, self.action_dim), self.config.device
        return torch.randn(size, generator=self._generator, device=device)

    def act(self, observations: Tensor) -> Tensor:
        """Exploring actions [N, A] in (-1, 1) for transformed observations [N, D]."""
        return self.backend.sample(observations, self.noise(len(observations)))[0]

    def multiplier_inputs(self, observations: Tensor) -> Tensor:
        """What the multiplier network sees of the state; here all of it."""
        return observations

    def multipliers(self, observations: Tensor) -> Tensor:
        """lambda_xi(s) in [0, cap], [B]."""
        raw = self.multiplier(self.multiplier_inputs(observations))[0, :, 0]
        return torch.nn.functional.softplus(raw).clamp_max(self.config.multiplier_cap)

    @torch.no_grad()
    def constraint_of(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Q_phi(s, a), [B]."""
        values = self.critics(torch.cat((observations, actions), 1))[REWARD_CRITICS, :, 0]
        return values / self.config.constraint_scale

    @abstractmethod
    def critic_targets(self, batch: Batch) -> Tensor:
        """What the critics regress on, [3, B]: twice the soft return, then the constraint."""

    def soft_target(self, batch: Batch, next_values: Tensor, log_densities: Tensor) -> Tensor:
        """`losses.reward_target` at the present temperature, [B]."""
        temperature = self.log_temperature.exp()
        return reward_target(
            batch.returns, batch.discounts, next_values, log_densities, temperature
        )

    def update(self, drawn: Batch, parts: int, measure: bool = False) -> Info:
        """``parts`` gradient steps (Algorithm 1), each on its share of the transitions drawn.

        The regression targets of all of them are formed at once, with the networks as they are at
        the start: the target networks move 0.5% a step, and one large product costs far less than
        several small ones. With ``measure`` returns the metrics of the last step of each kind.
        """
        config, backend = self.config, self.backend
        targets = self.critic_targets(drawn)
        info: Info = {}
        for batch, target in zip(drawn.split(parts), targets.chunk(parts, 1), strict=True):
            self.set_learning_rates()
            self.updates += 1
            info |= backend.update_critics(batch, target, measure)
            if self.updates % config.policy_delay == 0:
                with_multiplier = self.updates % config.multiplier_delay == 0
                info |= backend.update_policy(batch, with_multiplier, measure)
            info |= self.update_certificate(batch)
        backend.follow_critics(1.0 - (1.0 - config.polyak) ** parts)
        if not measure:
            return {}
        violating = targets[REWARD_CRITICS] > 0
        return info | {"violating_share": violating.float().mean()}

    def update_certificate(self, batch: Batch) -> Info:
        """Where an algorithm moves its certificate, if it learns one. Returns metrics."""
        return {}

    def certificate_gradient(self, batch: Batch) -> tuple[Tensor, Info] | None:
        """What a step of the certificate is taken on, with its metrics; None where no step is due.

        `move_certificate` takes it, here or in another process (`safemr.parallel`).
        """
        return None

    def move_certificate(self, gradient: Tensor) -> None:
        """The certificate's step on a `certificate_gradient`."""
        raise NotImplementedError

    def set_learning_rates(self) -> None:
        """Those of the next step: they fall linearly with the gradient steps done."""
        share = 1.0 - (1.0 - self.config.lr_final) * min(self.updates / self.total_updates, 1.0)
        for optimiser in self.optimisers.values():
            optimiser.param_groups[0]["lr"] = optimiser.defaults["lr"] * share

    def metrics(self) -> dict[str, float]:
        """State of the agent for the log."""
        return {
            "temperature": float(self.log_temperature.detach().exp()),
            "updates": float(self.updates),
        }

    def extras(self) -> dict[str, Any]:
        """What figures need beside the policy: lambda's network."""
        return {
            **network_arrays("multiplier", self.multiplier),
            "multiplier_cap": np.array(self.config.multiplier_cap),
        }

    def state_dict(self) -> dict[str, Any]:
        networks = ("critics", "targets", "policy", "multiplier")
        return {
            "updates": self.updates,
            "noise": self._generator.get_state(),
            "log_temperature": self.log_temperature.detach(),
            "networks": {name: getattr(self, name).parameters.detach() for name in networks},
            "optimisers": {name: o.state_dict() for name, o in self.optimisers.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.updates = int(state["updates"])
        self._generator.set_state(state["noise"].cpu())
        with torch.no_grad():
            self.log_temperature.copy_(state["log_temperature"])
        for name, values in state["networks"].items():
            getattr(self, name).load(values)
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
        self.backend = self._make_backend()
