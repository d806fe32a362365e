"""The environment's side of the off-policy loop: random actions first, exploration, transitions.

What acts and what becomes of a transition, the caller says: the loop of one process
(`safemr.learning.off_policy`) or a sampler of the parallel one (`safemr.parallel`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

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


class Acting:
    """Environments and everything that decides what happens in them, but for the policy.

    config: a `safemr.learning.soft_actor_critic.SoftActorCriticConfig`; make_envs: number of
    sub-environments -> batched environment; total_steps: control steps of the whole run, which the
    schedules span.
    """

    def __init__(self, config: Any, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        self.config, self.step = config, 0
        self.envs = make_envs(config.num_envs)
        self.interface = interface_of(self.envs)
        # Control steps of a decision of all sub-environments; short ones have fewer.
        self._stride = config.num_envs * self.interface.action_repeat
        space = self.envs.single_action_space
        if not isinstance(space, gym.spaces.Box):
            raise TypeError(f"continuous actions are required, found {space}")
        self.action_dim = int(np.prod(space.shape))
        self.transform = ObservationTransform.for_envs(self.envs, self.interface.decode)
        self.normaliser = Normaliser(self.transform, total_steps)
        self._exploring_until = config.explore_until * total_steps
        self._random_actions = generator(seed, 3)
        self._held = torch.zeros(config.num_envs, self.action_dim)
        self._left = torch.zeros(config.num_envs, dtype=torch.int64)  # decisions of exploration
        self.episodes = EpisodeStatistics(config.num_envs)
        observations, infos = self.envs.reset(seed=environment_seed(seed, 4))
        self._observations: NDArray[np.float32] = self.transform(observations)
        self._features = self._energy_features(infos)
        self.normaliser.observe(self._observations, self.step)
        self.normaliser.follow()

    @staticmethod
    def _energy_features(infos: Mapping[str, Any]) -> NDArray[np.float32]:
        """d and d_dot side by side, [N, 2 M]."""
        return np.concatenate((infos["d"], infos["d_dot"]), 1).astype(np.float32)

    def interact(self, act: Callable[[Tensor], Tensor]) -> dict[str, Tensor]:
        """One decision of every sub-environment: what `Replay.add` takes of it.

        act: transformed observations [N, D] -> exploring actions [N, A] in (-1, 1), which it is
        asked for once the random ones are done.
        """
        config = self.config
        if self.step < config.start_steps:
            if self.step // self._stride % config.start_hold == 0:
                self._held.uniform_(-1.0, 1.0, generator=self._random_actions)
            action = self._held
        else:
            seen = torch.from_numpy(self.normaliser(self._observations))
            action = act(seen.to(config.device)).cpu()
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
        self.episodes.update(rewards, terminated, truncated, infos)
        self._observations, self._features = observations, features
        self.step += control_steps(infos, config.num_envs)
        self.normaliser.observe(reached, self.step)
        self.normaliser.follow()
        return {"actions": action, **{n: torch.from_numpy(v) for n, v in fields.items()}}

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

    def acting_state(self) -> dict[str, Any]:
        """Everything that its next decisions depend on."""
        return {
            "step": self.step,
            "random_actions": self._random_actions.get_state(),
            "held": self._held,
            "exploring": self._left,
            "episodes": self.episodes.state_dict(),
            "observations": self._observations,
            "features": self._features,
            "normaliser": self.normaliser.state_dict(),
            "envs": self.envs.get_state(),
        }

    def load_acting_state(self, state: Mapping[str, Any]) -> bool:
        """Takes over an `acting_state`; whether the running episodes go on, which they do not in
        an environment without snapshots."""
        self.step = int(state["step"])
        self._random_actions.set_state(torch.as_tensor(state["random_actions"]))
        self._held.copy_(torch.as_tensor(state["held"]))
        if "exploring" in state:  # checkpoints were once without
            self._left.copy_(torch.as_tensor(state["exploring"]))
        self.episodes.load_state_dict(state["episodes"])
        # np.array keeps the order in memory, which decides how products with them round.
        self._observations = np.array(state["observations"], np.float32)
        self._features = np.array(state["features"], np.float32)
        if "normaliser" in state:
            self.normaliser.load_state_dict(state["normaliser"])
        begun = self.envs.set_state(state["envs"])
        if begun is None:
            return True
        observations, infos = begun
        self._observations = self.transform(observations)
        self._features = self._energy_features(infos)
        self.episodes.abandon()
        return False
