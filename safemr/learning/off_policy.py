"""The off-policy training loop: act, store, update, written once for every off-policy algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from safemr.learning.contract import MakeEnvs, check_finite, environment_seed, generator
from safemr.learning.episode_statistics import EpisodeStatistics
from safemr.learning.interface import control_steps, interface_of
from safemr.learning.normalisation import Normaliser
from safemr.learning.observation import ObservationTransform
from safemr.learning.policies import Policy
from safemr.learning.replay import Replay

# Metrics are read off one update in this many: a multiple of every delay in use.
MEASURE_EVERY = 16


class Trainer:
    """Trains ``agent_type`` (a `safemr.learning.soft_actor_critic.SoftActorCritic`).

    config: the algorithm's Config; make_envs: number of sub-environments -> batched environment;
    total_steps: environment steps of the whole run, which the learning-rate schedules span.
    """

    family: ClassVar[str] = "off_policy"
    agent_type: ClassVar[Any]

    def __init__(self, config: Any, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        self.config, self.step = config, 0
        self.envs = make_envs(config.num_envs)
        self.interface = interface_of(self.envs)
        # Control steps of a decision of all sub-environments; short ones have fewer.
        self._stride = config.num_envs * self.interface.action_repeat
        space = self.envs.single_action_space
        if not isinstance(space, gym.spaces.Box):
            raise TypeError(f"continuous actions are required, found {space}")
        action_dim = int(np.prod(space.shape))
        self.transform = ObservationTransform.for_envs(self.envs, self.interface.decode)
        self.normaliser = Normaliser(self.transform, total_steps)
        steps_an_update = config.update_every * self.interface.action_repeat
        updates = max(total_steps - config.start_steps, 0) // steps_an_update
        self._exploring_until = config.explore_until * total_steps
        self.agent = self.agent_type(
            config, self.transform.dim, action_dim, self.envs.d_min, seed, updates
        )
        self.replay = Replay(
            max(config.replay_capacity // config.num_envs, config.n_step),
            config.num_envs,
            self.transform.dim,
            action_dim,
            self.envs.num_obstacles,
            gamma=config.gamma,
            n_step=config.n_step,
            device=config.device,
        )
        self._sampling = generator(seed, 2)  # rows are drawn on the CPU and looked up on the device
        self._random_actions = generator(seed, 3)
        self._held = torch.zeros(config.num_envs, action_dim)
        self._left = torch.zeros(config.num_envs, dtype=torch.int64)  # decisions of exploration
        self._episodes = EpisodeStatistics(config.num_envs)
        self._owed = 0.0  # gradient steps earned by experience, not yet done
        observations, infos = self.envs.reset(seed=environment_seed(seed, 4))
        self._observations: NDArray[np.float32] = self.transform(observations)
        self._features = self._energy_features(infos)
        self.normaliser.observe(self._observations, self.step)
        self.normaliser.follow()

    @staticmethod
    def _energy_features(infos: Mapping[str, Any]) -> NDArray[np.float32]:
        """d and d_dot side by side, [N, 2 M]."""
        return np.concatenate((infos["d"], infos["d_dot"]), 1).astype(np.float32)

    def advance(self, until: int) -> dict[str, float]:
        """Trains until at least ``until`` steps; returns the means over the interval."""
        config = self.config
        sums: dict[str, float] = {}
        counts: dict[str, int] = {}
        while self.step < until:
            self._interact()
            if self.step < config.start_steps:
                continue
            self._owed += config.num_envs / config.update_every
            updates = int(self._owed)
            if updates < config.updates_together:
                continue
            self._owed -= updates
            drawn = self.replay.sample(updates * config.batch_size, self._sampling)
            drawn = self.normaliser.batch(drawn)
            done = self.agent.updates
            measure = (done + updates) // MEASURE_EVERY > done // MEASURE_EVERY
            info = self.agent.update(drawn, updates, measure)
            values = {name: float(value) for name, value in info.items()}
            check_finite(self.step, values)
            for name, value in values.items():
                sums[name] = sums.get(name, 0.0) + value
                counts[name] = counts.get(name, 0) + 1
        metrics = {name: total / counts[name] for name, total in sums.items()}
        metrics |= self.agent.metrics()
        check_finite(self.step, metrics)
        return metrics | {f"train_{name}": v for name, v in self._episodes.pop().items()}

    def _interact(self) -> None:
        """One decision of every sub-environment."""
        config = self.config
        device = config.device
        if self.step < config.start_steps:
            if self.step // self._stride % config.start_hold == 0:
                self._held.uniform_(-1.0, 1.0, generator=self._random_actions)
            action = self._held
        else:
            seen = torch.from_numpy(self.normaliser(self._observations))
            action = self.agent.act(seen.to(device)).cpu()
            check_finite(self.step, {"action": float(action.sum())})
            if config.explore_share > 0.0:
                action = self._explore(action)
        raw, rewards, terminated, truncated, infos = self.envs.step(action.numpy())
        observations, features = self.transform(raw), self._energy_features(infos)
        reached, reached_features = observations, features
        done = terminated | truncated
        if done.any():
            # After an autoreset these belong to the new episode; the transition needs the old one.
            final = infos["final_info"]
            reached, reached_features = observations.copy(), features.copy()
            reached[done] = self.transform(infos["final_obs"][done])
            reached_features[done] = self._energy_features(final)[done]
        fields = {
            "observations": self._observations,
            "next_observations": reached,
            "rewards": rewards.astype(np.float32),
            "terminated": terminated.astype(np.float32),
            "ended": done.astype(np.float32),
            "costs": np.asarray(infos["cost"], np.float32),
            "distances": np.concatenate((self._features, reached_features), 1),
        }
        tensors = {name: torch.from_numpy(value) for name, value in fields.items()}
        self.replay.add(actions=action, **tensors)
        self._episodes.update(rewards, terminated, truncated, infos)
        self._observations, self._features = observations, features
        self.step += control_steps(infos, config.num_envs)
        self.normaliser.observe(reached, self.step)
        self.normaliser.follow()

    def _explore(self, actions: Tensor) -> Tensor:
        """The policy's actions [N, A], or random ones that are held for several decisions.

        Temporally extended epsilon-greedy exploration (Dabney et al., arXiv:2006.01782), except
        that durations are uniform and its probability falls linearly to 0, so that the violations
        logged towards the end are the policy's.
        """
        config, draw = self.config, self._random_actions
        count = config.num_envs
        fading = max(1.0 - self.step / max(self._exploring_until, 1.0), 0.0)
        begin = torch.rand(count, generator=draw) < config.explore_share * fading
        begin &= self._left == 0
        lengths = torch.randint(
            config.explore_hold_min, config.explore_hold_max + 1, (count,), generator=draw
        )
        random = torch.empty_like(actions).uniform_(-1.0, 1.0, generator=draw)
        self._held = torch.where(begin[:, None], random, self._held)
        self._left = torch.where(begin, lengths, self._left)
        exploring = self._left > 0
        self._left = (self._left - 1).clamp_min(0)
        return torch.where(exploring[:, None], self._held, actions)

    @property
    def policy(self) -> Policy:
        """The current policy with what figures need of the run: lambda's network and zeta."""
        return Policy(
            self.normaliser.settled(self.transform),
            self.agent.policy,
            squash=True,
            extras=self.agent.extras(),
            interface=self.interface,
        )

    def state_dict(self) -> dict[str, Any]:
        return {
            "step": self.step,
            "owed": self._owed,
            "agent": self.agent.state_dict(),
            "replay": self.replay.state_dict(),
            "sampling": self._sampling.get_state(),
            "random_actions": self._random_actions.get_state(),
            "held": self._held,
            "exploring": self._left,
            "episodes": self._episodes.state_dict(),
            "observations": self._observations,
            "features": self._features,
            "normaliser": self.normaliser.state_dict(),
            "envs": self.envs.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.step, self._owed = int(state["step"]), float(state["owed"])
        self.agent.load_state_dict(state["agent"])
        self.replay.load_state_dict(state["replay"])
        self._sampling.set_state(torch.as_tensor(state["sampling"]))
        self._random_actions.set_state(torch.as_tensor(state["random_actions"]))
        self._held.copy_(torch.as_tensor(state["held"]))
        if "exploring" in state:  # checkpoints were once without
            self._left.copy_(torch.as_tensor(state["exploring"]))
        self._episodes.load_state_dict(state["episodes"])
        # np.array keeps the order in memory, which decides how products with them round.
        self._observations = np.array(state["observations"], np.float32)
        self._features = np.array(state["features"], np.float32)
        if "normaliser" in state:
            self.normaliser.load_state_dict(state["normaliser"])
        begun = self.envs.set_state(state["envs"])
        if begun is not None:
            observations, infos = begun
            self._observations = self.transform(observations)
            self._features = self._energy_features(infos)
            self._episodes.abandon()
            self.replay.cut()
