"""Observations without bounds: a running mean and standard deviation, settled early in a run.

Of an environment from outside only the spaces are known. Columns with finite bounds are scaled by
them, once and for all (`ObservationTransform.for_space`). The others are shifted by their mean and
divided by their standard deviation over what the run has observed, the episodes' first observations
included, until a share `SETTLED` of its steps is done; from then on these, too, are constants.

Why they settle: a policy, critics and a certificate are functions of what they are shown. As long
as the statistics move, all of them change without being trained, the learning rates that could
follow fall to the end, and what a certificate says of a state depends on when it is asked. Why not
before the run: random actions alone do not show what a policy reaches. The replay memory keeps
observations as they came, so that old and new ones are always read alike. Evaluations, policy file
and checkpoint have the statistics of their moment, hence a saved policy acts as it was evaluated.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from safemr.learning.observation import ObservationTransform
from safemr.learning.replay import Batch

SETTLED = 0.1  # share of a run's steps after which the statistics are constants
LARGEST = 10.0  # standard deviations beyond which an observation is clipped


class Normaliser:
    """Standardises the columns of a transform that it leaves ``unscaled``; without any, nothing.

    transform: reads the raw observations; total_steps: of the run.
    """

    def __init__(self, transform: ObservationTransform, total_steps: int) -> None:
        self.columns = transform.unscaled
        self._until = SETTLED * total_steps
        self._count = 0
        self._mean = np.zeros(len(self.columns))
        self._squares = np.zeros(len(self.columns))  # of deviations from the mean, summed
        self._shift = np.zeros(transform.dim, np.float32)
        self._scale = np.ones(transform.dim, np.float32)
        self._clip = np.full(transform.dim, np.inf, np.float32)
        self._clip[self.columns] = LARGEST

    def observe(self, observations: NDArray[np.floating], step: int) -> None:
        """Take in transformed observations [N, dim], seen at a step of the run.

        What it says of observations does not change before `follow`.
        """
        if not len(self.columns) or step > self._until:
            return
        rows = observations[:, self.columns].astype(float)
        mean, total = rows.mean(0), self._count + len(rows)
        difference = mean - self._mean
        self._squares += ((rows - mean) ** 2).sum(0)
        self._squares += difference**2 * (self._count * len(rows) / total)
        self._mean += difference * (len(rows) / total)
        self._count = total

    def follow(self) -> None:
        """Standardise by all that was observed so far."""
        if not self._count:
            return
        deviation = np.sqrt(self._squares / self._count)
        # What has not moved yet is only shifted.
        moves = deviation > 1e-6 * (1.0 + np.abs(self._mean))
        self._shift[self.columns] = self._mean
        self._scale[self.columns] = 1.0 / np.where(moves, deviation, 1.0)

    def __call__(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Transformed observations [..., dim] as the networks see them."""
        if not len(self.columns):
            return observations
        return np.clip((observations - self._shift) * self._scale, -self._clip, self._clip)

    def batch(self, drawn: Batch) -> Batch:
        """A batch of the replay memory as the networks see it."""
        if not len(self.columns):
            return drawn
        device = drawn.returns.device
        seen = (self(rows.cpu().numpy()) for rows in (drawn.observations, drawn.bootstraps))
        observations, bootstraps = (torch.from_numpy(rows).to(device) for rows in seen)
        return drawn._replace(observations=observations, bootstraps=bootstraps)

    def settled(self, transform: ObservationTransform) -> ObservationTransform:
        """The transform and the statistics of this moment in one, which is what a policy keeps."""
        if not len(self.columns):
            return transform
        shift, scale, clip = transform.shift, transform.scale.copy(), transform.clip.copy()
        shift = np.zeros(transform.dim) if shift is None else shift.copy()
        shift[self.columns] = self._shift[self.columns]
        scale[self.columns] = self._scale[self.columns]
        clip[self.columns] = self._clip[self.columns]
        return ObservationTransform(transform.columns, scale, clip, transform.width, shift=shift)

    def state_dict(self) -> dict[str, Any]:
        return {
            "count": self._count,
            "mean": self._mean.copy(),
            "squares": self._squares.copy(),
            "shift": self._shift.copy(),
            "scale": self._scale.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._count = int(state["count"])
        self._mean[:], self._squares[:] = state["mean"], state["squares"]
        self._shift[:], self._scale[:] = state["shift"], state["scale"]
