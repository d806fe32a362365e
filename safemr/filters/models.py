"""Where an action leads: the models that a safety filter looks ahead with.

A model is asked about N present states at once. Four are here: the point robot's closed one
(`PointRobotModel`), the environment itself from a snapshot (`SimulatorModel`), a user's one-step
function (`FunctionModel`), and the constraint critic of a trained run (`CriticModel`), which knows
no dynamics and says g itself. `model_for` picks one.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr.certificates.certificate import Certificate
from safemr.certificates.falsification import action_grid
from safemr.certificates.point_robot import ROBOT
from safemr.errors import UserError, show
from safemr.filters.choice import Array, Margins, Rows, Span
from safemr.learning.interface import held
from safemr.names import unknown
from safemr.tasks import traits

# d and d_dot [B, K, M] after a decision, and the observations [B, K, D] then, where they are known.
Reached = tuple[Array, Array, NDArray[Any] | None]
Predict = Callable[[Rows, NDArray[Any]], Reached]
OneStep = Callable[[NDArray[Any], NDArray[Any]], tuple[Any, Any]]

NAMES = ("point_robot", "simulator", "critic")
CRITIC = "critic_parameters"  # in a policy file, where the configuration asks for `record_critic`


class Model(ABC):
    """What is known of the next state. Its g is that of the certificate (Eq. cstr0)."""

    observes = False  # whether it knows the next observation

    @abstractmethod
    def look(self, observations: NDArray[Any]) -> Predict:
        """What follows the N present states, which it remembers."""

    def margins(
        self, certificate: Certificate, d_min: float, phi: Array, observations: NDArray[Any]
    ) -> Margins:
        """g of actions in the present states, whose phi is [N] and whose observations [N, D]."""
        predict = self.look(observations)

        def g(rows: Rows, actions: NDArray[Any]) -> Array:
            d, d_dot, seen = predict(rows, actions)
            return certificate.constraint(
                phi[rows][:, None], certificate.phi(d, d_dot, d_min, seen)
            )

        return g


class PointRobotModel(Model):
    """`PointRobot` for environments that are its own, scalar or batched: exact away from contact.

    An action is held for ``action_repeat`` control steps. The box and the vase are not in it.
    """

    def __init__(self, env: Any, action_repeat: int = 1) -> None:
        self._env, self._action_repeat = env, action_repeat

    def look(self, observations: NDArray[Any]) -> Predict:
        worlds = self._env.get_state()["worlds"]
        start, qpos, qvel = (worlds[name] for name in ("start", "qpos", "qvel"))
        # The slide joints turn with the body: both are in the frame of the start.
        c, s = np.cos(start[:, 2]), np.sin(start[:, 2])

        def turned(x: NDArray[Any]) -> Array:
            return np.stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1], x[:, 2]], -1)

        pose, velocity, obstacles = start + turned(qpos), turned(qvel), worlds["obstacles"]

        def predict(rows: Rows, actions: NDArray[Any]) -> Reached:
            shape = actions.shape[:2]
            flat = np.repeat(rows, shape[1])
            given = actions.reshape(-1, 2).astype(np.float64)
            place, moves = pose[flat], velocity[flat]
            for _ in range(self._action_repeat):
                place, moves = ROBOT.step(place, moves, given)
            gap = place[:, None, :2] - obstacles[flat]
            d = np.hypot(gap[..., 0], gap[..., 1])
            d_dot = (gap * moves[:, None, :2]).sum(-1) / np.maximum(d, 1e-12)
            return d.reshape(*shape, -1), d_dot.reshape(*shape, -1), None

        return predict


class SimulatorModel(Model):
    """A twin of an environment with `get_state` and `set_state`, scalar or batched.

    It is stepped once (or ``action_repeat`` times) an action, whereas the environment itself is
    left alone. Exact, and as slow as the environment.
    """

    observes = True

    def __init__(self, env: Any, action_repeat: int = 1) -> None:
        for name in ("get_state", "set_state"):
            if not callable(getattr(env, name, None)):
                raise UserError(
                    f"{type(env).__name__} has no {name}: give the filter a one-step model or a "
                    "certificate whose record holds its critic (record_critic)"
                )
        self._env, self._action_repeat = env, action_repeat
        twin = copy.deepcopy(env)
        self._count = int(getattr(env, "num_envs", 0))  # 0: a scalar one
        self._twin = held(twin, action_repeat) if self._count else twin

    def look(self, observations: NDArray[Any]) -> Predict:
        state = self._env.get_state()
        advance = self._advance_batch if self._count else self._advance

        def predict(rows: Rows, actions: NDArray[Any]) -> Reached:
            found = []
            for column in range(actions.shape[1]):
                self._twin.set_state(state)
                found.append(advance(rows, actions[:, column]))
            d, d_dot, seen = (np.stack(parts, 1) for parts in zip(*found, strict=True))
            return d, d_dot, seen

        return predict

    def _advance(self, rows: Rows, actions: NDArray[Any]) -> tuple[NDArray[Any], ...]:
        for _ in range(self._action_repeat):
            seen, _, terminated, truncated, info = self._twin.step(actions[0])
            if terminated or truncated:
                break
        return tuple(np.array(part)[None] for part in (info["d"], info["d_dot"], seen))

    def _advance_batch(self, rows: Rows, actions: NDArray[Any]) -> tuple[NDArray[Any], ...]:
        given = np.zeros((self._count, actions.shape[1]), actions.dtype)
        given[rows] = actions
        seen, _, terminated, truncated, infos = self._twin.step(given)
        parts = [np.array(part) for part in (infos["d"], infos["d_dot"], seen)]
        ended = np.asarray(terminated) | np.asarray(truncated)
        if ended.any():
            final = infos["final_info"]
            for part, last in zip(
                parts, (final["d"], final["d_dot"], infos["final_obs"]), strict=True
            ):
                part[ended] = last[ended]
        return tuple(part[rows] for part in parts)


class FunctionModel(Model):
    """A user's one-step model ``function(states, actions) -> d, d_dot``.

    states [S, D] and actions [S, A] are rows that belong together, d [m] and d_dot [m/s] are [S, M]
    of the states a decision later. The states are the observations or, with ``state``, what that
    function of no arguments says at present: [N, D], or [D] of a scalar environment.
    """

    def __init__(self, function: OneStep, state: Callable[[], Any] | None = None) -> None:
        self._function, self._state = function, state
        self._name = getattr(function, "__name__", type(function).__name__)

    def look(self, observations: NDArray[Any]) -> Predict:
        states = np.asarray(observations)
        if self._state is not None:
            states = np.array(self._state(), np.float64)
            states = states.reshape(len(observations), -1)

        def predict(rows: Rows, actions: NDArray[Any]) -> Reached:
            count, columns, size = actions.shape
            given = states[np.repeat(rows, columns)], actions.reshape(-1, size)
            result: Any = self._function(*given)
            if not isinstance(result, tuple) or len(result) != 2:
                raise self._wrong(f"it returns {show(type(result).__name__)}")
            d, d_dot = (self._checked(part, count * columns) for part in result)
            if d.shape != d_dot.shape:
                raise self._wrong(f"d has shape {d.shape} and d_dot {d_dot.shape}")
            return d.reshape(count, columns, -1), d_dot.reshape(count, columns, -1), None

        return predict

    def _checked(self, part: Any, rows: int) -> Array:
        try:
            values = np.asarray(part, np.float64)
        except (TypeError, ValueError):
            raise self._wrong("it returns what is no array of numbers") from None
        if values.ndim != 2 or values.shape[0] != rows:
            raise self._wrong(f"for {rows} rows it returns an array of shape {values.shape}")
        if not np.isfinite(values).all():
            raise self._wrong("it returns numbers that are not finite")
        return values

    def _wrong(self, what: str) -> UserError:
        return UserError(
            f"the model {self._name}: {what}; it must return (d, d_dot), finite and of shape "
            "[rows, obstacles]"
        )


class CriticModel(Model):
    """The constraint critic Q_phi of a run: max(g, constraint_floor) as it was learned.

    It needs no dynamics and no obstacles, and errs. Raises UserError where the policy file holds
    none.
    """

    def __init__(self, policy: Any) -> None:
        from safemr.learning.policies import network_from_arrays  # torch, seconds

        if CRITIC not in policy.extras:
            raise UserError(
                "this policy was recorded without its constraint critic: train with "
                "record_critic: true, or give the filter a model"
            )
        self._policy, self._network = policy, network_from_arrays("critic", policy.extras)
        self._scale = float(policy.extras["critic_scale"])

    def look(self, observations: NDArray[Any]) -> Predict:
        raise UserError("a constraint critic predicts no state")

    def margins(
        self, certificate: Certificate, d_min: float, phi: Array, observations: NDArray[Any]
    ) -> Margins:
        import torch

        seen = self._policy.transform(observations)
        units = np.array(self._policy.interface.action_scale or 1.0, np.float32)

        def g(rows: Rows, actions: NDArray[Any]) -> Array:
            count, columns, size = actions.shape
            learners = np.clip(actions.reshape(-1, size) / units, -1.0, 1.0).astype(np.float32)
            inputs = np.concatenate([seen[np.repeat(rows, columns)], learners], 1)
            with torch.no_grad():
                values = self._network(torch.from_numpy(inputs))[0, :, 0].numpy()
            return values.reshape(count, columns).astype(np.float64) / self._scale

        return g


def model_for(
    model: Any, env: Any, certificate: Certificate, action_repeat: int, state: Any = None
) -> Model:
    """The model that a person means: one of `NAMES`, a function, a `Model`, or None.

    None is the closed model of the point robot, unless it pushes a box or phi asks for the
    observation; then the simulator, where the environment has snapshots; then the critic.

    Raises:
        UserError: there is no such model, or it does not fit the environment or the certificate.
    """
    robot = traits(env)
    if model is None:
        snapshots = all(hasattr(env, name) for name in ("get_state", "set_state"))
        if robot.point_robot and not robot.pushes_box and not certificate.observes:
            model = "point_robot"
        elif snapshots:
            model = "simulator"
        elif certificate.record is not None and certificate.record.has_policy:
            model = "critic"
        else:
            raise UserError(
                f"nothing says where an action leads in {type(env).__name__}: give the filter a "
                "model(observations, actions) -> d, d_dot, or the environment get_state and "
                "set_state"
            )
    if isinstance(model, str):
        model = _named(model, env, certificate, action_repeat, robot.point_robot)
    elif not isinstance(model, Model):
        if not callable(model):
            raise UserError(
                f"model = {show(model)}: use one of {', '.join(NAMES)} or a function of "
                "observations and actions"
            )
        model = FunctionModel(model, state)
    if certificate.observes and not model.observes and not isinstance(model, CriticModel):
        raise UserError(
            f"phi of {certificate.name} asks for the observation, which this model does not "
            "predict: use model='simulator'"
        )
    return model


def _named(
    name: str, env: Any, certificate: Certificate, action_repeat: int, point_robot: bool
) -> Model:
    if name == "point_robot":
        if not point_robot:
            raise UserError(
                f"model='point_robot' is of the point robot's tasks, {type(env).__name__} is none: "
                "use model='simulator' or a function"
            )
        return PointRobotModel(env, action_repeat)
    if name == "simulator":
        return SimulatorModel(env, action_repeat)
    if name == "critic":
        if certificate.record is None:
            raise UserError(
                "model='critic' needs a certificate of a record: safemr.load(folder).certificate"
            )
        return CriticModel(certificate.record.policy())
    raise unknown("model", name, NAMES)


def span_of(env: Any) -> Span:
    """The useful range of an environment's actions: its Box, within what the point robot feels.

    Raises UserError for actions that are no bounded Box of one dimension.
    """
    space = getattr(env, "single_action_space", None) or env.action_space
    shape = getattr(space, "shape", None) or ()
    if len(shape) != 1 or not hasattr(space, "low") or np.dtype(space.dtype).kind != "f":
        raise UserError(
            f"the action space {show(space)} cannot be filtered: it must be a Box of one dimension"
        )
    low, high = (np.asarray(end, np.float64).copy() for end in (space.low, space.high))
    if traits(env).point_robot:
        low[0], high[0] = -ROBOT.force_limit, ROBOT.force_limit
    return Span(low, high)


@dataclass(frozen=True)
class Lattice:
    """The same candidates [K, A] in every state."""

    actions: Array

    def __call__(self, observations: NDArray[Any]) -> Array:
        """[N, K, A] for observations [N, D]."""
        return np.broadcast_to(self.actions, (len(observations), *self.actions.shape))


@dataclass(frozen=True)
class RobotGrid:
    """The candidates of the search, dense where the yaw servo's torque changes.

    ``turn_rate`` is its column of an observation.
    """

    turn_rate: int

    def __call__(self, observations: NDArray[Any]) -> Array:
        """[N, K, 2] for observations [N, D]."""
        return action_grid(np.asarray(observations, np.float64)[:, self.turn_rate])


def grid_of(env: Any, span: Span) -> Lattice | RobotGrid:
    """The candidates of an environment."""
    if traits(env).point_robot:
        return RobotGrid(env.observation_layout["gyro"].start + 2)
    return Lattice(span.grid())


def energy_of(
    certificate: Certificate, d: Array, d_dot: Array, d_min: float, observations: NDArray[Any]
) -> Array:
    """phi [N] of the present states."""
    seen = observations if certificate.observes else None
    return np.asarray(certificate.phi(d, d_dot, d_min, seen), np.float64)
