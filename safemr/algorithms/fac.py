"""Feasible actor-critic (FAC): soft actor-critic with a state-wise energy constraint.

Ma et al., "Feasible actor-critic: constrained reinforcement learning for ensuring statewise
safety" (2021), as used by the SafeMR paper with a fixed energy function: phi_0 = d_min - d is
zeta = [0, 0, 1] and phi_h = (0.3 + d_min)^2 - d^2 - k d_dot is zeta = [0.3, k, 2]. JointSIS and
SafeMR extend this file by their certificate loss.

| equation of the paper | function |
|---|---|
| phi (sis), constraint g (cstr0) | `energy`, `constraint` of `safemr.certificates.energy` |
| Q_w regression (soft Bellman target) | `reward_target` |
| Q_phi regression on g | `constraint_values`, the third member of the critic stack |
| J_pi (losspi) | `policy_loss` |
| dual ascent on E[lambda(s) Q_phi(s, a)] | `multiplier_loss` |
| temperature (Haarnoja et al. 2018) | `temperature_loss` |
| delays m_pi < m_lambda < m_phi (Alg. 1) | `Agent.update` |

The gradients of these losses are taken by `safemr.learning.torch_steps` or, equal but faster, by
`safemr.learning.numba_steps`.

Deviations from the paper and from the authors' released code, each a field of `Config`:
minimum of two critics (usual practice; Eq. losspi has one), n-step returns, the multiplier is
trained on the current policy's action instead of the replayed one, larger learning rates and
smaller networks for a budget two orders of magnitude smaller.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from safemr.certificates import energy
from safemr.learning import off_policy
from safemr.learning.contract import generator
from safemr.learning.hyperparameters import Hyperparameters, Setting
from safemr.learning.networks import ACTIVATIONS, Activation, StackedMLP
from safemr.learning.policies import network_arrays
from safemr.learning.replay import Batch

if TYPE_CHECKING:
    from safemr.learning.torch_steps import AutogradSteps

VERSION = 1

Info = dict[str, Any]  # metrics: numbers, or tensors that hold one

REWARD_CRITICS = 2  # twin critics; the constraint critic is the third member of the stack


@dataclass(frozen=True)
class Config(Hyperparameters):
    """Hyperparameters. Lengths in units of ``length_scale`` metres; steps are environment steps."""

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

    # Multiplier network lambda(s) = softplus(.), capped

    multiplier_bias: float = -3.0  # start of the last layer's bias
    multiplier_cap: float = 100.0  # largest lambda(s)
    multiplier_lr: float = 3e-4  # learning rate of the multiplier network
    multiplier_grad_norm: float = 3.0  # its gradient is clipped to this norm
    multiplier_action: Literal["policy", "replay"] = "policy"  # where it is trained

    # Soft actor-critic

    gamma: float = 0.99  # discount of the reward; below 1, as time limits are bootstrapped through
    polyak: float = 0.005  # share by which the target critics follow in a gradient step
    n_step: int = 5  # rewards summed before the bootstrap
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
    update_every: int = 8  # environment steps per gradient step
    updates_together: int = 4  # gradient steps done in one go, sharing one draw and its targets
    batch_size: int = 256  # transitions a gradient step
    replay_capacity: int = 500_000  # transitions kept
    start_steps: int = 5_000  # random actions first, without learning
    start_hold: int = 10  # steps for which each of them is held
    device: str = "cpu"  # PyTorch's name of the device that learns
    backend: Literal["fused", "torch"] = "fused"  # compiled kernels (CPU only), or autograd

    RANGES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("sigma", "n", "eta"), "[0, 10]"),
        "k": "[0, 100]",
        **dict.fromkeys(("length_scale", "constraint_scale"), "[0.001, 1000]"),
        "constraint_floor": "[-inf, 0]",
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
    }
    CHOICES: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "activation": ACTIVATIONS,
        "multiplier_action": ("policy", "replay"),
        "backend": ("fused", "torch"),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
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
            self.n_step <= setting.episode_steps,
            f"must not exceed the {setting.episode_steps} steps of an episode",
        )
        self.require(
            "start_steps",
            self.start_steps < setting.total_steps,
            f"must lie below the budget of {setting.total_steps} steps, or nothing is learned",
        )
        updates = (setting.total_steps - self.start_steps) // self.update_every
        for name in self.delays():
            self.require(
                name,
                getattr(self, name) <= updates,
                f"must not exceed the run's {updates} gradient steps ((budget - start_steps) / "
                "update_every)",
            )


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


def constraint_values(batch: Batch, zeta: Tensor, d_min: float, config: Config) -> Tensor:
    """max(g(s, a), constraint_floor) with the current zeta (Eq. cstr0), [B].

    No bootstrap: the constraint is about one step. Differentiable in zeta.
    """
    d = torch.stack((batch.d, batch.d_next))
    d_dot = torch.stack((batch.d_dot, batch.d_dot_next))
    lengths = energy.scaled(d, d_dot, d_min, config.length_scale)
    phi, phi_next = energy.largest(energy.energy(*lengths, *zeta.unbind()))
    return energy.constraint(phi, phi_next, config.eta).clamp_min(config.constraint_floor)


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


class Agent:
    """Networks, optimisers and the order of Algorithm 1; ``steps`` does the arithmetic.

    What a variant may override: `critic_targets` or `constraint_target`, `multiplier_inputs`,
    `update_certificate`, `metrics` and `extras`.
    """

    def __init__(
        self,
        config: Config,
        observation_dim: int,
        action_dim: int,
        d_min: float,
        seed: int,
        total_updates: int,
    ) -> None:
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
        self.targets = self.critics.copy(REWARD_CRITICS)
        self.zeta = torch.tensor([config.sigma, config.k, config.n], device=config.device)
        self.log_temperature = torch.tensor(
            config.initial_log_temperature, device=config.device, requires_grad=True
        )
        self.optimisers = {
            "critics": self.adam(self.critics.parameters, config.critic_lr),
            "policy": self.adam(self.policy.parameters, config.policy_lr),
            "multiplier": self.adam(self.multiplier.parameters, config.multiplier_lr),
            "temperature": self.adam(self.log_temperature, config.temperature_lr),
        }
        self.steps = self._make_steps()

    @staticmethod
    def adam(parameters: Tensor, lr: float) -> torch.optim.Adam:
        return torch.optim.Adam([parameters], lr=lr, fused=True)

    def _make_steps(self) -> AutogradSteps:
        # Both differentiate the losses of this module, so they come after it.
        if self.config.backend == "fused" and self.config.device == "cpu":
            from safemr.learning.numba_steps import FusedSteps

            return FusedSteps(self)
        from safemr.learning.torch_steps import AutogradSteps

        return AutogradSteps(self)

    def noise(self, count: int) -> Tensor:
        """Standard normal [count, A]."""
        size, device = (count, self.action_dim), self.config.device
        return torch.randn(size, generator=self._generator, device=device)

    def act(self, observations: Tensor) -> Tensor:
        """Exploring actions [N, A] in (-1, 1) for transformed observations [N, D]."""
        return self.steps.sample(observations, self.noise(len(observations)))[0]

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

    def constraint_target(self, batch: Batch) -> Tensor:
        """What Q_phi regresses on, [B]; here max(g, floor), no bootstrap."""
        return constraint_values(batch, self.zeta, self.d_min, self.config)

    @torch.no_grad()
    def critic_targets(self, batch: Batch) -> Tensor:
        """What the critics regress on, [3, B]: twice the soft return, then the constraint."""
        noise = self.noise(len(batch.returns))
        following, log_density = self.steps.next_values(batch.bootstraps, noise)
        soft = reward_target(
            batch.returns, batch.discounts, following, log_density, self.log_temperature.exp()
        )
        constraint = self.config.constraint_scale * self.constraint_target(batch)
        return torch.stack((soft,) * REWARD_CRITICS + (constraint,))

    def update(self, drawn: Batch, parts: int, measure: bool = False) -> Info:
        """``parts`` gradient steps (Algorithm 1), each on its share of the transitions drawn.

        The regression targets of all of them are formed at once, with the networks as they are at
        the start: the target networks move 0.5% a step, and one large product costs far less than
        several small ones. With ``measure`` returns the metrics of the last step of each kind.
        """
        config, steps = self.config, self.steps
        targets = self.critic_targets(drawn)
        info: Info = {}
        for batch, target in zip(drawn.split(parts), targets.chunk(parts, 1), strict=True):
            self._set_learning_rates()
            self.updates += 1
            info |= steps.update_critics(batch, target, measure)
            if self.updates % config.policy_delay == 0:
                with_multiplier = self.updates % config.multiplier_delay == 0
                info |= steps.update_policy(batch, with_multiplier, measure)
            info |= self.update_certificate(batch)
        steps.follow_critics(1.0 - (1.0 - config.polyak) ** parts)
        if not measure:
            return {}
        violating = targets[REWARD_CRITICS] > 0
        return info | {"violating_share": violating.float().mean()}

    def update_certificate(self, batch: Batch) -> Info:
        """FAC keeps zeta; JointSIS and SafeMR move it. Returns metrics."""
        return {}

    def _set_learning_rates(self) -> None:
        share = 1.0 - (1.0 - self.config.lr_final) * min(self.updates / self.total_updates, 1.0)
        for optimiser in self.optimisers.values():
            optimiser.param_groups[0]["lr"] = optimiser.defaults["lr"] * share

    def metrics(self) -> dict[str, float]:
        """State of the agent for the log: zeta and the temperature."""
        sigma, k, n = self.zeta.tolist()
        return {
            "sigma": sigma,
            "k": k,
            "n": n,
            "temperature": float(self.log_temperature.detach().exp()),
            "updates": float(self.updates),
        }

    def extras(self) -> dict[str, Any]:
        """What figures need beside the policy: lambda's network and zeta."""
        return {
            **network_arrays("multiplier", self.multiplier),
            "multiplier_cap": np.array(self.config.multiplier_cap),
            "zeta": self.zeta.detach().cpu().numpy().copy(),
            "length_scale": np.array(self.config.length_scale),
        }

    def state_dict(self) -> dict[str, Any]:
        networks = ("critics", "targets", "policy", "multiplier")
        return {
            "updates": self.updates,
            "noise": self._generator.get_state(),
            "zeta": self.zeta.detach(),
            "log_temperature": self.log_temperature.detach(),
            "networks": {name: getattr(self, name).parameters.detach() for name in networks},
            "optimisers": {name: o.state_dict() for name, o in self.optimisers.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.updates = int(state["updates"])
        self._generator.set_state(state["noise"].cpu())
        with torch.no_grad():
            self.zeta.copy_(state["zeta"])
            self.log_temperature.copy_(state["log_temperature"])
        for name, values in state["networks"].items():
            getattr(self, name).load(values)
        for name, optimiser in self.optimisers.items():
            optimiser.load_state_dict(state["optimisers"][name])
        self.steps = self._make_steps()


class Trainer(off_policy.Trainer):
    """The off-policy loop around this file's `Agent`."""

    agent_type: ClassVar[Any] = Agent
