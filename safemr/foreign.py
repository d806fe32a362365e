"""Environments from outside: any of Gymnasium's with continuous actions, as a `SafetyEnvs`.

A task's entry has the id of its environment, as `gymnasium.make` takes it, with the module that
registers it (``my_package:MyTask-v0``). The environment reports in ``info`` ``cost`` and, for the
algorithms with an energy function, ``d`` and ``d_dot``, one number an obstacle (docs/your-own.md).

- *Batches* are the environment's own where it has a vector entry point with SAME_STEP autoreset,
  and otherwise Gymnasium's (``vectorization``: ``sync`` or ``async``, which changes no number).
- *Actions* are mapped from [-1, 1] onto the bounds of its space, observations are made vectors
  (`gymnasium.spaces.flatten`), in double precision. It has no observation layout: they are read by
  the bounds of the space (`safemr.learning.observation`) or by running statistics.
- *Obstacles* that come and go: M is ``num_obstacles``, an attribute of the environment or a
  number in the configuration, or else how many the first reset reports. Shorter lists, and entries
  with d = inf, stand for obstacles that are not there; in their place the nearest one is repeated,
  which changes no maximum over obstacles. Where none is there, one is at rest at `FAR` d_min.
- *Snapshots* there are none. A resumed run begins new episodes (`ForeignEnvs.set_state`).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from safemr.environments import OPTIONAL_INFOS, SafetyEnvs
from safemr.errors import UserError, show
from safemr.foreign_check import Found, examined, failure, first_line

Floats = NDArray[np.floating]
Flags = NDArray[np.bool_]

FAR = 10.0  # distance of an obstacle where there is none, in units of d_min
# What an episode sums, of which only the cost must be reported.
SUMS = ("cost", *(name for name in OPTIONAL_INFOS if name != "control_steps"))


def foreign_envs(task: Mapping[str, Any], num_envs: int) -> SafetyEnvs:
    """A batch of a task whose entry has an ``id``.

    Raises:
        UserError: for the first thing that the environment lacks.
    """
    found = examined(task)
    label = f"task {task['name']}"
    if found.problems:
        raise UserError(f"{label}: {found.problems[0]} (safemr check {task['id']} says all)")
    keywords: dict[str, Any] = dict(task.get("settings", {}))
    if found.mode != "vector_entry_point":
        keywords |= {
            "vector_kwargs": {"autoreset_mode": AutoresetMode.SAME_STEP},
            "wrappers": [functools.partial(Uniform, label=label, obstacles=found.num_obstacles)],
            "disable_env_checker": True,
        }
    try:
        envs = gymnasium.make_vec(task["id"], num_envs, vectorization_mode=found.mode, **keywords)
    except UserError:
        raise
    except Exception as error:  # the environment's own, whatever its type
        raise UserError(f"{label}: it cannot be made: {first_line(error)}") from error
    return cast(SafetyEnvs, ForeignEnvs(envs, label, found))


class Uniform(gymnasium.Wrapper):
    """One environment whose observations are vectors [D] and whose infos have fixed shapes.

    obstacles: the number M that d and d_dot are padded to, 0 where they are not reported. The infos
    are those that `ForeignEnvs` reads and no others.
    """

    def __init__(self, env: Any, label: str, obstacles: int) -> None:
        super().__init__(env)
        self._label, self._obstacles = label, obstacles
        self._spaces = env.observation_space, env.action_space
        flat: Any = gymnasium.spaces.flatten_space(env.observation_space)
        self.observation_space = gymnasium.spaces.Box(
            flat.low.astype(float), flat.high.astype(float), flat.shape, np.float64
        )

    def reset(self, **keywords: Any) -> tuple[Floats, dict[str, Any]]:
        observation, info = self.env.reset(**keywords)
        if (self.env.observation_space, self.env.action_space) != self._spaces:
            raise UserError(
                f"{self._label}: its spaces changed at a reset; they must stay the same"
            )
        return self._vector(observation), self._reported(info)

    def step(self, action: Any) -> tuple[Floats, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        reported = self._reported(info)
        return self._vector(observation), reward, terminated, truncated, reported

    def _vector(self, observation: Any) -> Floats:
        try:
            vector: Any = gymnasium.spaces.flatten(self._spaces[0], observation)
        except Exception as error:
            raise UserError(
                f"{self._label}: an observation is none of its space: {first_line(error)}; "
                "return what observation_space says"
            ) from error
        (width,) = self.observation_space.shape or (0,)
        if vector.shape != (width,):
            raise UserError(
                f"{self._label}: an observation has {vector.size} numbers, its space {width}; "
                "return what observation_space says"
            )
        return vector.astype(float)

    def _reported(self, info: Mapping[str, Any]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name in SUMS:
            if name in info:
                found[name] = self._numbers(info[name], name, 0)
        for name, missing in (("d", np.inf), ("d_dot", 0.0)):
            if self._obstacles and name in info:
                values = self._numbers(info[name], name, 1)
                if len(values) > self._obstacles:
                    raise UserError(
                        f"{self._label}: {name} has {len(values)} entries, more than "
                        f"{self._obstacles}; say how many there may be at once: "
                        f"task.num_obstacles={len(values)}"
                    )
                padded = np.full(self._obstacles, missing)
                padded[: len(values)] = values
                found[name] = padded
        return found

    def _numbers(self, value: Any, name: str, axes: int) -> Any:
        try:
            array = np.asarray(value, float)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if array.ndim != axes:
            kind = "one number" if axes == 0 else "numbers, one an obstacle"
            raise UserError(f"{self._label}: info[{name!r}] is {show(value)}; make it {kind}")
        return array if axes else float(array)


class ForeignEnvs:
    """A vector environment of Gymnasium's as a `SafetyEnvs`; what it reports is checked each step.

    envs: with SAME_STEP autoreset; label: names the task in errors; found: what it has.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012
    observation_layout: Mapping[str, slice] = {}
    exact_resume = False

    def __init__(self, envs: Any, label: str, found: Found) -> None:
        self.envs, self._label = envs, label
        self.num_envs = int(envs.num_envs)
        self.reports_distances = found.num_obstacles > 0
        self.num_obstacles = max(found.num_obstacles, 1)
        self.d_min, self.max_episode_steps = found.d_min, found.max_episode_steps
        self.task_version = found.version
        seen, acted = envs.single_observation_space, envs.single_action_space
        low, high = (np.asarray(bound, float).ravel() for bound in (seen.low, seen.high))
        self.single_observation_space = gymnasium.spaces.Box(low, high, low.shape, np.float64)
        self._low, self._high = acted.low.astype(float), acted.high.astype(float)
        self._action = acted
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (self._low.size,), np.float32)
        self._seed, self._steps = 0, 0
        self._observations: Floats = np.zeros((self.num_envs, len(low)))
        self._d = np.full((self.num_envs, self.num_obstacles), FAR * self.d_min)
        self._d_dot = np.zeros_like(self._d)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Any = None
    ) -> tuple[Floats, dict[str, Any]]:
        """As Gymnasium's; with its ``reset_mask`` the other worlds stay as they are."""
        mask = (options or {}).get("reset_mask")
        rows = np.ones(self.num_envs, np.bool_) if mask is None else mask
        if isinstance(seed, int):
            self._seed = seed
        result = self._called("reset", seed=seed, options=dict(options) if options else None)
        observations = self._read(result[0])
        if not np.array_equal(observations[~rows], self._observations[~rows]):
            raise UserError(
                f"{self._label}: its vector environment knows no reset_mask, which held actions "
                "need; support it, or set task.vectorization=sync"
            )
        self._observations = observations
        self._place(result[1], rows)
        return observations, {"d": self._d, "d_dot": self._d_dot}

    def step(self, actions: Any) -> tuple[Floats, Floats, Flags, Flags, dict[str, Any]]:
        """One step of every world; the shapes are those of `SafetyEnvs`."""
        given = np.clip(np.asarray(actions, float), -1.0, 1.0)
        given = given.reshape(self.num_envs, *self._low.shape)
        given = self._low + 0.5 * (given + 1.0) * (self._high - self._low)
        given = given.astype(self._action.dtype).clip(self._action.low, self._action.high)
        observations, rewards, terminated, truncated, infos = self._called("step", given)
        self._steps += 1
        everywhere = np.ones(self.num_envs, np.bool_)
        rewards = self._finite(np.asarray(rewards, float), "a reward", everywhere)
        done = np.asarray(terminated) | np.asarray(truncated)
        self._observations = self._read(observations)
        final: Mapping[str, Any] = infos.get("final_info", {}) if done.any() else {}
        result: dict[str, Any] = {}
        for name in SUMS:
            if name in infos or name in final or name == "cost":
                result[name] = self._sums(infos, final, name, done)
        if (result["cost"] < 0.0).any():
            raise UserError(f"{self._label}: cost is negative; report 0 where there is none")
        if done.any():
            result["final_obs"] = self._observations.copy()
            for row in np.flatnonzero(done):
                result["final_obs"][row] = np.asarray(infos["final_obs"][row], float).ravel()
            self._finite(result["final_obs"], "an observation", everywhere)
            self._place(final, done)
            result["final_info"] = {"d": self._d, "d_dot": self._d_dot}
        self._place(infos, everywhere)
        result |= {"d": self._d, "d_dot": self._d_dot}
        return self._observations, rewards, np.asarray(terminated), np.asarray(truncated), result

    def _called(self, name: str, *arguments: Any, **keywords: Any) -> Any:
        """What the environments' `reset` or `step` gives."""
        try:
            return getattr(self.envs, name)(*arguments, **keywords)
        except UserError:
            raise
        except Exception as error:  # the environment's own, whatever its type
            raise UserError(
                f"{self._label}: {name} fails after {self._steps} steps of {self.num_envs} "
                f"environments: {failure(error)}"
            ) from error

    def _sums(
        self, infos: Mapping[str, Any], final: Mapping[str, Any], name: str, done: Flags
    ) -> Floats:
        """What each world reports of this step [N]: where its episode ended, in `final_info`."""
        values = np.zeros(self.num_envs)
        for source, rows in ((infos, ~done), (final, done)):
            needed = rows if name == "cost" else np.zeros_like(rows)
            if needed.any() or name in source:
                values[rows] = self._reported(source, name, needed, 1)[rows]
        return self._finite(values, name, ~done | done)

    def _reported(
        self, infos: Mapping[str, Any], name: str, needed: Flags, axes: int
    ) -> NDArray[Any]:
        """An entry of the infos, which each of the ``needed`` worlds must have."""
        given = np.asarray(infos.get(f"_{name}", True))
        if name not in infos or not np.broadcast_to(given, needed.shape)[needed].all():
            raise UserError(
                f"{self._label}: an info lacks {name!r}; every step reports it, and d and d_dot "
                "every reset, too"
            )
        found = np.asarray(infos[name])
        if found.ndim != axes or len(found) != self.num_envs or found.dtype.kind not in "fiub":
            raise UserError(
                f"{self._label}: info[{name!r}] of {self.num_envs} environments has shape "
                f"{found.shape} and type {found.dtype}; make it numbers with one row for each"
            )
        return found.astype(float)

    def _place(self, infos: Mapping[str, Any], rows: Flags) -> None:
        """Take over d and d_dot [N, M] of some worlds."""
        if not self.reports_distances or not rows.any():
            return
        d, d_dot = (self._reported(infos, name, rows, 2)[rows] for name in ("d", "d_dot"))
        if d.shape != d_dot.shape or d.shape[1] > self.num_obstacles:
            raise UserError(
                f"{self._label}: d has {d.shape[1]} columns and d_dot {d_dot.shape[1]}; both must "
                f"have the same, at most task.num_obstacles = {self.num_obstacles}"
            )
        if np.isnan(d).any() or (d == -np.inf).any() or not np.isfinite(d_dot[d < np.inf]).all():
            raise UserError(
                f"{self._label}: d or d_dot is not finite; give numbers, or d = inf for an "
                "obstacle that is not there"
            )
        short = self.num_obstacles - d.shape[1]
        d = np.pad(d, ((0, 0), (0, short)), constant_values=np.inf)
        d_dot = np.pad(d_dot, ((0, 0), (0, short)))
        absent = d == np.inf
        if absent.any():
            nearest = d.argmin(1)[:, None]
            least = np.take_along_axis(d, nearest, 1)
            nobody = least == np.inf
            rate = np.where(nobody, 0.0, np.take_along_axis(d_dot, nearest, 1))
            d = np.where(absent, np.where(nobody, FAR * self.d_min, least), d)
            d_dot = np.where(absent, rate, d_dot)
        # New arrays: what a step returned stays as it was.
        self._d, self._d_dot = self._d.copy(), self._d_dot.copy()
        self._d[rows], self._d_dot[rows] = d, d_dot

    def _read(self, observations: Any) -> Floats:
        read = np.array(observations, float).reshape(self.num_envs, -1)
        if read.shape != self._observations.shape:
            raise UserError(
                f"{self._label}: observations have {read.shape[1]} numbers, the space "
                f"{self._observations.shape[1]}; return what the space says"
            )
        return self._finite(read, "an observation", np.ones(self.num_envs, np.bool_))

    def _finite(self, values: Floats, name: str, rows: Flags) -> Floats:
        if not np.isfinite(values[rows]).all():
            raise UserError(
                f"{self._label}: {name} is not finite after {self._steps} steps of "
                f"{self.num_envs} environments; it must be"
            )
        return values

    def close(self) -> None:
        self.envs.close()

    def get_state(self) -> dict[str, Any]:
        """Not a snapshot: from what seed, and how many steps ago, the environments began."""
        return {"seed": self._seed, "steps": self._steps}

    def set_state(self, state: Mapping[str, Any]) -> tuple[Floats, dict[str, Any]]:
        """Begin new episodes, others than those that the run began with; as `reset` gives them."""
        seed, self._steps = int(state["seed"]), int(state["steps"])
        return self.reset(seed=(seed + self.num_envs * (self._steps + 1)) % 2**31)
