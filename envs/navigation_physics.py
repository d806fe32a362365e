"""N independent MuJoCo worlds of one navigation task, with their state in stacked arrays."""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from envs.contract import Independent
from envs.layout import Layout
from envs.navigation_kernels import kinematics, read_states, write_controls
from envs.tasks import NavigationTask

FRAME_SKIP = 10  # MuJoCo steps of 0.002 s in one environment step
ROBOT_REACH = 0.16  # m, the corners of the nose are 0.158 m from the robot's origin

Array = NDArray[np.float64]


@functools.lru_cache(maxsize=8)
def _compile(task: NavigationTask) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(Path(__file__).parent / "assets" / f"{task.family}.xml"))
    template = spec.body("obstacle0")
    geom = template.geoms[0]
    geom.size = [task.obstacle_size, geom.size[1], 0.0]
    for index in range(1, task.num_obstacles):
        body = spec.worldbody.add_body(name=f"obstacle{index}", pos=template.pos)
        body.add_geom(
            name=f"obstacle{index}",
            type=geom.type,
            size=geom.size,
            rgba=geom.rgba,
            contype=geom.contype,
            conaffinity=geom.conaffinity,
            condim=geom.condim,
            friction=geom.friction,
            solref=geom.solref,
            solimp=geom.solimp,
            density=geom.density,
        )
    goal = spec.geom("goal")
    goal.size = [task.goal_size, goal.size[1], 0.0]
    model = spec.compile()
    if task.sleep:
        model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    return model


def compile_model(task: NavigationTask) -> mujoco.MjModel:
    """A fresh MjModel of the task; its layout is written by `Worlds.place`."""
    return copy.copy(_compile(task))


class Worlds(Independent):
    """N worlds, each with its own MjModel (the layout lives there) and MjData.

    Stacked arrays, valid after `place`, `step` and `set_state`, with the shapes of
    envs/navigation_kernels.py: qpos, qvel, qacc; pose, velocity, d, d_dot; contacts = (robot
    sphere, any robot geom) with pillars; start, goal, obstacles, obstacle_yaws [N, M] (layouts).
    """

    def __init__(self, task: NavigationTask, num_worlds: int) -> None:
        self.task = task
        self.models = [compile_model(task) for _ in range(num_worlds)]
        self.data = [mujoco.MjData(model) for model in self.models]
        model, obstacles = self.models[0], task.num_obstacles
        self.qpos = np.zeros((num_worlds, model.nq))
        self.qvel = np.zeros((num_worlds, model.nv))
        self.qacc = np.zeros((num_worlds, model.nv))
        self.pose = np.zeros((num_worlds, 3))
        self.velocity = np.zeros((num_worlds, 2))
        self.d = np.zeros((num_worlds, obstacles))
        self.d_dot = np.zeros((num_worlds, obstacles))
        self.contacts = np.zeros((num_worlds, 2))
        self.start = np.zeros((num_worlds, 3))
        self.goal = np.zeros((num_worlds, 2))
        self.obstacles = np.zeros((num_worlds, obstacles, 2))
        self.obstacle_yaws = np.zeros((num_worlds, obstacles))
        self._robot = model.body("robot").id
        self._goal = model.body("goal").id
        self._obstacles = [model.body(f"obstacle{j}").id for j in range(obstacles)]
        self._sphere = model.geom("sphere").id
        # MuJoCo's arrays stay where they are as long as the MjData lives, so compiled code can
        # reach them by address: reading them through Python costs as much as a MuJoCo step.
        self._addresses = np.array(
            [[a.ctypes.data for a in (d.qpos, d.qvel, d.qacc, d.ctrl)] for d in self.data]
        )

    def __len__(self) -> int:
        return len(self.models)

    def __getstate__(self) -> dict[str, Any]:
        # A copy gets MuJoCo structures of its own, at addresses of its own. MuJoCo's pickles of an
        # MjData leave out the private lists of sleeping bodies; a snapshot restores them.
        arrays = {name: a for name, a in vars(self).items() if isinstance(a, np.ndarray)}
        del arrays["_addresses"]
        return {
            "task": self.task,
            "snapshot": self.get_state(),
            "arrays": arrays,
            "diverged": self._diverged(),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        Worlds.__init__(self, state["task"], len(state["diverged"]))
        self._load(state["snapshot"], state["diverged"])
        for name, array in state["arrays"].items():
            getattr(self, name)[:] = array

    def place(self, layouts: Mapping[int, Layout]) -> None:
        """Put the worlds with these indices at rest in a layout."""
        for index, layout in layouts.items():
            self._place(index, layout)
        self._read()

    def _place(self, index: int, layout: Layout) -> None:
        self.start[index] = layout.robot
        self.obstacles[index] = layout.obstacles
        self.obstacle_yaws[index] = layout.obstacle_yaws
        self._write_layout(index)
        self.move_goal(index, layout.goal)
        data = self.data[index]
        mujoco.mj_resetData(self.models[index], data)
        if layout.box is not None:
            x, y, yaw = layout.box
            data.qpos[3:5], data.qpos[6:10] = (x, y), _yaw_quaternion(yaw)  # z: the MJCF's
        mujoco.mj_forward(self.models[index], data)

    def move_goal(self, index: int, goal: Array) -> None:
        self.goal[index] = goal
        self.models[index].body_pos[self._goal, :2] = goal

    def step(self, actions: Array) -> NDArray[np.bool_]:
        """Advance every world by one environment step under actions [N, 2], clipped to [-1, 1].

        Returns flags [N]: whether the world diverged. A diverged world keeps the state arrays of
        the step before and must be placed anew. Raises ValueError for an action that is not
        finite, before anything is changed.

        The last forward pass of a step serves the accelerometer and, up to the actuation, also
        the first substep of the next: `mj_step2` finishes that substep. The trajectory is bitwise
        that of 10 x `mj_step` + `mj_forward`, with one forward pass less.
        """
        index = write_controls(self._addresses, actions)
        if index >= 0:
            raise ValueError(
                f"{self.task.name}: the action of environment {index} is "
                f"{actions[index].tolist()}; actions must be finite"
            )
        finish, step, forward = mujoco.mj_step2, mujoco.mj_step, mujoco.mj_forward
        for model, data in zip(self.models, self.data, strict=True):
            finish(model, data)
            step(model, data, FRAME_SKIP - 1)
            forward(model, data)
        return self._read()

    def get_state(self) -> dict[str, Array | NDArray[np.int64]]:
        """Everything the future of the worlds depends on, as copied arrays."""
        return {
            "start": self.start.copy(),
            "goal": self.goal.copy(),
            "obstacles": self.obstacles.copy(),
            "obstacle_yaws": self.obstacle_yaws.copy(),
            "qpos": np.array([d.qpos for d in self.data]),
            "qvel": np.array([d.qvel for d in self.data]),
            "warmstart": np.array([d.qacc_warmstart for d in self.data]),
            "control": np.array([d.ctrl for d in self.data]),
            "asleep": np.array([d.tree_asleep for d in self.data], np.int64),
        }

    def set_state(self, state: Mapping[str, Array | NDArray[np.int64]]) -> None:
        """Restore `get_state`; the worlds then continue bit for bit.

        Raises ValueError if a shape does not fit, before anything is changed.
        """
        own = self.get_state()
        for name, array in own.items():
            if name not in state or np.shape(state[name]) != array.shape:
                found = np.shape(state[name]) if name in state else "nothing"
                raise ValueError(
                    f"{self.task.name}: state {name!r} must have shape {array.shape}, got {found}; "
                    "restore into an environment with the same task, settings and num_envs"
                )
        self._load({name: state[name] for name in own}, np.zeros(len(self), np.bool_))

    def _load(self, state: Mapping[str, NDArray], diverged: NDArray[np.bool_]) -> None:
        for name in ("start", "goal", "obstacles", "obstacle_yaws"):
            getattr(self, name)[:] = state[name]
        for index in range(len(self)):
            self._write_layout(index)
            self.move_goal(index, self.goal[index])
            self._restore(
                index, {name: a[index] for name, a in state.items()}, forward=not diverged[index]
            )
        self._read()

    def _restore(self, index: int, state: Mapping[str, NDArray], forward: bool) -> None:
        """forward: whether MuJoCo can make anything of the numbers; else they are just written."""
        model, data = self.models[index], self.data[index]

        def write() -> None:
            data.qpos[:], data.qvel[:] = state["qpos"], state["qvel"]
            data.ctrl[:], data.qacc_warmstart[:] = state["control"], state["warmstart"]

        mujoco.mj_resetData(model, data)
        write()
        if not forward:
            return
        asleep = state["asleep"] >= 0
        if asleep.any():
            # The lists of awake bodies are private to MuJoCo. One step in which anything may fall
            # asleep at once builds them; the state is then written again.
            tolerance = model.opt.sleep_tolerance
            model.opt.sleep_tolerance = np.inf
            data.tree_asleep[asleep] = -1
            mujoco.mj_step(model, data)
            model.opt.sleep_tolerance = tolerance
            write()
        data.tree_asleep[:] = state["asleep"]
        mujoco.mj_forward(model, data)

    def _write_layout(self, index: int) -> None:
        model = self.models[index]
        bodies = [self._robot, *self._obstacles]
        model.body_pos[bodies, :2] = np.vstack([self.start[index, :2], self.obstacles[index]])
        yaws = [self.start[index, 2], *self.obstacle_yaws[index]]
        model.body_quat[bodies] = [_yaw_quaternion(yaw) for yaw in yaws]

    def _diverged(self) -> NDArray[np.bool_]:
        diverged = np.empty(len(self), np.bool_)
        scratch = (self.qpos.copy(), self.qvel.copy(), self.qacc.copy())
        read_states(self._addresses, *scratch, diverged)
        return diverged

    def _read(self) -> NDArray[np.bool_]:
        diverged = np.empty(len(self), np.bool_)
        read_states(self._addresses, self.qpos, self.qvel, self.qacc, diverged)
        near = np.empty(len(self), np.int64)
        count = kinematics(
            self.qpos,
            self.qvel,
            self.start,
            self.obstacles,
            self.pose,
            self.velocity,
            self.d,
            self.d_dot,
            self.task.obstacle_size + ROBOT_REACH,
            near,
        )
        if self.task.solid_obstacles:
            self.contacts.fill(0.0)
            for index in near[:count].tolist():
                self._count_contacts(index)
        return diverged

    def _count_contacts(self, index: int) -> None:
        # Robot and pillars are all that can touch in this family (see assets/point.xml), so every
        # contact counts; which geoms they are is looked up only where the sphere may be involved.
        data = self.data[index]
        spheres = 0
        if data.ncon and self.d[index].min() < self.task.d_min + 1e-6:
            spheres = int(np.count_nonzero(data.contact.geom == self._sphere))
        self.contacts[index] = spheres, data.ncon


def _yaw_quaternion(yaw: float) -> tuple[float, float, float, float]:
    return float(np.cos(yaw / 2)), 0.0, 0.0, float(np.sin(yaw / 2))
