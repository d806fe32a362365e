"""The simulator's side: steps Safety-Gymnasium's worlds for a program in another Python.

Started by `safety_bridge.batch` as ``python -I -O server.py NAME WORLDS LIMIT``, with the Python
that has Safety-Gymnasium (3.8 or later); it needs nothing of the other one's packages. A message is
a letter, the number of bytes that follow, and these, on standard input and output:

    HELLO ->  JSON: versions, bounds of the spaces, d_min [m], obstacles M, steps of an episode
    <- RESET  int64 [N], a seed for each world, or `CONTINUE` or `LEAVE`
    <- STEP   float64 [N, A], an action for each world
    VIEW ->   RESET: float64 [N, V], what each world shows: observation [D], d [M], d_dot [M]
              STEP: [N, 5 + V], `TOLD` and what the step led to; then [K, V], what the K worlds
              whose episode ended show after their restart, in order
    ERROR ->  text of one line, after which the server ends

It ends when its input does, so that no server outlives the program that started it.
"""

from __future__ import annotations

import dataclasses
import json
import os
import struct
import sys
from importlib import metadata
from typing import Any, BinaryIO

import numpy as np

HELLO, RESET, STEP, VIEW, ERROR = b"H", b"R", b"S", b"V", b"E"
CONTINUE, LEAVE = -1, -2  # instead of a seed: go on with the world's generator; do not reset it
TOLD = ("reward", "cost", "goal_met", "terminated", "truncated")
PACKAGES = ("safety-gymnasium", "mujoco", "numpy")
HEAD = struct.Struct("<cQ")


def send(stream: BinaryIO, kind: bytes, content: bytes) -> None:
    stream.write(HEAD.pack(kind, len(content)) + content)
    stream.flush()


def receive(stream: BinaryIO) -> tuple[bytes, bytes]:
    """The next message.

    Raises:
        EOFError: there is none, or not the whole of it.
    """
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        raise EOFError
    kind, size = HEAD.unpack(head)
    content = stream.read(size)
    if len(content) < size:
        raise EOFError
    return kind, content


def simulator() -> Any:
    """Safety-Gymnasium, imported with two repairs, neither of which changes a number.

    Its dataclasses have arrays as defaults, which Python refuses from 3.11 on. And it reads 24 MB
    of pictures of the sky at each reset, seconds, which only cameras see.
    """
    plain = dataclasses.dataclass

    def dataclass(cls: Any = None, **options: Any) -> Any:
        if cls is None:
            return lambda cls: dataclass(cls, **options)
        for name, value in list(vars(cls).items()):
            if isinstance(value, np.ndarray):
                setattr(cls, name, dataclasses.field(default_factory=value.copy))
        return plain(cls, **options)

    dataclasses.dataclass = dataclass  # type: ignore[assignment]
    try:
        import safety_gymnasium
        from safety_gymnasium import world
    finally:
        dataclasses.dataclass = plain
    world.yaml = WithoutSky(world.yaml)
    return safety_gymnasium


class WithoutSky:
    """`yaml` for the module that builds worlds: its files are read once, the sky is plain."""

    def __init__(self, yaml: Any) -> None:
        self._load, self._read, self.FullLoader = yaml.load, {}, yaml.FullLoader  # type: ignore[var-annotated]

    def load(self, file: Any, Loader: Any) -> Any:
        if file.name not in self._read:
            found = self._load(file, Loader=Loader)
            sky = {"@type": "skybox", "@builtin": "flat", "@width": "1", "@height": "6"}
            found["textures"]["skybox"] = sky
            self._read[file.name] = found
        return self._read[file.name]


def reach(agent: Any) -> float:
    """The farthest that a robot reaches from its origin in the plane, as it stands [m].

    No contact is farther away: boxes count by their corners, capsules, cylinders and ellipsoids by
    those of the boxes around them, spheres and meshes by the spheres around them.
    """
    model, data = agent.engine.model, agent.engine.data
    origin, farthest = data.body("agent").xpos, 0.0
    for name in agent.body_info.geom_names:
        geom, place = model.geom(name), data.geom(name)
        shape, size = int(np.ravel(geom.type)[0]), np.array(geom.size)
        away = place.xpos - origin
        if shape in (3, 4, 5, 6):  # mjtGeom: capsule, ellipsoid, cylinder, box
            if shape in (3, 5):  # radius, half length
                size = np.array([size[0], size[0], size[1] + (size[0] if shape == 3 else 0.0)])
            signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, -1)
            corners = away[:2, None] + (place.xmat.reshape(3, 3) @ (size[:, None] * signs))[:2]
            farthest = max(farthest, float(np.hypot(*corners).max()))
        else:
            farthest = max(farthest, float(np.hypot(*away[:2]) + model.geom_rbound[geom.id]))
    return farthest


class Worlds:
    """N worlds of one task, each with its M hazards and pillars that cost something.

    d is the distance of the robot's origin from an obstacle's axis in the plane, d_dot its rate:
    -v.e for the robot's velocity v and the direction e to the obstacle, which does not move. A
    hazard costs where d is less than its radius, which is d_min; a pillar where the robot touches
    it, which is nowhere beyond its radius and the robot's reach: its d is shifted so that this is
    at d_min, too.
    """

    def __init__(self, package: Any, name: str, count: int, limit: int) -> None:
        self._envs = []
        for _ in range(count):
            env = package.make(name, disable_env_checker=True, max_episode_steps=limit)
            env.unwrapped.task.num_steps = limit  # its own clock
            self._envs.append(env)
        task = self._envs[0].unwrapped.task
        kinds = [getattr(task, kind, None) for kind in ("hazards", "pillars")]
        self._kinds = [kind for kind in kinds if kind is not None and kind.is_constrained]
        if not self._kinds:
            raise ValueError("it has no hazards or pillars that cost anything")
        kept = [
            kind.size + (reach(task.agent) if kind.name == "pillars" else 0.0)
            for kind in self._kinds
        ]
        self.d_min = float(kept[0])
        self._shifts = np.repeat(np.subtract(kept, self.d_min), [kind.num for kind in self._kinds])
        spaces = {"observation": self._envs[0].observation_space, "action": task.action_space}
        self.hello = {
            "versions": {package: metadata.version(package) for package in PACKAGES},
            "d_min": self.d_min,
            "obstacles": len(self._shifts),
            "limit": limit,
            **{name: [space.low.tolist(), space.high.tolist()] for name, space in spaces.items()},
        }
        width = spaces["observation"].shape[0] + 2 * len(self._shifts)
        self._views = np.zeros((count, width))

    def reset(self, seeds: Any) -> Any:
        """Views [N, V], after those worlds were reset that have a seed or are to continue."""
        for row in np.flatnonzero(seeds != LEAVE):
            self._begin(row, None if seeds[row] == CONTINUE else int(seeds[row]))
        return self._views

    def step(self, actions: Any) -> Any:
        """Numbers of `STEP`'s answer, of actions [N, A]."""
        told, begun = np.zeros((len(self._envs), len(TOLD))), []
        for row, env in enumerate(self._envs):
            observation, reward, cost, ended, cut, info = env.step(actions[row])
            told[row] = reward, cost, info.get("goal_met", False), ended, cut
            self._views[row] = self._view(env, observation)
        rows = np.hstack((told, self._views))
        for row in np.flatnonzero(told[:, 3:].any(1)):
            self._begin(row, None)
            begun.append(self._views[row])
        return np.concatenate((rows.ravel(), *begun))

    def _begin(self, row: int, seed: int | None) -> None:
        env = self._envs[row]
        self._views[row] = self._view(env, env.reset(seed=seed)[0])

    def _view(self, env: Any, observation: Any) -> Any:
        task = env.unwrapped.task
        places = [place for kind in self._kinds for place in getattr(task, kind.name).pos]
        way = np.array(places)[:, :2] - task.agent.pos[:2]
        distance = np.hypot(way[:, 0], way[:, 1])
        rate = -(way @ task.agent.vel[:2]) / np.maximum(distance, 1e-9)
        return np.concatenate((observation, distance - self._shifts, rate))


def serve(source: BinaryIO, sink: BinaryIO, name: str, count: int, limit: int) -> None:
    """Answer messages until there are no more."""
    worlds = Worlds(simulator(), name, count, limit)
    send(sink, HELLO, json.dumps(worlds.hello).encode())
    while True:
        try:
            kind, content = receive(source)
        except EOFError:
            return
        if kind == RESET:
            answer = worlds.reset(np.frombuffer(content, np.int64))
        else:
            answer = worlds.step(np.frombuffer(content).reshape(count, -1))
        send(sink, VIEW, answer.tobytes())


def main() -> int:
    # What is printed in between goes elsewhere, so that it is no message.
    sink = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        serve(sys.stdin.buffer, sink, sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
    except BrokenPipeError:  # nobody waits for the answer
        os.close(0)
    except Exception as error:
        send(sink, ERROR, " ".join(f"{type(error).__name__}: {error}".split()).encode())
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
