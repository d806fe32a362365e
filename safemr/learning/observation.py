"""From an environment's raw observation to what the networks see: fixed columns, scales and clips.

There are no running statistics: the transform is a constant of the task, so training, evaluation
and a saved policy can never disagree about it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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

UNREAD_TAIL = 1  # columns after the last one read: the vertical component of a layout's last sensor


class ObservationTransform:
    """Selects, scales and clips observation columns.

    columns [dim] int64, scale [dim] and clip [dim] float32. Calling it maps [N, obs] (any float
    type, any order in memory) to float32 [N, dim] in Fortran order. width is the raw observations'
    number of columns, which a saved policy does not say.
    """

    def __init__(
        self,
        columns: NDArray[np.int64],
        scale: NDArray[np.float32],
        clip: NDArray[np.float32],
        width: int | None = None,
    ) -> None:
        self.columns, self.scale, self.clip, self.width = columns, scale, clip, width
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
            np.array(columns, np.int64),
            np.array(scale, np.float32),
            np.array(clip, np.float32),
            max(part.stop for part in layout.values()),
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
        out = observations[..., self.columns].astype(np.float32)
        out *= self.scale
        if len(self._clipped):
            bound = self.clip[self._clipped]
            out[..., self._clipped] = np.clip(out[..., self._clipped], -bound, bound)
        return out
