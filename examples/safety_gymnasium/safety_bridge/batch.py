"""A batch of Safety-Gymnasium's worlds as a vector environment of today's Gymnasium.

The worlds live in a process of their own, with a Python that `PYTHON` in the environment names
(README.md). It is named there, and not by a setting of the task, since a run is the same wherever
its simulator is installed: `PINNED` is what its numbers depend on.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from safemr import UserError
from safety_bridge import server

PYTHON = "SAFETY_GYMNASIUM_PYTHON"
PINNED = {"safety-gymnasium": "1.0.0", "mujoco": "2.3.3"}
REMEDY = "pip install --no-deps -r requirements.txt there (examples/safety_gymnasium/README.md)"

Floats = NDArray[np.float64]


class SafetyBatch(gymnasium.vector.VectorEnv):
    """N worlds of the task ``name``, all stepped by one message; SAME_STEP autoreset.

    ``infos`` have cost and goal_met [N] of the step, and d and d_dot [N, M] of what the observation
    shows, which after an episode's end is the next one's start; `final_obs` and `final_info` are
    what the ended one reached. Seeds and ``reset_mask`` are Gymnasium's.

    Raises:
        UserError: the other Python is not named, lacks the package, has another version of it, or
            fails, then and in every later step.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012
    task_version = 1  # of d, d_dot and cost on what is `PINNED`

    def __init__(self, num_envs: int, name: str, max_episode_steps: int) -> None:
        self.num_envs, self._name = num_envs, name
        python = os.environ.get(PYTHON)
        if not python:
            raise UserError(f"{name}: {PYTHON} is not set; name the simulator's Python: {REMEDY}")
        self._python, self._errors = python, tempfile.TemporaryFile()  # noqa: SIM115
        # -I: none of this Python's paths. -O: no assertions, that of an observation in its space
        # above all, which takes a good part of the simulator's time; `safemr` looks at each itself.
        command = [python, "-I", "-O", str(Path(server.__file__).resolve()), name]
        try:
            # A session of its own: Ctrl-C is for this program, which may still want to step.
            self._child = subprocess.Popen(
                [*command, str(num_envs), str(max_episode_steps)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                start_new_session=True,
            )
        except OSError as error:
            raise UserError(f"{PYTHON}={python} does not start: {error.strerror}") from error
        hello = json.loads(self._answer(server.HELLO))
        found = {package: hello["versions"][package] for package in PINNED}
        if found != PINNED:
            self.close()
            raise UserError(f"{name}: {python} has {_named(found)}, not {_named(PINNED)}: {REMEDY}")
        self.d_min, self.num_obstacles = float(hello["d_min"]), int(hello["obstacles"])
        self.max_episode_steps = int(hello["limit"])
        self.single_observation_space = _box(hello["observation"])
        self.single_action_space = _box(hello["action"])
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> tuple[Floats, dict[str, Any]]:
        first = range(seed, seed + self.num_envs) if isinstance(seed, int) else seed
        each = [None] * self.num_envs if first is None else list(first)
        seeds = np.array([server.CONTINUE if one is None else one for one in each], np.int64)
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            seeds[~mask] = server.LEAVE
        answer = np.frombuffer(self._ask(server.RESET, seeds))
        return self._read(answer.reshape(self.num_envs, -1))

    def step(
        self, actions: Any
    ) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        given = np.ascontiguousarray(actions, np.float64).reshape(self.action_space.shape)
        numbers, told = np.frombuffer(self._ask(server.STEP, given)), len(server.TOLD)
        width = told + self.single_observation_space.shape[0] + 2 * self.num_obstacles
        rows = numbers[: self.num_envs * width].reshape(self.num_envs, width)
        reward, cost, goal_met, terminated, truncated = rows[:, :told].T.copy()
        views, done = rows[:, told:].copy(), (terminated + truncated) > 0.0
        ended = self._read(views)
        views[done] = numbers[rows.size :].reshape(-1, width - told)
        observations, infos = self._read(views)
        infos |= {"cost": cost, "goal_met": goal_met}
        if done.any():
            final = ended[1] | {"cost": cost, "goal_met": goal_met}
            final |= {f"_{name}": done for name in final}
            infos |= {"final_obs": ended[0], "final_info": final}
            infos |= {"_final_obs": done, "_final_info": done}
        return observations, reward, terminated > 0.0, truncated > 0.0, infos

    def _read(self, views: Floats) -> tuple[Floats, dict[str, Any]]:
        """Observations [N, D], and d and d_dot [N, M]."""
        width, m = self.single_observation_space.shape[0], self.num_obstacles
        seen, d, d_dot = views[:, :width], views[:, width : width + m], views[:, width + m :]
        return seen.copy(), {"d": d.copy(), "d_dot": d_dot.copy()}

    def _ask(self, kind: bytes, content: NDArray[Any]) -> bytes:
        assert self._child.stdin is not None
        with contextlib.suppress(OSError):  # it has ended; its last message says why
            server.send(self._child.stdin, kind, content.tobytes())
        return self._answer(server.VIEW)

    def _answer(self, wanted: bytes) -> bytes:
        assert self._child.stdout is not None
        try:
            kind, content = server.receive(self._child.stdout)
        except EOFError:
            kind, content = server.ERROR, self._last_words().encode()
        if kind == wanted:
            return content
        self.close()
        text = content.decode()
        missing = f"; {REMEDY}" if "ModuleNotFoundError" in text else ""
        raise UserError(f"{self._name}: the simulator, {self._python}, ends: {text}{missing}")

    def _last_words(self) -> str:
        """Why a server ended that sent nothing."""
        status = self._child.wait()
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        return f"exit status {status}" + (f", {last}" if last else "")

    def close_extras(self, **keywords: Any) -> None:
        """End the server, which it does when it is told nothing more."""
        for stream in (self._child.stdin, self._child.stdout, self._errors):
            assert stream is not None
            with contextlib.suppress(OSError):  # what was written to a server that had ended
                stream.close()
        try:
            self._child.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()


def _box(bounds: Sequence[Sequence[float]]) -> gymnasium.spaces.Box:
    low, high = (np.array(bound, float) for bound in bounds)
    return gymnasium.spaces.Box(low, high, low.shape, np.float64)


def _named(versions: Mapping[str, str]) -> str:
    return " and ".join(f"{package} {version}" for package, version in versions.items())
