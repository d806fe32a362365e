"""Frames through MuJoCo's renderer. OpenGL is imported when the first frame is asked for."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.navigation_physics import Worlds

SIZE = 480  # pixels


class FrameRenderer:
    """A lazily made MuJoCo renderer for the worlds of one environment; its copies start without.

    The models of an environment's worlds differ in where things stand, which a frame takes from
    an MjData, so one OpenGL context serves all of them. Opening one costs as much as several
    frames.
    """

    def __init__(self) -> None:
        self._renderer: Any = None
        self._data: Any = None

    def __reduce__(self) -> tuple[type[FrameRenderer], tuple[()]]:
        return FrameRenderer, ()

    def frame(self, worlds: Worlds, index: int) -> NDArray[np.uint8]:
        """An RGB frame [SIZE, SIZE, 3] of one world, seen by the camera `overview`.

        The world itself is not touched. Raises RuntimeError where OpenGL is not available.
        """
        model = worlds.models[index]
        if self._renderer is None:
            self._renderer, self._data = _open(model), mujoco.MjData(model)
        self._data.qpos[:] = worlds.qpos[index]
        # Positions of the present state and layout: a goal may have moved since the last step.
        mujoco.mj_kinematics(model, self._data)
        mujoco.mj_comPos(model, self._data)
        mujoco.mj_camlight(model, self._data)
        self._renderer.update_scene(self._data, camera="overview")
        return self._renderer.render()

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self._data = None


def _open(model: Any) -> Any:
    try:
        # MuJoCo chooses its OpenGL backend at import, by the variable MUJOCO_GL.
        from mujoco import Renderer

        return Renderer(model, SIZE, SIZE)
    except Exception as error:  # the backends raise whatever they like
        raise RuntimeError(
            f"cannot render: OpenGL is not available ({error}); set MUJOCO_GL=egl or osmesa on a "
            "machine without display, or draw with envs.drawing.draw_scene, which needs no OpenGL"
        ) from error
