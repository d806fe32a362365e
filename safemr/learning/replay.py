"""Replay memory of a batched environment, with n-step returns formed when sampling."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from envs.compiled import njit

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


class Batch(NamedTuple):
    """B transitions. ``d``, ``d_dot`` are those of s and ``d_next``, ``d_dot_next`` of s' [B, M]:
    the energy is recomputed from them, because its parameters move while the memory stays."""

    observations: Tensor  # [B, D]
    actions: Tensor  # [B, A]
    returns: Tensor  # [B] sum_{i<m} gamma^i r_{t+i}
    discounts: Tensor  # [B] gamma^m, 0 where the episode terminated within m steps
    bootstraps: Tensor  # [B, D] observation m steps ahead
    costs: Tensor  # [B] cost of the first step
    d: Tensor
    d_dot: Tensor
    d_next: Tensor
    d_dot_next: Tensor

    def split(self, parts: int) -> list[Batch]:
        """Equal consecutive parts, as views."""
        return [Batch(*fields) for fields in zip(*(f.chunk(parts) for f in self), strict=True)]


class Replay:
    """A ring of the last ``capacity`` time steps (of ``num_envs`` transitions each).

    Both observations of a transition are stored, so that the end of an episode inside the ring
    needs no special case. An n-step return stops early at the end of an episode (bootstrapping
    from the true last observation if it was truncated) and at the newest step.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        observation_dim: int,
        action_dim: int,
        num_obstacles: int,
        *,
        gamma: float,
        n_step: int,
        device: str = "cpu",
    ) -> None:
        if capacity < n_step or n_step < 1:
            raise ValueError(f"capacity {capacity} must be at least n_step {n_step} >= 1")
        self.capacity, self.num_envs, self.n_step = capacity, num_envs, n_step
        self.size = 0  # time steps held
        self._head = 0  # where the next one goes
        size, where = capacity * num_envs, torch.device(device)

        def table(*shape: int) -> Tensor:
            # numpy asks the system for huge pages, from which random rows are read faster
            return torch.from_numpy(np.zeros((size, *shape), np.float32)).to(where)

        self._fields = {
            "observations": table(observation_dim),
            "next_observations": table(observation_dim),
            "actions": table(action_dim),
            "rewards": table(),
            "terminated": table(),
            "ended": table(),
            "costs": table(),
            # d, d_dot of s, then of s'
            "distances": table(4 * num_obstacles),
        }
        self._discount = gamma ** torch.arange(n_step + 1, dtype=torch.float64)
        self._discount = self._discount.float().to(where)
        self._lags = torch.arange(n_step, device=where)

    def add(self, **step: Tensor) -> None:
        """Stores one time step; every field [num_envs, ...], flags as 0 or 1."""
        rows = slice(self._head * self.num_envs, (self._head + 1) * self.num_envs)
        for name, table in self._fields.items():
            table[rows] = step[name]
        self._head = (self._head + 1) % self.capacity
        self.size = min(self.size + 1, self.capacity)

    def cut(self) -> None:
        """What was added last is not continued: its episodes end there, as if truncated."""
        newest = (self._head - 1) % self.capacity * self.num_envs
        self._fields["ended"][newest : newest + self.num_envs] = 1.0

    def sample(self, count: int, generator: torch.Generator) -> Batch:
        """``count`` transitions, uniformly with replacement."""
        flat = torch.randint(self.size * self.num_envs, (count,), generator=generator)
        return self._gather(flat.to(self._lags.device))

    def _gather(self, flat: Tensor) -> Batch:
        """The transitions ``flat`` [B], counted from the oldest one held."""
        fields = self._fields
        follow = self._follow_compiled if flat.device.type == "cpu" else self._follow
        rows, last, returns, discounts = follow(flat)
        distances = fields["distances"].index_select(0, rows).chunk(4, -1)
        return Batch(
            observations=fields["observations"].index_select(0, rows),
            actions=fields["actions"].index_select(0, rows),
            returns=returns,
            discounts=discounts,
            bootstraps=fields["next_observations"].index_select(0, last),
            costs=fields["costs"].index_select(0, rows),
            d=distances[0],
            d_dot=distances[1],
            d_next=distances[2],
            d_dot_next=distances[3],
        )

    def _follow(self, flat: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """First and last row of each n-step return, the return and the bootstrap's discount."""
        fields, num_envs = self._fields, self.num_envs
        age = flat // num_envs  # 0 = oldest
        start = (self._head - self.size) % self.capacity
        # [n, B]: the rows of the following steps, as far as the episode and the ring go
        path = (age + self._lags[:, None] + start) % self.capacity * num_envs + flat % num_envs
        over = fields["ended"][path]
        over[1:] = over.cumsum(0)[:-1]
        over[0] = 0.0
        alive = (over == 0) & (age + self._lags[:, None] < self.size)
        returns = (fields["rewards"][path] * self._discount[:-1, None] * alive).sum(0)
        steps = alive.sum(0)
        last = path.gather(0, steps[None] - 1)[0]
        return path[0], last, returns, self._discount[steps] * (1.0 - fields["terminated"][last])

    def _follow_compiled(self, flat: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """`_follow` on a CPU, in a tenth of its time."""
        fields = {name: table.numpy() for name, table in self._fields.items()}
        found = _follow(
            flat.numpy(),
            (self._head - self.size) % self.capacity * self.num_envs,
            self.num_envs,
            self.size,
            fields["rewards"],
            fields["ended"],
            fields["terminated"],
            self._discount.numpy(),
        )
        rows, last, returns, discounts = map(torch.from_numpy, found)
        return rows, last, returns, discounts

    def state_dict(self) -> dict[str, Any]:
        rows = self.size * self.num_envs
        return {
            "head": self._head,
            "size": self.size,
            # Until the ring is full only its first part holds anything.
            "fields": {name: table[:rows] for name, table in self._fields.items()},
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._head, self.size = int(state["head"]), int(state["size"])
        for name, table in self._fields.items():
            stored = torch.as_tensor(state["fields"][name])
            table[: len(stored)] = stored


@njit()
def _follow(
    flat: Rows,
    first: int,
    num_envs: int,
    held: int,
    rewards: Floats,
    ended: Floats,
    terminated: Floats,
    discount: Floats,
) -> tuple[Rows, Rows, Floats, Floats]:
    """`Replay._follow`; ``first`` is the row of the oldest transition."""
    n_step = len(discount) - 1
    rows, last = np.empty_like(flat), np.empty_like(flat)
    returns, discounts = np.empty(len(flat), np.float32), np.empty(len(flat), np.float32)
    for b in range(len(flat)):
        row = (flat[b] + first) % len(rewards)
        rows[b] = row
        longest = min(held - flat[b] // num_envs, n_step)
        total, taken = rewards[row], 1
        while taken < longest and ended[row] == 0.0:
            row = (row + num_envs) % len(rewards)
            total += discount[taken] * rewards[row]
            taken += 1
        last[b], returns[b] = row, total
        discounts[b] = discount[taken] * (np.float32(1.0) - terminated[row])
    return rows, last, returns, discounts
