"""The on-policy family's training loop: collect, estimate advantages, move the policy, fit critics.

PPO-Lagrangian, TRPO-Lagrangian and CPO override `OnPolicyTrainer.update_policy` and nothing else of
the loop. The order within an epoch is that of safety-starter-agents: multiplier, policy, critics.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from safemr.learning.adam import Adam
from safemr.learning.contract import MakeEnvs, check_finite, environment_seed, generator
from safemr.learning.episode_statistics import EpisodeStatistics
from safemr.learning.gaussian import GaussianActor, entropy, log_density, ratio_and_kl
from safemr.learning.hyperparameters import Hyperparameters, Setting
from safemr.learning.interface import control_steps, interface_of
from safemr.learning.networks import ACTIVATIONS, Activation, StackedMLP
from safemr.learning.normalisation import Normaliser
from safemr.learning.observation import ObservationTransform
from safemr.learning.policies import Policy
from safemr.learning.rollouts import Batch, Rollout, gae, minibatches
from safemr.learning.trust_region import Region, TorchRegion

if TYPE_CHECKING:
    from safemr.learning.on_policy_steps import FusedSteps

# Settings of the published experiments (safety-starter-agents) that differ from the defaults here;
# the algorithms add their own. Networks and epoch are those of the JointSIS authors' comparison.
PUBLISHED: dict[str, Any] = {
    "num_envs": 8,
    "epoch_steps": 8_000,
    "hidden": 256,
    "value_passes": 80,
    "value_batch": 8_000,
}


@dataclass(frozen=True)
class OnPolicyConfig(Hyperparameters):
    """What the on-policy algorithms share.

    A sample is a decision: an action held for the interface's ``action_repeat`` control steps
    (`safemr.learning.interface`), usually one.
    """

    cost_limit: float = 0.0  # of an episode's undiscounted cost
    # discount of the reward, a decision; below 1, as time limits are bootstrapped through
    gamma: float = 0.99
    cost_gamma: float = 0.99  # discount of the cost, a decision
    gae_lambda: float = 0.97  # lambda of the reward's generalised advantages (GAE)
    cost_gae_lambda: float = 0.97  # lambda of the cost's
    target_kl: float = 0.01  # PPO: stop beyond kl_stop times it; trust region: its radius

    num_envs: int = 8  # environments stepped together
    epoch_steps: int = 8_000  # control steps between two updates, over all environments

    hidden: int = 64  # units of each of the two hidden layers
    activation: Activation = "tanh"  # of the hidden layers
    initial_log_std: float = -0.5  # log of the policy's standard deviation at the start
    value_lr: float = 1e-3  # learning rate of both critics
    value_passes: int = 8  # over the epoch's data, for both critics
    value_batch: int = 500  # samples a critic step; at most the whole epoch
    backend: Literal["torch", "fused"] = "torch"  # PyTorch, or numba's kernels, which are faster

    RANGES: ClassVar[Mapping[str, str]] = {
        "cost_limit": "[0, inf)",
        **dict.fromkeys(("gamma", "cost_gamma"), "[0, 1)"),
        **dict.fromkeys(("gae_lambda", "cost_gae_lambda"), "[0, 1]"),
        "target_kl": "(0, 1]",
        "num_envs": "[1, 4096]",
        "epoch_steps": "[1, 1e8]",
        "hidden": "[1, 4096]",
        "initial_log_std": "[-10, 2]",  # actions are clipped to [-1, 1]
        "value_lr": "(0, 1]",  # Adam moves every parameter by about its rate a step
        **dict.fromkeys(("value_passes", "value_batch"), "[1, inf)"),
    }
    ADDED: ClassVar[frozenset[str]] = frozenset({"backend"})
    CHOICES: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "activation": ACTIVATIONS,
        "backend": ("torch", "fused"),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require(
            "epoch_steps",
            self.epoch_steps % self.num_envs == 0,
            f"must be a multiple of num_envs = {self.num_envs}",
        )

    def check_setting(self, setting: Setting) -> None:
        self.require(
            "epoch_steps",
            self.epoch_steps <= setting.total_steps,
            f"must not exceed the budget of {setting.total_steps} steps",
        )
        stride = self.num_envs * setting.action_repeat
        self.require(
            "epoch_steps",
            self.epoch_steps % stride == 0,
            f"must be a multiple of num_envs x action_repeat = {stride}",
        )


def explained_variance(predictions: np.ndarray, targets: np.ndarray) -> float:
    """1 - Var(targets - predictions) / Var(targets); nan where the targets do not vary."""
    variance = targets.var()
    return float(1.0 - (targets - predictions).var() / variance) if variance > 0 else float("nan")


class OnPolicyTrainer(ABC):
    """The loop; `safemr.learning.contract.Trainer` says what its public methods mean."""

    family: ClassVar[str] = "on_policy"

    def __init__(
        self, config: OnPolicyConfig, make_envs: MakeEnvs, seed: int, total_steps: int
    ) -> None:
        self.config, self.step = config, 0
        self.envs = make_envs(config.num_envs)
        self.interface = interface_of(self.envs)
        self.transform = ObservationTransform.for_envs(self.envs, self.interface.decode)
        self.normaliser = Normaliser(self.transform, total_steps)
        inputs, actions = self.transform.dim, int(np.prod(self.envs.single_action_space.shape))
        sizes, weights = (inputs, config.hidden, config.hidden), generator(seed, 0)
        network = StackedMLP(
            1, (*sizes, actions), config.activation, generator=weights, output_gain=0.01
        )
        self.actor = GaussianActor(network, torch.full((actions,), config.initial_log_std))
        self.critics = StackedMLP(2, (*sizes, 1), config.activation, generator=weights)
        self.critic_optimizer = Adam([self.critics.parameters], config.value_lr)
        self.fused = self._fused() if config.backend == "fused" else None
        self.noise, self.order = generator(seed, 1), generator(seed, 2)
        self.rollout = Rollout(
            config.epoch_steps // (config.num_envs * self.interface.action_repeat),
            config.num_envs,
            inputs,
            actions,
        )
        self.statistics = EpisodeStatistics(config.num_envs)
        self.observations, _ = self.envs.reset(seed=environment_seed(seed, 3))
        self._seen(self.observations)
        self.normaliser.follow()

    def _fused(self) -> FusedSteps:
        from safemr.learning.on_policy_steps import FusedSteps  # compiled when it is asked for

        return FusedSteps(self.actor, self.critics)

    @property
    def policy(self) -> Policy:
        """The current policy; it follows further training."""
        return Policy(
            self.normaliser.settled(self.transform),
            self.actor.network,
            squash=False,
            log_std=self.actor.log_std.detach(),
            interface=self.interface,
        )

    @abstractmethod
    def update_policy(self, batch: Batch) -> dict[str, float]:
        """Moves the actor (and a multiplier) by one epoch's data; returns metrics."""

    def advance(self, until: int) -> dict[str, float]:
        """Whole epochs until ``step`` >= until; metrics are means over those epochs."""
        epochs: list[dict[str, float]] = []
        while self.step < until:
            epochs.append(self._epoch())
        metrics = {
            name: float(np.mean([row[name] for row in epochs if name in row]))
            for name in sorted({name for row in epochs for name in row})
        }
        metrics |= {f"train_{name}": value for name, value in self.statistics.pop().items()}
        check_finite(self.step, metrics)
        return metrics

    def _seen(self, observations: np.ndarray) -> np.ndarray:
        """Raw observations [N, obs] as the networks see them in this epoch, [N, D]."""
        read = self.transform(observations)
        self.normaliser.observe(read, self.step)
        return self.normaliser(read)

    def _epoch(self) -> dict[str, float]:
        batch, metrics = self._collect()
        metrics |= self.update_policy(batch)
        metrics["kl"] = self._divergence(batch)
        metrics["entropy"] = entropy(self.actor.log_std)
        metrics |= self._fit_critics(batch)
        self.normaliser.follow()  # between two epochs: one rollout is read in one way
        return metrics

    @torch.no_grad()
    def _divergence(self, batch: Batch) -> float:
        """E_s[KL(pi_old || pi)]."""
        if self.fused:
            return self.fused.surrogates(batch)[2]
        return float(ratio_and_kl(self.actor, batch)[1])

    def region(self, batch: Batch) -> Region:
        """The trust region's derivatives at the actor as it is."""
        return self.fused.region(batch) if self.fused else TorchRegion(self.actor, batch)

    def _act(self, observations: np.ndarray, perturbation: np.ndarray) -> np.ndarray:
        """Mean actions plus a perturbation, [N, A], for transformed observations [N, D]."""
        if self.fused:
            return self.fused.act(observations, perturbation)
        mean = self.actor.mean(torch.from_numpy(observations))
        return (mean + torch.from_numpy(perturbation)).numpy()

    def _collect(self) -> tuple[Batch, dict[str, float]]:
        """One rollout with the current policy, and its advantages."""
        config, rollout = self.config, self.rollout
        episodes_before, steps = len(self.statistics.finished), 0
        rollout.clear()
        std = self.actor.log_std.detach().exp()
        noise = std * torch.randn(rollout.actions.shape, generator=self.noise)
        with torch.no_grad():
            for perturbation in noise.numpy():
                inputs = self._seen(self.observations)
                actions = self._act(inputs, perturbation)
                self.observations, rewards, terminated, truncated, infos = self.envs.step(actions)
                self.statistics.update(rewards, terminated, truncated, infos)
                steps += control_steps(infos, config.num_envs)
                finals = None
                if truncated.any():
                    finals = self._seen(infos["final_obs"])
                rollout.add(inputs, actions, rewards, infos["cost"], terminated, truncated, finals)
            rollout.close(self._seen(self.observations))
        self.step += steps
        return self._batch(episodes_before, steps)

    def _batch(self, episodes_before: int, steps: int) -> tuple[Batch, dict[str, float]]:
        config, rollout = self.config, self.rollout
        values, following = rollout.values(self.fused.values if self.fused else self.critics)
        advantages, returns = np.empty_like(values), np.empty_like(values)
        settings = (
            (config.gamma, config.gae_lambda),
            (config.cost_gamma, config.cost_gae_lambda),
        )
        for signal, (gamma, lam) in enumerate(settings):
            arrays = (rollout.signals[signal], values[signal], following[signal], rollout.ended)
            advantages[signal] = gae(*arrays, gamma, lam)
            returns[signal] = values[signal] + gae(*arrays, gamma, 1.0)
        values, returns = values.reshape(2, -1), returns.reshape(2, -1)
        advantages = advantages.reshape(2, -1)
        advantages -= advantages.mean(1, keepdims=True)
        advantages[0] /= advantages[0].std() + 1e-8
        reward_advantages, cost_advantages = torch.from_numpy(advantages).float()
        observations = rollout.observations[:-1].flatten(0, 1)
        actions = rollout.actions.flatten(0, 1)
        with torch.no_grad():
            mean = (self.fused or self.actor).mean(observations)
            log_std = self.actor.log_std.detach().clone()
            densities = log_density(actions, mean, log_std)
        episode_cost, episode_length = self.episode_cost(episodes_before, steps)
        batch = Batch(
            observations,
            actions,
            mean,
            log_std,
            densities,
            reward_advantages,
            cost_advantages,
            torch.from_numpy(returns).float(),
            episode_cost,
            episode_length * len(actions) / steps,
        )
        metrics = {"epoch_cost": episode_cost}
        for name, prediction, target in zip(("reward", "cost"), values, returns, strict=True):
            share = explained_variance(prediction, target)
            if np.isfinite(share):
                metrics[f"explained_variance_{name}"] = share
        return batch, metrics

    def episode_cost(self, episodes_before: int, steps: int) -> tuple[float, float]:
        """EpCost and episode length: means over the episodes that finished in this epoch.

        In an epoch without one, the epoch's cost a control step (of ``steps``) times the time
        limit, which has the same mean where episodes end by their time limit only.
        """
        finished = self.statistics.finished[episodes_before:]
        if len(finished) == 0:
            rate = float(self.rollout.signals[1].sum()) / steps
            return rate * self.envs.max_episode_steps, float(self.envs.max_episode_steps)
        names = self.statistics.names
        means = finished.mean(0)
        return float(means[names.index("cost")]), float(means[names.index("length")])

    def _fit_critics(self, batch: Batch) -> dict[str, float]:
        """Regression of both critics on the discounted returns; Adam treats them as independent."""
        config, losses = self.config, []
        for _ in range(config.value_passes):
            for indices in minibatches(len(batch.actions), config.value_batch, self.order):
                losses.append(self._value_step(batch, indices))
        reward_loss, cost_loss = torch.stack(losses).mean(0).tolist()
        return {"value_loss": reward_loss, "cost_value_loss": cost_loss}

    def _value_step(self, batch: Batch, indices: Tensor | slice) -> Tensor:
        """One step on a minibatch; the losses of both critics before it, [2]."""
        if self.fused:
            return self.fused.value_step(batch, indices, self.critic_optimizer)
        values = self.critics(batch.observations[indices]).squeeze(-1)
        errors = values - batch.returns[:, indices]
        loss = errors.square().mean(1)
        (self.critics.parameters.grad,) = torch.autograd.grad(loss.sum(), self.critics.parameters)
        self.critic_optimizer.step()
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "actor": self.actor.flat(),
            "critics": self.critics.parameters.detach().clone(),
            "critic_optimizer": copy.deepcopy(self.critic_optimizer.state_dict()),
            "noise": self.noise.get_state(),
            "order": self.order.get_state(),
            "observations": self.observations,
            "statistics": self.statistics.state_dict(),
            "normaliser": self.normaliser.state_dict(),
            "envs": self.envs.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.step = int(state["step"])
        self.actor.load_flat(state["actor"])
        self.critics.load(state["critics"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        self.noise.set_state(state["noise"])
        self.order.set_state(state["order"])
        self.observations = np.array(state["observations"])  # in the same order in memory
        self.statistics.load_state_dict(state["statistics"])
        if "normaliser" in state:
            self.normaliser.load_state_dict(state["normaliser"])
        begun = self.envs.set_state(state["envs"])
        if begun is not None:
            self.observations, _ = begun
            self.statistics.abandon()
