"""On-policy storage and generalised advantage estimation (Schulman et al., arXiv:1506.02438).

A rollout is T steps of N environments that restart by themselves (Gymnasium's SAME_STEP): where an
episode ends at step t, the observation stored for t + 1 belongs to the next episode, and the
observation in which the episode ended arrives apart. Values are therefore bootstrapped from that
final observation where the episode was truncated, from nothing where it terminated, and from the
stored successor everywhere else, the cut at the end of the rollout included.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


def gae(
    rewards: np.ndarray,
    values: np.ndarray,
    next_values: np.ndarray,
    ended: np.ndarray,
    gamma: float,
    lam: float,
) -> np.ndarray:
    """A_t = delta_t + gamma lam A_{t+1}, delta_t = r_t + gamma V(s_{t+1}) - V(s_t); all [T, N].

    ``ended`` (bool) marks the last step of an episode: the sum stops there. ``next_values`` holds
    V of the state reached by each step, 0 where it was terminal. With lam = 1, A + V is the
    discounted return of the episode, bootstrapped where it was cut.
    """
    advantages = rewards + gamma * next_values - values
    decay = gamma * lam * ~ended
    for t in range(len(advantages) - 2, -1, -1):
        advantages[t] += decay[t] * advantages[t + 1]
    return advantages


class Rollout:
    """T steps of N environments; rewards and costs share every array as signals 0 and 1."""

    def __init__(self, steps: int, num_envs: int, observation_dim: int, action_dim: int) -> None:
        self.observations = torch.zeros(steps + 1, num_envs, observation_dim)
        self.actions = torch.zeros(steps, num_envs, action_dim)
        self.signals = np.zeros((2, steps, num_envs))
        self.terminated = np.zeros((steps, num_envs), dtype=bool)
        self.truncated = np.zeros((steps, num_envs), dtype=bool)
        # the same memory: NumPy stores a few numbers six times faster than PyTorch
        self._observations, self._actions = self.observations.numpy(), self.actions.numpy()
        self._finals: list[tuple[int, int, np.ndarray]] = []
        self.length = 0

    def clear(self) -> None:
        """Starts the next rollout in the same memory."""
        self.length = 0
        self._finals.clear()

    def add(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        rewards: np.ndarray,
        costs: np.ndarray,
        terminated: np.ndarray,
        truncated: np.ndarray,
        final_observations: np.ndarray | None,
    ) -> None:
        """One step of all N environments.

        observations [N, D] are those acted on; final_observations [N, D] is needed where
        ``terminated | truncated`` [N] holds somewhere, and read only there.
        """
        t = self.length
        self._observations[t] = observations
        self._actions[t] = actions
        self.signals[0, t] = rewards
        self.signals[1, t] = costs
        self.terminated[t] = terminated
        self.truncated[t] = truncated
        self.length += 1
        if final_observations is not None:
            for i in np.flatnonzero(truncated & ~terminated):
                self._finals.append((t, int(i), np.array(final_observations[i])))

    def close(self, observations: np.ndarray) -> None:
        """Stores the observations [N, D] that follow the last step."""
        self._observations[self.length] = observations

    @property
    def ended(self) -> np.ndarray:
        """Where an episode ended [T, N]."""
        return self.terminated | self.truncated

    def values(self, critics: Callable[[Tensor], Tensor]) -> tuple[np.ndarray, np.ndarray]:
        """V(s_t) and V of the state reached by step t, each [2, T, N] in float64.

        ``critics`` maps observations [B, D] to [2, B, 1]: expected reward and cost.
        """
        steps, num_envs = self.terminated.shape
        rows = [self.observations.flatten(0, 1)]
        if self._finals:
            finals = np.stack([observation for _, _, observation in self._finals])
            rows.append(torch.from_numpy(finals))
        with torch.no_grad():
            outputs = critics(torch.cat(rows)).squeeze(-1).double().numpy()
        stored = outputs[:, : (steps + 1) * num_envs].reshape(2, steps + 1, num_envs)
        following = stored[:, 1:].copy()
        following[:, self.terminated] = 0.0
        for row, (t, i, _) in enumerate(self._finals, start=(steps + 1) * num_envs):
            following[:, t, i] = outputs[:, row]
        return stored[:, :-1], following


@dataclass(frozen=True)
class Batch:
    """An epoch's B samples, or some of them, and the policy that took them."""

    observations: Tensor  # [B, D], transformed
    actions: Tensor  # [B, A], before the environment's clipping
    mean: Tensor  # [B, A] of the old policy
    log_std: Tensor  # [A] of the old policy
    log_density: Tensor  # [B] of the actions under the old policy
    advantages: Tensor  # [B], standardised
    cost_advantages: Tensor  # [B], centred
    returns: Tensor  # [2, B], discounted reward and cost to go
    episode_cost: float  # EpCost, see `on_policy.OnPolicyTrainer.episode_cost`
    episode_decisions: float  # its length in decisions

    def select(self, indices: Tensor | slice) -> Batch:
        """The samples of a minibatch."""
        if isinstance(indices, slice):
            return self
        return Batch(
            self.observations[indices],
            self.actions[indices],
            self.mean[indices],
            self.log_std,
            self.log_density[indices],
            self.advantages[indices],
            self.cost_advantages[indices],
            self.returns[:, indices],
            self.episode_cost,
            self.episode_decisions,
        )


def minibatches(size: int, batch: int, generator: torch.Generator) -> Iterator[Tensor | slice]:
    """One pass over ``size`` samples in random batches; a single whole one when batch >= size.

    A remainder smaller than half a batch is dropped from this pass, so that no step is taken on a
    handful of samples.
    """
    if batch >= size:
        yield slice(None)
        return
    for indices in torch.randperm(size, generator=generator).split(batch):
        if 2 * len(indices) >= batch:
            yield indices
