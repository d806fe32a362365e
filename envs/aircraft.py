"""Two aircraft at one altitude: an evader that turns, and traffic that flies a circle.

The state is the traffic's pose in the evader's body frame: x ahead [m], y to the left [m] and the
heading difference psi [rad]. Both fly at constant speed; the evader chooses its turn rate a, the
traffic's is b (Mitchell, Bayen and Tomlin, IEEE TAC 50(7), 2005, section V):

    dx/dt = -va + vb cos psi + a y,    dy/dt = vb sin psi - a x,    dpsi/dt = b - a.

A collision is a separation d < d_min = 5. The reward -a^2 asks for straight flight, so the
unconstrained optimum ignores the traffic, and safety is all that there is to learn.

`AircraftDynamics` is shared with the reachability solver; `AircraftEnv` and `AircraftVectorEnv`
(id ``Aircraft-v0``) are one implementation, the scalar environment being a batch of one.
"""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from envs.contract import (
    RESET_MASK,
    BatchEnvironment,
    Independent,
    ScalarEnvironment,
    checked_limit,
    checked_render_mode,
)

Floats = NDArray[np.float64]

# Relative positions in which encounters begin and end [m]: the released experiment's box.
BOX_LOW = np.array([-6.0, -10.0])
BOX_HIGH = np.array([20.0, 10.0])

NAME = "Aircraft"
MAX_EPISODE_STEPS = 200
METADATA: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}


@dataclass(frozen=True)
class AircraftDynamics:
    """Relative motion of the pair, with its exact flow over a step of constant turn rates."""

    speed: float = 5.0  # evader [m/s]
    other_speed: float = 5.0  # traffic [m/s]
    turn_limit: float = 1.0  # the evader's turn rate is in [-turn_limit, turn_limit] [rad/s]
    other_turns: tuple[float, ...] = (1.0,)  # rates open to the traffic; several: it is adversarial
    dt: float = 0.1  # control period [s]
    d_min: float = 5.0  # separation below which the aircraft have collided [m]

    def __post_init__(self) -> None:
        for name in ("speed", "other_speed", "turn_limit", "dt", "d_min"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(f"{name} must be positive and finite, not {value!r}")
        if not self.other_turns or not np.all(np.isfinite(self.other_turns)):
            raise ValueError(f"other_turns must hold finite rates, not {self.other_turns!r}")

    def shift(
        self, psi: ArrayLike, a: ArrayLike, b: ArrayLike, duration: ArrayLike | None = None
    ) -> tuple[Floats, Floats]:
        """Displacement of the traffic relative to the evader, in the evader's initial frame.

        Each aircraft flies an arc of length l = speed * duration that turns by w; its chord is
        l sinc(w / 2) in the direction of half the turn, which has no singularity at w = 0.
        """
        t = np.asarray(self.dt if duration is None else duration, float)
        own, other = 0.5 * t * np.asarray(a, float), 0.5 * t * np.asarray(b, float)
        own_chord = self.speed * t * np.sinc(own / np.pi)
        other_chord = self.other_speed * t * np.sinc(other / np.pi)
        direction = np.asarray(psi, float) + other
        return (
            other_chord * np.cos(direction) - own_chord * np.cos(own),
            other_chord * np.sin(direction) - own_chord * np.sin(own),
        )

    def flow(
        self, states: Floats, a: ArrayLike, b: ArrayLike, duration: ArrayLike | None = None
    ) -> Floats:
        """States [..., 3] after ``duration`` (default dt) of constant turn rates a and b [rad/s].
        Turn rates and duration broadcast against the leading axes.

        Exact, and exact backwards for a negative duration. psi is not wrapped.
        """
        t = np.asarray(self.dt if duration is None else duration, float)
        a, b = np.asarray(a, float), np.asarray(b, float)
        x, y, psi = states[..., 0], states[..., 1], states[..., 2]
        shift_x, shift_y = self.shift(psi, a, b, t)
        cos, sin = np.cos(a * t), np.sin(a * t)
        moved_x, moved_y = x + shift_x, y + shift_y
        return np.stack(
            np.broadcast_arrays(
                cos * moved_x + sin * moved_y, cos * moved_y - sin * moved_x, psi + (b - a) * t
            ),
            axis=-1,
        )

    def separation(self, states: Floats) -> Floats:
        """d [m] of states [..., 3]."""
        return np.hypot(states[..., 0], states[..., 1])

    def separation_rate(self, states: Floats) -> Floats:
        """d_dot [m/s] of states [..., 3], (x (vb cos psi - va) + y vb sin psi) / d, and 0 at d = 0.

        Turn rates drop out: they act on d only in its second derivative.
        """
        x, y, psi = states[..., 0], states[..., 1], states[..., 2]
        along = x * (self.other_speed * np.cos(psi) - self.speed)
        across = y * self.other_speed * np.sin(psi)
        d = self.separation(states)
        return np.divide(along + across, d, out=np.zeros_like(d), where=d > 0)


def observe(states: Floats) -> Floats:
    """Observation [x, y, cos psi, sin psi] of states [..., 3]."""
    x, y, psi = states[..., 0], states[..., 1], states[..., 2]
    return np.stack([x, y, np.cos(psi), np.sin(psi)], axis=-1)


def outside_box(states: Floats) -> NDArray[np.bool_]:
    """Whether states [..., 3] have left the box in which encounters take place."""
    position = states[..., :2]
    return np.any((position < BOX_LOW) | (position > BOX_HIGH), axis=-1)


class _Encounters(Independent):
    """N independent encounters: everything that the scalar and the batched environment share."""

    def __init__(self, num_envs: int, other_turn: float, step_limit: int) -> None:
        if isinstance(other_turn, bool) or not isinstance(other_turn, int | float):
            raise ValueError(f"{NAME}: other_turn must be a number [rad/s], got {other_turn!r}")
        self.dynamics = AircraftDynamics(other_turns=(float(other_turn),))
        self.num_envs = num_envs
        self.generators = [seeding.np_random()[0] for _ in range(num_envs)]
        self.states = np.full((num_envs, 3), np.nan)
        self.steps = np.zeros(num_envs, np.int64)
        self.step_limit = step_limit

    def reset(self, index: int) -> None:
        """Uniform on the box and all headings, but not in collision. Unavoidable collisions stay:
        a certificate is learned from both sides of the boundary."""
        generator = self.generators[index]
        while True:
            state = generator.uniform([*BOX_LOW, 0.0], [*BOX_HIGH, 2 * np.pi])
            if np.hypot(state[0], state[1]) > self.dynamics.d_min:
                break
        self.states[index] = state
        self.steps[index] = 0

    def begin(self, mask: NDArray[np.bool_], options: Mapping[str, Any]) -> None:
        """Start the encounters where mask [N] is true, from `options["state"]` if it is given."""
        if "state" not in options:
            for index in np.flatnonzero(mask).tolist():
                self.reset(index)
            return
        try:
            placed = np.array(options["state"], float).reshape(self.states.shape)
        except (TypeError, ValueError):
            placed = np.full_like(self.states, np.nan)
        if not np.all(np.isfinite(placed[mask])):
            raise ValueError(
                f"{NAME}: options['state'] must be {self.num_envs} finite states [x, y, psi], "
                f"not {reprlib.repr(options['state'])}"
            )
        self.states[mask], self.steps[mask] = placed[mask], 0

    def get_state(self) -> dict[str, Any]:
        """Everything that the future depends on, in arrays and plain integers."""
        generators = {}
        for index, generator in enumerate(self.generators):
            bits: dict[str, Any] = dict(generator.bit_generator.state)
            generators[index] = {
                **bits["state"],
                "has_uint32": bits["has_uint32"],
                "uinteger": bits["uinteger"],
            }
        return {"states": self.states.copy(), "steps": self.steps.copy(), "generators": generators}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue bit-identically from a `get_state` of as many encounters."""
        if "states" not in state:
            raise ValueError(f"{NAME}: this is no snapshot of the aircraft task")
        if np.shape(state["states"]) != (self.num_envs, 3):
            raise ValueError(
                f"{NAME}: the state is of {len(state['states'])} encounters, this environment has "
                f"{self.num_envs}"
            )
        self.states = np.array(state["states"], float)
        self.steps = np.array(state["steps"], np.int64)
        for index, generator in enumerate(self.generators):
            saved = state["generators"][index]
            generator.bit_generator.state = {
                "bit_generator": "PCG64",
                "state": {"state": saved["state"], "inc": saved["inc"]},
                "has_uint32": saved["has_uint32"],
                "uinteger": saved["uinteger"],
            }

    def advance(
        self, actions: ArrayLike
    ) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, NDArray[Any]]]:
        """One control period: rewards, terminated, truncated [N] and info of the states reached."""
        given = np.asarray(actions)
        if given.dtype.kind not in "fiu":
            raise ValueError(f"{NAME}: actions must be real numbers, not {given.dtype}")
        turns = given.astype(float)
        if turns.shape != (self.num_envs, 1):
            raise ValueError(
                f"{NAME}: actions must have shape ({self.num_envs}, 1), not {turns.shape}"
            )
        if not np.all(np.isfinite(turns)):
            culprit = int(np.argmin(np.isfinite(turns[:, 0])))
            raise ValueError(
                f"{NAME}: action {turns[culprit, 0]} of encounter {culprit} is not finite"
            )
        limit = self.dynamics.turn_limit
        a = np.clip(turns[:, 0], -limit, limit)
        self.states = self.dynamics.flow(self.states, a, self.dynamics.other_turns[0])
        self.states[:, 2] %= 2 * np.pi
        self.steps += 1
        info = self.info()
        collided = self.dynamics.separation(self.states) < self.dynamics.d_min
        for key in ("cost", "cost_indicator", "cost_contact"):
            info[key] = collided.astype(float)
        # Outside the box nothing is at stake: flying straight on costs nothing, so the value is 0.
        # A bootstrap there would come from states that no transition starts in.
        ended = collided | outside_box(self.states)
        over = self.steps >= self.step_limit
        return -np.square(a), ended, over & ~ended, info

    def info(self) -> dict[str, NDArray[Any]]:
        """Info [N] or [N, 1] of the present states, with no cost: that belongs to a step."""
        zeros = ("cost", "cost_indicator", "cost_contact")
        return {
            **{key: np.zeros(self.num_envs) for key in zeros},
            "d": self.dynamics.separation(self.states)[:, None],
            "d_dot": self.dynamics.separation_rate(self.states)[:, None],
        }


class _Aircraft:
    """Attributes that the library reads from either environment."""

    d_min = AircraftDynamics.d_min
    num_obstacles = 1
    setting_names = ("max_episode_steps", "other_turn")
    task_version = 2  # 1: leaving the box truncated
    observation_layout: ClassVar[dict[str, slice]] = {
        "position": slice(0, 2),
        "heading": slice(2, 4),
    }
    _simulation: _Encounters

    @property
    def dynamics(self) -> AircraftDynamics:
        return self._simulation.dynamics


def _spaces() -> tuple[Any, Any]:
    """Observation and action space of one encounter."""
    # An episode ends one step outside the box: closing at 10 m/s and turning 0.1 rad from its
    # farthest corner, 22.4 m away, stays within 24 m.
    bound = np.array([24.0, 24.0, 1.0, 1.0])
    limit = AircraftDynamics.turn_limit
    return (
        gymnasium.spaces.Box(-bound, bound, dtype=np.float64),
        gymnasium.spaces.Box(-limit, limit, (1,), np.float32),
    )


class AircraftEnv(_Aircraft, ScalarEnvironment):
    """One encounter.

    Action: the evader's turn rate [rad/s], clipped to [-1, 1]. Observation: [x, y, cos psi,
    sin psi]. Reward -a^2; cost 1 in collision. A collision terminates, as does leaving the box
    x [-6, 20], y [-10, 10], where no effort is needed any more; 200 steps truncate.
    ``reset(options={"state": [x, y, psi]})`` chooses the start. Raises ValueError for actions that
    are not finite or not of shape (1,).
    """

    metadata = METADATA
    options = ("state",)

    def __init__(
        self,
        other_turn: float = 1.0,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        self._name = NAME
        self.render_mode = checked_render_mode(NAME, render_mode)
        self.observation_space, self.action_space = _spaces()
        limit = checked_limit(NAME, max_episode_steps, MAX_EPISODE_STEPS)
        self._simulation = _Encounters(1, other_turn, limit)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        self._simulation.begin(np.ones(1, bool), self._begin(seed, options))
        self._placed = self._running = True
        return observe(self._simulation.states[0]), _first(self._simulation.info())

    def step(self, action: NDArray[np.float32]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        if not self._running:
            raise self._refusal()
        rewards, terminated, truncated, info = self._simulation.advance(np.asarray(action)[None])
        self._running = not (terminated[0] or truncated[0])
        observation = observe(self._simulation.states[0])
        return observation, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), _first(info)

    def _frame(self) -> NDArray[np.uint8]:
        """Top view in the evader's frame, [260, 260, 3]."""
        return _draw(self._simulation.states[0], self.d_min)


class AircraftVectorEnv(_Aircraft, BatchEnvironment):
    """N encounters advanced together; an ended one restarts within the same step.

    ``reset(seed=s)`` seeds encounter i with s + i, so it repeats `AircraftEnv` seeded so; in a
    sequence of seeds None keeps an encounter's generator. ``options={"state": [N, 3]}`` chooses the
    starts, ``{"reset_mask": bool [N]}`` which encounters start anew. Observations [N, 4], actions
    [N, 1].
    """

    metadata = METADATA | BatchEnvironment.metadata
    options = ("state", RESET_MASK)

    def __init__(
        self,
        num_envs: int = 1,
        other_turn: float = 1.0,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
    ) -> None:
        self._name = NAME
        self.render_mode = checked_render_mode(NAME, render_mode)
        self._set_spaces(num_envs, _spaces())
        limit = checked_limit(NAME, max_episode_steps, MAX_EPISODE_STEPS)
        self._simulation = _Encounters(num_envs, other_turn, limit)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Floats, dict[str, Any]]:
        mask, given = self._begin(seed, options)
        self._simulation.begin(mask, given)
        self._started = True
        return observe(self._simulation.states), _masked(self._simulation.info(), mask)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Floats, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        if not self._started:
            raise self._refusal()
        encounters = self._simulation
        rewards, terminated, truncated, info = encounters.advance(actions)
        ended = terminated | truncated
        infos = _masked(info)
        if ended.any():
            infos["final_obs"], infos["_final_obs"] = observe(encounters.states), ended
            infos["final_info"] = _masked(info, ended)
            infos["_final_info"] = ended.copy()
            for index in np.flatnonzero(ended).tolist():
                encounters.reset(index)
            started = encounters.info()
            infos["d"], infos["d_dot"] = started["d"], started["d_dot"]
        return observe(encounters.states), rewards, terminated, truncated, infos

    def _frame(self, index: int) -> NDArray[np.uint8]:
        """Top view in the evader's frame, [260, 260, 3]."""
        return _draw(self._simulation.states[index], self.d_min)


def _first(info: dict[str, NDArray[Any]]) -> dict[str, Any]:
    """Info of a batch of one as plain scalars, and arrays [M] per obstacle."""
    return {
        key: value[0].copy() if value.ndim > 1 else value[0].item() for key, value in info.items()
    }


def _masked(
    info: dict[str, NDArray[Any]], present: NDArray[np.bool_] | None = None
) -> dict[str, Any]:
    """Info with Gymnasium's ``_key`` masks, by default present everywhere."""
    some = next(iter(info.values()))
    mask = np.ones(len(some), bool) if present is None else present
    return {
        name: item
        for key, value in info.items()
        for name, item in ((key, value.copy()), (f"_{key}", mask.copy()))
    }


def _draw(state: Floats, d_min: float) -> NDArray[np.uint8]:
    """Top view of the box, nose to the right: evader blue, its collision disc, traffic red."""
    x, y = np.meshgrid(np.arange(-5.95, 20, 0.1), np.arange(12.95, -13, -0.1))
    picture = np.full((*x.shape, 3), 255, np.uint8)
    picture[(y < BOX_LOW[1]) | (y > BOX_HIGH[1])] = (225, 225, 225)
    picture[np.abs(np.hypot(x, y) - d_min) < 0.1] = (120, 120, 120)
    for (px, py, heading), colour in (((0.0, 0.0, 0.0), (0, 90, 180)), (state, (200, 30, 30))):
        ahead = (x - px) * np.cos(heading) + (y - py) * np.sin(heading)
        aside = (y - py) * np.cos(heading) - (x - px) * np.sin(heading)
        picture[(ahead > -0.8) & (np.abs(aside) < 0.35 * (1.2 - ahead))] = colour
    return picture
