"""What the learners ask of an environment, and the package `envs` beside this one.

`SafetyEnvs` is the whole of it; `check_envs` says what a batch lacks. The package registers the
tasks with Gymnasium, and `safemr.tasks.make_envs` makes a batch of one.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from safemr.errors import UserError, show

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Observations = NDArray[np.floating]
    Infos = dict[str, Any]

PACKAGE = "envs"

# Every step's info has these: cost [N], at least 0; d and d_dot [N, M], the distance to each of M
# obstacles [m] and its rate [m/s], of the state that the observation shows. After an autoreset that
# is the next episode's first; what the ended episode reached is in `final_info` and `final_obs`.
# `reset` gives d and d_dot, too.
REQUIRED_INFOS = ("cost", "d", "d_dot")

# These [N] it may have; a batch without one has, in `info_of`, what stands behind it.
OPTIONAL_INFOS = {
    "cost_indicator": "1 where cost > 0",
    "cost_contact": "cost_indicator",
    "goal_met": "0",
    "reward_approach": "0",
    "reward_push": "0",
    "reward_goal": "0",
    "control_steps": "1",
}


# A bound beyond it is none: some spaces write the largest number of their type for infinity.
LARGEST_BOUND = 1e6


class SafetyEnvs(Protocol):
    """N environments stepped together, each with M obstacles that a distance is kept to.

    As a vector environment of Gymnasium with SAME_STEP autoreset and dense infos (`REQUIRED_INFOS`,
    `OPTIONAL_INFOS`). Actions lie in [-1, 1]; where an environment's do not, it rescales them.
    """

    metadata: dict[str, Any]  # "autoreset_mode"

    @property
    def num_envs(self) -> int: ...

    @property
    def single_observation_space(self) -> Any:
        """Of one environment: a Box of one dimension."""

    @property
    def single_action_space(self) -> Any:
        """Of one environment: a Box of one dimension between -1 and 1."""

    @property
    def d_min(self) -> float:
        """The distance to be kept [m]."""

    @property
    def num_obstacles(self) -> int: ...

    @property
    def max_episode_steps(self) -> int:
        """The steps after which an episode is truncated."""

    @property
    def observation_layout(self) -> Mapping[str, slice]:
        """Sensor -> its columns of an observation; empty where nothing but the space is known."""

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Any = None
    ) -> tuple[Observations, Infos]: ...

    def step(
        self, actions: Any
    ) -> tuple[Observations, NDArray[np.floating], NDArray[np.bool_], NDArray[np.bool_], Infos]: ...

    def close(self) -> None: ...

    def get_state(self) -> dict[str, Any]:
        """A complete snapshot, which shares no memory with the environments."""

    def set_state(self, state: Mapping[str, Any]) -> tuple[Observations, Infos] | None:
        """Restore a snapshot; the environments then continue bit for bit.

        Those that cannot say ``exact_resume = False``: they begin new episodes, and what `reset`
        gives of them is returned.
        """


def info_of(infos: Mapping[str, Any], name: str) -> Any:
    """One quantity of a step's infos [N], or the default of one that the environment lacks."""
    if name in infos or name in REQUIRED_INFOS:
        return infos[name]
    if name == "cost_contact":
        return info_of(infos, "cost_indicator")
    if name == "cost_indicator":
        return infos["cost"] > 0.0
    return 1.0 if name == "control_steps" else 0.0


def bounded(space: Any) -> NDArray[np.bool_]:
    """Which entries of a Box have bounds that say something of their scale."""
    import numpy as np

    finite = (np.abs(space.low) <= LARGEST_BOUND) & (np.abs(space.high) <= LARGEST_BOUND)
    return finite & (space.low < space.high)


def exact_resume(envs: Any) -> bool:
    """Whether a snapshot of the environments continues bit for bit, as it does unless they say."""
    return bool(getattr(envs, "exact_resume", True))


def check_envs(envs: Any) -> None:
    """Refuse a batch that is no `SafetyEnvs`. It is reset and stepped: reset it before its use.

    Raises:
        UserError: for the first thing that is missing or wrong, with the remedy.
    """
    import numpy as np

    def require(holds: Any, what: str, remedy: str) -> None:
        if not holds:
            raise UserError(f"{type(envs).__name__}: {what}; {remedy}")

    def count(name: str, remedy: str) -> int:
        value: Any = getattr(envs, name, None)
        whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        require(whole and value >= 1, f"{name} is {_seen(envs, name)}", remedy)
        return int(value)

    def array(value: Any, name: str, shape: tuple[int, ...], kinds: str = "fiub") -> None:
        try:
            found = np.asarray(value)
        except ValueError:
            found = np.array(None)
        require(
            found.shape == shape and found.dtype.kind in kinds,
            f"{name} has shape {found.shape} and type {found.dtype}",
            f"make it {'bool' if kinds == 'b' else 'numbers'} of shape {shape}",
        )
        require(kinds == "b" or np.isfinite(found).all(), f"{name} is not finite", "it must be")

    for name in ("reset", "step", "close", "get_state", "set_state"):
        remedy = "a run that is to be resumed needs it" if "state" in name else "define it"
        require(callable(getattr(envs, name, None)), f"the method {name} is missing", remedy)
    n = count("num_envs", "it is the number of environments stepped together")
    m = count("num_obstacles", "it is the number of columns of d and d_dot")
    count("max_episode_steps", "it is the number of steps after which an episode is truncated")
    d_min = getattr(envs, "d_min", None)
    require(
        isinstance(d_min, int | float | np.number) and 0.0 < d_min < np.inf,
        f"d_min is {_seen(envs, 'd_min')}",
        "it is the distance to be kept, a positive number",
    )
    width, actions = (_columns(envs, name) for name in _SPACES)
    for name, found in zip(_SPACES, (width, actions), strict=True):
        require(found, f"{name} is {_seen(envs, name)}", "make it a Box of one dimension")
    space = envs.single_action_space
    require(
        (space.low == -1.0).all() and (space.high == 1.0).all(),
        f"single_action_space is {show(space)}",
        "the learners act between -1 and 1: rescale in the environment",
    )
    layout = getattr(envs, "observation_layout", None)
    inside = isinstance(layout, Mapping) and all(
        isinstance(part, slice)
        and isinstance(part.start, int)
        and isinstance(part.stop, int)
        and 0 <= part.start < part.stop <= width
        for part in layout.values()
    )
    require(
        inside,
        f"observation_layout is {_seen(envs, 'observation_layout')}",
        f"it maps each sensor to its slice of the {width} columns",
    )
    mode = (getattr(envs, "metadata", None) or {}).get("autoreset_mode")
    require(
        getattr(mode, "name", None) == "SAME_STEP",
        f"metadata['autoreset_mode'] is {show(mode)}",
        "make it gymnasium.vector.AutoresetMode.SAME_STEP and restart ended episodes in that step",
    )

    def infos_of(infos: Any, names: Sequence[str], where: str) -> None:
        require(isinstance(infos, Mapping), f"the infos of {where} are no dictionary", "make them")
        for name in names:
            require(
                name in infos, f"the infos of {where} lack {name!r}", "every learner is told it"
            )
        for name in (*names, *(name for name in OPTIONAL_INFOS if name in infos)):
            shape = (n, m) if name in ("d", "d_dot") else (n,)
            array(infos[name], f"{where}: infos[{name!r}]", shape)

    result: Any
    try:
        result = envs.reset(seed=0)
    except TypeError as error:
        raise UserError(
            f"{type(envs).__name__}: reset(seed=0) fails: {error}; take seed and options by name"
        ) from error
    require(isinstance(result, tuple) and len(result) == 2, "reset gives no pair", _RESET)
    array(result[0], "reset: observations", (n, width), "f")
    infos_of(result[1], ("d", "d_dot"), "reset")
    saved, given = envs.get_state(), np.full((n, actions), 0.5, np.float32)
    result = envs.step(given)
    require(isinstance(result, tuple) and len(result) == 5, "step gives no five things", _STEP)
    array(result[0], "step: observations", (n, width), "f")
    array(result[1], "step: rewards", (n,))
    for value, name in zip(result[2:4], ("terminated", "truncated"), strict=True):
        array(value, f"step: {name}", (n,), "b")
    infos_of(result[4], REQUIRED_INFOS, "step")
    require((np.asarray(result[4]["cost"]) >= 0).all(), "cost is negative", "0 is no cost")
    if not exact_resume(envs):
        return
    reached = np.array(result[0])
    envs.set_state(saved)
    require(
        np.array_equal(envs.step(given)[0], reached),
        "after set_state the same action leads elsewhere",
        "get_state must copy all that the next step depends on, random generators included",
    )


_SPACES = ("single_observation_space", "single_action_space")
_RESET = "return (observations, infos)"
_STEP = "return (observations, rewards, terminated, truncated, infos)"


def _seen(envs: Any, name: str) -> str:
    """What a person sees of an attribute."""
    return show(getattr(envs, name)) if hasattr(envs, name) else "missing"


def _columns(envs: Any, name: str) -> int:
    """The columns of a one-dimensional Box, 0 for anything else."""
    space = getattr(envs, name, None)
    shape: tuple[int, ...] = getattr(space, "shape", None) or ()
    return int(shape[0]) if len(shape) == 1 and hasattr(space, "low") else 0


@functools.cache
def register_tasks() -> None:
    """Import the environments, so that Gymnasium knows the tasks.

    Raises:
        UserError: if Python finds another package of that name first, as `python -m` does in a
            folder that holds one.
    """
    ours = (Path(__file__).resolve().parents[1] / PACKAGE).resolve()
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None:
        raise UserError(f"the package {PACKAGE} is missing: {ours}")
    found = Path(spec.origin or next(iter(spec.submodule_search_locations or [""])))
    if found.resolve().parent != ours:
        raise UserError(
            f"Python found another package {PACKAGE}, {found}, before the tasks' own, {ours}: "
            "start from another folder or with `python -P`, or take that one out of PYTHONPATH"
        )
    importlib.import_module(PACKAGE)
