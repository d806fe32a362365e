"""From an environment's raw observation to what the networks see: fixed columns, scales and clips.

There are no running statistics: the transform is a constant of the task, so training, evaluation
and a saved policy can never disagree about it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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


class ObservationTransform:
    """Selects, scales and clips observation columns.

    columns [dim] int64, scale [dim] and clip [dim] float32. Calling it maps [N, obs] (any float
    type, any order in memory) to float32 [N, dim] in Fortran order.
    """

    def __init__(
        self, columns: NDArray[np.int64], scale: NDArray[np.float32], clip: NDArray[np.float32]
    ) -> None:
        self.columns, self.scale, self.clip = columns, scale, clip
        self._clipped = np.flatnonzero(np.isfinite(clip))

    @classmethod
    def for_layout(cls, layout: Mapping[str, slice]) -> ObservationTransform:
        """For an environment's ``observation_layout``; an unlisted sensor is kept as it is."""
        columns: list[int] = []
        scale: list[float] = []
        clip: list[float] = []
        for name, part in layout.items():
            block = BLOCKS.get(name, Block())
            width = range(part.stop - part.start) if block.columns is None else block.columns
            columns += [part.start + column for column in width]
            scale += [block.scale] * len(width)
            clip += [block.clip] * len(width)
        return cls(
            np.array(columns, np.int64), np.array(scale, np.float32), np.array(clip, np.float32)
        )

    @property
    def dim(self) -> int:
        return len(self.columns)

    def __call__(self, observations: NDArray[np.floating]) -> NDArray[np.float32]:
        # Here the arithmetic of networks begins, in training and evaluation, so here its operands'
        # type and order in memory are decided: float32, one column after another, which is what
        # NumPy makes of an index array behind an ellipsis. In another order products round
        # otherwise on some processors, and recorded runs would not be repeated.
        out = observations[..., self.columns].astype(np.float32)
        out *= self.scale
        if len(self._clipped):
            bound = self.clip[self._clipped]
            out[..., self._clipped] = np.clip(out[..., self._clipped], -bound, bound)
        return out
