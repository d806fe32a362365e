"""Frames through MuJoCo's renderer. OpenGL is imported when the first frame is asked for."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

from envs.navigation_physics import Worlds
from envs.simulator import OPENGL_FAULT, VARIABLE, mujoco

SIZE = 480  # pixels


class FrameRenderer:
    """A lazily made MuJoCo renderer for the worlds of one task."""

    def __init__(self) -> None:
        self._renderer: Any = None
        self._model: Any = None

    def frame(self, worlds: Worlds, index: int) -> NDArray[np.uint8]:
        """An RGB frame [SIZE, SIZE, 3] of one world, seen by the camera `overview`.

        Raises RuntimeError where OpenGL is not available.
        """
        model, data = worlds.models[index], worlds.data[index]
        if self._model is not model:
            self.close()
            self._renderer, self._model = _open(model), model
        self._renderer.update_scene(data, camera="overview")
        return self._renderer.render()

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self._model = None


def _open(model: Any) -> Any:
    try:
        return mujoco.Renderer(model, SIZE, SIZE)
    except Exception as error:  # the backends raise whatever they like
        value = os.environ.get(VARIABLE)
        setting = f"{VARIABLE}={value}" if value else f"{VARIABLE} unset"
        off = not hasattr(mujoco, "GLContext")
        reason = OPENGL_FAULT or ("OpenGL is switched off" if off else " ".join(str(error).split()))
        raise RuntimeError(
            f"cannot render with {setting}: {reason}; start with {VARIABLE}=egl or osmesa on a "
            "machine without display, or draw with envs.drawing.draw_scene, which needs no OpenGL"
        ) from error
