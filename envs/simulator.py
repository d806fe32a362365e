"""MuJoCo, with or without OpenGL.

MuJoCo loads the OpenGL library that the variable MUJOCO_GL names when it is imported, and fails
where that library is missing or the value is unknown. Only frames need it (envs/rendering.py), so
MuJoCo is then imported without OpenGL.
"""

from __future__ import annotations

import os

VARIABLE = "MUJOCO_GL"

_before = dict(os.environ)
OPENGL_FAULT: str | None = None  # why MuJoCo was imported without OpenGL

try:
    import mujoco
except Exception as error:  # OpenGL libraries raise whatever they like
    OPENGL_FAULT = " ".join(str(error).split()) or type(error).__name__
    os.environ[VARIABLE] = "disabled"
    try:
        import mujoco  # a second failure has nothing to do with OpenGL
    finally:  # the attempt sets another variable, too
        for _name in (VARIABLE, "PYOPENGL_PLATFORM"):
            os.environ.pop(_name, None)
            if _name in _before:
                os.environ[_name] = _before[_name]

__all__ = ["OPENGL_FAULT", "VARIABLE", "mujoco"]
