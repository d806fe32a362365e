"""What every environment here keeps to, so that Gymnasium's users find what they expect.

- *One clock.* A scalar environment has its own when it is constructed directly; what
  `gymnasium.make` makes is timed by Gymnasium's TimeLimit alone. A batch, which no wrapper can
  truncate, always has its own, and its spec names it.
- *Copies are independent*: `copy.copy`, `copy.deepcopy` and pickles continue like the original and
  share nothing with it.
- *Nothing is ignored*: options, seeds and render modes that mean nothing are refused by name, and
  so is a step that belongs to no episode.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

NO_LIMIT = int(np.iinfo(np.int64).max)  # steps
RESET_MASK = "reset_mask"

Floats = NDArray[np.float64]
Actions = NDArray[np.float32]


class Independent:
    """Objects of which a shallow copy would move the original: every copy is a deep one."""

    def __copy__(self) -> Any:
        return copy.deepcopy(self)


class ScalarEnvironment(Independent, gymnasium.Env[Floats, Actions]):
    """One world. Subclasses set `_name` and `_simulation`, and guard `step` by `_running`.

    The simulation is N worlds without autoreset (here one): it has `generators`, one a world,
    `step_limit`, the length of an episode, `get_state` and `set_state`.
    """

    options: ClassVar[tuple[str, ...]] = ()  # known to `reset`
    _name: str
    _simulation: Any
    _spec: EnvSpec | None = None
    _placed = _running = _closed = False

    @property
    def max_episode_steps(self) -> int | None:
        """The steps after which this object truncates an episode, None if it never does.

        It never does where `gymnasium.make` made it: there TimeLimit keeps the time, and
        `env.spec.max_episode_steps` says how long.
        """
        limit: int = self._simulation.step_limit
        return None if limit == NO_LIMIT else limit

    @property
    def spec(self) -> EnvSpec | None:
        """Set by `gymnasium.make`, without a time limit: that of TimeLimit is to be the only one.

        Raises ValueError for an id whose registered kwargs contain a limit.
        """
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            if spec.kwargs.get("max_episode_steps") is not None:
                raise ValueError(
                    f"{self._name}: give max_episode_steps to gymnasium.make or gymnasium.register "
                    "itself, not among the id's kwargs; Gymnasium's TimeLimit keeps the time"
                )
            limit = spec.max_episode_steps
            self._simulation.step_limit = NO_LIMIT if limit is None else limit
        self._spec = spec

    def _begin(self, seed: int | None, options: Mapping[str, Any] | None) -> Mapping[str, Any]:
        """Check the arguments of `reset`, seed `np_random` and hand it to the world."""
        if self._closed:
            raise closed(self._name)
        given = checked_options(self._name, options, self.options)
        gymnasium.Env.reset(self, seed=checked_seed(self._name, seed))
        self._simulation.generators[0] = self.np_random
        return given

    def _refusal(self) -> Exception:
        """Why there is no step to take."""
        return closed(self._name) if self._closed else reset_needed(self._name)

    def close(self) -> None:
        """Free what is held. Closing twice is harmless; stepping or resetting then is refused."""
        self._closed, self._running = True, False

    def render(self) -> Any:
        """An RGB frame, or None without a render mode."""
        if self.render_mode is None:
            return None
        if self._closed or not self._placed:
            raise self._refusal()
        return self._frame()

    def _frame(self) -> NDArray[np.uint8]:
        raise NotImplementedError

    def get_state(self) -> dict[str, Any]:
        """A complete snapshot: arrays and plain numbers only."""
        return self._simulation.get_state() | {"running": self._running, "placed": self._placed}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a snapshot; the environment then continues bit for bit.

        The count of a TimeLimit around it is no part of it. Raises ValueError for a snapshot of
        another environment.
        """
        self._simulation.set_state(state)
        self.np_random = self._simulation.generators[0]
        self._running = bool(state["running"]) and not self._closed
        self._placed = bool(state.get("placed", True))


class BatchEnvironment(Independent, VectorEnv[Floats, Actions, Any]):
    """N worlds with SAME_STEP autoreset. Subclasses set `_name` and `_simulation`, and guard
    `step` by `_started`."""

    options: ClassVar[tuple[str, ...]] = (RESET_MASK,)
    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012
    _name: str
    _simulation: Any
    _spec: EnvSpec | None = None
    _started = False

    def _set_spaces(self, num_envs: int, spaces: tuple[Any, Any]) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"{self._name}: num_envs must be at least 1, got {num_envs!r}")
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def max_episode_steps(self) -> int:
        """The steps after which an episode is truncated."""
        return int(self._simulation.step_limit)

    @property
    def spec(self) -> EnvSpec | None:
        """What `gymnasium.make_vec` made it from, with the time limit that holds."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        # make_vec leaves the registered limit in the spec, whatever it was asked for.
        self._spec = copy.copy(spec)
        if self._spec is not None:
            self._spec.max_episode_steps = self.max_episode_steps

    def _begin(
        self, seed: Any, options: Mapping[str, Any] | None
    ) -> tuple[NDArray[np.bool_], Mapping[str, Any]]:
        """Check the arguments of `reset` and seed the worlds: which start anew [N], and options."""
        if self.closed:
            raise closed(self._name)
        given = checked_options(self._name, options, self.options)
        mask = checked_mask(self._name, given.get(RESET_MASK), self.num_envs)
        if not (self._started or mask.all()):
            raise gymnasium.error.ResetNeeded(
                f"{self._name}: the first reset must start every environment; give no reset_mask"
            )
        seeds = world_seeds(self._name, seed, self.num_envs)
        for index in np.flatnonzero(mask).tolist():
            if seeds[index] is not None:
                self._simulation.generators[index] = seeding.np_random(seeds[index])[0]
        return mask, given

    def _refusal(self) -> Exception:
        """Why there is no step to take."""
        return closed(self._name) if self.closed else reset_needed(self._name)

    def close_extras(self, **kwargs: Any) -> None:
        self._started = False

    def render(self) -> Any:
        """One RGB frame a world, or None without a render mode."""
        if self.render_mode is None:
            return None
        if not self._started:
            raise self._refusal()
        return tuple(self._frame(index) for index in range(self.num_envs))

    def _frame(self, index: int) -> NDArray[np.uint8]:
        raise NotImplementedError

    def get_state(self) -> dict[str, Any]:
        """A complete snapshot: arrays and plain numbers only."""
        return self._simulation.get_state() | {"running": self._started}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a snapshot of an equal environment; it then continues bit for bit.

        Raises ValueError for a snapshot of another environment.
        """
        self._simulation.set_state(state)
        # Snapshots of the aircraft were once without this entry.
        self._started = bool(state.get("running", True)) and not self.closed


def reset_needed(name: str) -> Exception:
    return gymnasium.error.ResetNeeded(
        f"{name}: call reset() before the first step and after an episode's end"
    )


def closed(name: str) -> Exception:
    return gymnasium.error.ClosedEnvironmentError(
        f"{name}: the environment is closed; make another"
    )


def checked_limit(name: str, given: Any, registered: int) -> int:
    """Steps of an episode; None stands for the registered limit, as in `gymnasium.make`."""
    if given is None:
        return registered
    if isinstance(given, bool) or not isinstance(given, int) or given < 1:
        raise ValueError(f"{name}: max_episode_steps must be a positive integer, got {given!r}")
    return given


def checked_render_mode(name: str, render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"{name}: render_mode must be None or 'rgb_array', got {render_mode!r}")
    return render_mode


def checked_options(
    name: str, options: Mapping[str, Any] | None, known: Sequence[str]
) -> Mapping[str, Any]:
    """The options of a reset. Raises ValueError that names an unknown one."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise ValueError(f"{name}: reset options must be a dictionary, got {options!r}")
    unknown = [key for key in options if key not in known]
    if unknown:
        raise ValueError(
            f"{name}: reset has no option {unknown[0]!r}; options: {', '.join(known) or 'none'}"
        )
    return options


def checked_mask(name: str, mask: Any, num_envs: int) -> NDArray[np.bool_]:
    """Which of N worlds a reset starts anew: all, or where Gymnasium's `reset_mask` is true."""
    if mask is None:
        return np.ones(num_envs, np.bool_)
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (num_envs,):
        found = f"{mask.dtype} {mask.shape}" if isinstance(mask, np.ndarray) else repr(mask)
        raise ValueError(
            f"{name}: reset_mask must be a bool array of shape ({num_envs},), got {found}"
        )
    if not mask.any():
        raise ValueError(f"{name}: reset_mask is true nowhere; at least one must be reset")
    return mask.copy()


def checked_seed(name: str, seed: Any) -> int | None:
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"{name}: a seed must be None or an integer from 0 on, got {seed!r}")
    return int(seed)


def world_seeds(name: str, seed: Any, num_envs: int) -> list[int | None]:
    """A seed for each world: of an integer s, s + i; None keeps a world's generator."""
    if isinstance(seed, list | tuple) or (isinstance(seed, np.ndarray) and seed.ndim == 1):
        if len(seed) != num_envs:
            raise ValueError(f"{name}: {len(seed)} seeds for {num_envs} environments")
        return [checked_seed(name, one) for one in seed]
    first = checked_seed(name, seed)
    return [None if first is None else first + index for index in range(num_envs)]
