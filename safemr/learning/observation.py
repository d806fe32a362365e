"""From an environment's raw observation to what the networks see: fixed columns, scales and clips.

The transform is a constant of the task, so training, evaluation and a saved policy can never
disagree about it. Only an environment from outside, of which no sensor is known, may need running
statistics beside it (`safemr.learning.normalisation`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr.environments import SafetyEnvs, bounded
from safemr.errors import UserError


@dataclass(frozen=True)
class Block:
    """How one sensor is read: which of its columns, times ``scale``, clipped to +-``clip``."""

    columns: tuple[int, ...] | None = None
    scale: float = 1.0
    clip: float = np.inf


# The point robot moves in the plane, so vertical acceleration (always g), vertical velocity and the
# rates about x and y carry nothing; nor does `vases_lidar`, since the tasks that have it have no
# vases (the vase of PointGoal1 is seen by `vase_lidar`).
# Contacts and the yaw servo throw the accelerometer and the gyro far outside their usual range.
BLOCKS: Mapping[str, Block] = {
    "accelerometer": Block((0, 1), 0.1, 1.0),
    "gyro": Block((2,), 0.3, 2.0),
    "magnetometer": Block((0, 1), 2.0),
    "velocimeter": Block((0, 1)),
    "vases_lidar": Block(()),
    # Aircraft: metres over a plot box of +-20 m.
    "position": Block(None, 0.1),
}

BINS = 16  # of a lidar
DECODED = 4  # numbers that stand for a decoded lidar

NO_COLUMNS = np.zeros(0, np.int64)

UNREAD_TAIL = 1  # columns after the last one read: the vertical component of a layout's last sensor


def decoded(readings: NDArray[np.floating]) -> NDArray[np.floating]:
    """Bearing and distance of the one object that a lidar sees: [..., 16] -> [..., 4].

    An object at distance d [m] in direction (i + f) 2 pi / 16, 0 <= f < 1, leaves e^-d in bin i,
    f e^-d in the bin after it and (1 - f) e^-d in the one before (`envs.navigation_kernels`). So
    cos and sin of the bearing, d - 1 and e^-d are the same information.
    """
    nearest = readings.argmax(-1)[..., None]
    signal = np.take_along_axis(readings, nearest, -1)
    after = np.take_along_axis(readings, (nearest + 1) % BINS, -1)
    bearing = (nearest + after / signal) * (2.0 * np.pi / BINS)
    parts = (np.cos(bearing), np.sin(bearing), -np.log(signal) - 1.0, signal)
    return np.concatenate(parts, -1)


class ObservationTransform:
    """Selects, scales and clips observation columns.

    columns [dim] int64, scale [dim] and clip [dim] float32. Calling it maps [N, obs] (any float
    type, any order in memory) to float32 [N, dim] in Fortran order. width is the raw observations'
    number of columns, which a saved policy does not say unless it decodes: ``lidars`` are the first
    columns of decoded lidars, and columns from width on are those of `decoded`, lidar by lidar.
    ``shift`` [dim] float64 is subtracted first; ``unscaled`` are the columns of the output that
    nothing is known of.
    """

    def __init__(
        self,
        columns: NDArray[np.int64],
        scale: NDArray[np.float32],
        clip: NDArray[np.float32],
        width: int | None = None,
        lidars: tuple[int, ...] = (),
        shift: NDArray[np.float64] | None = None,
        unscaled: NDArray[np.int64] = NO_COLUMNS,
    ) -> None:
        self.columns, self.scale, self.clip, self.width = columns, scale, clip, width
        self.lidars, self.shift, self.unscaled = lidars, shift, unscaled
        self._clipped = np.flatnonzero(np.isfinite(clip))

    @classmethod
    def for_envs(cls, envs: SafetyEnvs, decode: Iterable[str] = ()) -> ObservationTransform:
        """By the environments' ``observation_layout``, or by their space where they have none."""
        if envs.observation_layout:
            return cls.for_layout(envs.observation_layout, decode)
        return cls.for_space(envs.single_observation_space)

    @classmethod
    def for_space(cls, space: Any) -> ObservationTransform:
        """For a Box [D]: columns with finite bounds are mapped onto [-1, 1]."""
        low, high = (np.array(bound, float) for bound in (space.low, space.high))
        within = bounded(space)
        low, high = np.where(within, low, -1.0), np.where(within, high, 1.0)
        return cls(
            np.arange(len(low)),
            (2.0 / (high - low)).astype(np.float32),
            np.full(len(low), np.inf, np.float32),
            len(low),
            shift=(high + low) / 2.0,
            unscaled=np.flatnonzero(~within),
        )

    @classmethod
    def for_layout(
        cls, layout: Mapping[str, slice], decode: Iterable[str] = ()
    ) -> ObservationTransform:
        """For an environment's ``observation_layout``; an unlisted sensor is kept as it is.

        ``decode`` names lidars of a single object, of which `decoded` stands in the place.
        """
        total = max(part.stop for part in layout.values())
        lidars = tuple(layout[name].start for name in layout if name in set(decode))
        columns: list[int] = []
        scale: list[float] = []
        clip: list[float] = []
        for name, part in layout.items():
            block = BLOCKS.get(name, Block())
            start = part.start
            width: Iterable[int] = range(part.stop - start)
            if start in lidars:
                start, width = total + DECODED * lidars.index(start), range(DECODED)
            elif block.columns is not None:
                width = block.columns
            columns += [start + column for column in width]
            scale += [block.scale] * (len(columns) - len(scale))
            clip += [block.clip] * (len(columns) - len(clip))
        return cls(
            np.array(columns, np.int64),
            np.array(scale, np.float32),
            np.array(clip, np.float32),
            total,
            lidars,
        )

    @property
    def dim(self) -> int:
        return len(self.columns)

    def check_width(self, observations: NDArray[np.floating]) -> None:
        """Raises UserError unless these are [N, obs] or [obs] of the layout that is read."""
        least = self.width or int(self.columns.max(initial=-1)) + 1
        most = self.width or least + UNREAD_TAIL
        shape = observations.shape
        if len(shape) not in (1, 2) or not least <= shape[-1] <= most:
            expected = f"{least}" if least == most else f"{least} or {most}"
            raise UserError(
                f"observations of shape {tuple(shape)}: this policy reads one observation "
                f"[{expected}] or a batch [N, {expected}]; was it trained on another task?"
            )

    def __call__(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        # Here the arithmetic of networks begins, in training and evaluation, so here its operands'
        # type and order in memory are decided: float32, one column after another, which is what
        # NumPy makes of an index array behind an ellipsis. In another order products round
        # otherwise on some processors, and recorded runs would not be repeated.
        if self.lidars:
            parts = [decoded(observations[..., at : at + BINS]) for at in self.lidars]
            observations = np.concatenate((observations, *parts), -1)
        out = observations[..., self.columns]
        out = (out if self.shift is None else out - self.shift).astype(np.float32)
        out *= self.scale
        if len(self._clipped):
            bound = self.clip[self._clipped]
            out[..., self._clipped] = np.clip(out[..., self._clipped], -bound, bound)
        return out
