"""How every learner meets a task: how long an action is held, how it is scaled, what is decoded.

It lies between a learner and its environment, is the same for all algorithms of a comparison and
leaves the environment as it is. A *decision* is an action held for ``action_repeat`` control steps
(of the environment); budgets, curves, costs and the lengths of episodes stay in control steps,
whereas discounts, n-step returns and a constraint between two states count decisions.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from safemr.environments import OPTIONAL_INFOS, SafetyEnvs, info_of
from safemr.errors import UserError, show
from safemr.names import unknown

Floats = NDArray[np.floating]
Flags = NDArray[np.bool_]

SINGLE = "single"  # stands for every lidar that sees one object


@dataclass(frozen=True)
class Interface:
    """The interface of a run; the default is the environment as it is.

    action_repeat: control steps for which an action is held. action_scale: what a component of
    the learner's action in [-1, 1] is multiplied by, one number each; empty: nothing. decode:
    lidars that are read as bearing and distance of the one object that they see, which is the same
    information (`safemr.learning.observation`).
    """

    action_repeat: int = 1
    action_scale: tuple[float, ...] = ()
    decode: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        repeat = self.action_repeat
        if isinstance(repeat, bool) or not isinstance(repeat, int) or repeat < 1:
            raise UserError(f"action_repeat must be an integer of at least 1, not {show(repeat)}")
        if not all(0.0 < scale <= 1.0 for scale in self.action_scale):
            raise UserError(
                f"action_scale must be numbers in (0, 1], not {show(list(self.action_scale))}"
            )
        # An entry's text and with it a run's digest depend on the type; 1 and 1.0 are the same.
        object.__setattr__(self, "action_scale", tuple(map(float, self.action_scale)))
        if len(set(self.decode)) < len(self.decode):
            raise UserError(f"decode names a lidar twice: {show(list(self.decode))}")

    @classmethod
    def read(cls, entry: Any, where: str = "interface") -> Interface:
        """From its entry in a configuration; None is the environment as it is.

        Raises:
            UserError: naming ``where`` and what is wrong.
        """
        if entry is None:
            return cls()
        if not isinstance(entry, Mapping):
            raise UserError(f"{where} must be a mapping, not {show(entry)}")
        names = [field.name for field in dataclasses.fields(cls)]
        for name in entry:
            if name not in names:
                raise unknown("setting", name, names, where)
        scale, decode = entry.get("action_scale", ()), entry.get("decode", ())
        if not _is_list(scale) or not all(_is_number(value) for value in scale):
            raise UserError(
                f"{where}.action_scale must be a list of one number in (0, 1] for each component "
                f"of an action, not {show(scale)}"
            )
        if decode == SINGLE:
            decode = (SINGLE,)
        if not _is_list(decode) or not all(isinstance(name, str) for name in decode):
            raise UserError(
                f"{where}.decode must be a list of lidars or {SINGLE!r}, not {show(decode)}"
            )
        try:
            return cls(entry.get("action_repeat", 1), tuple(scale), tuple(decode))
        except UserError as error:
            raise UserError(f"{where}.{error}") from error

    def fitted(self, envs: Any, where: str = "interface") -> Interface:
        """The same with every lidar named, checked against an environment, scalar or batched.

        Raises:
            UserError: it does not fit; naming ``where`` and what would.
        """
        decodable = sorted(getattr(envs, "decodable_lidars", ()))
        decode = tuple(decodable) if self.decode == (SINGLE,) else tuple(sorted(self.decode))
        for name in decode:
            if name not in decodable:
                raise UserError(
                    f"{where}.decode: {name} is no lidar of a single object here; "
                    f"those are {', '.join(decodable) or 'none'}"
                )
        space = getattr(envs, "single_action_space", None) or envs.action_space
        components = math.prod(space.shape)
        if self.action_scale and len(self.action_scale) != components:
            raise UserError(
                f"{where}.action_scale must have {components} numbers, one for each component of "
                f"an action, not {len(self.action_scale)}"
            )
        limit = envs.max_episode_steps
        if limit is not None and self.action_repeat > limit:
            raise UserError(
                f"{where}.action_repeat = {self.action_repeat}: must not exceed the {limit} steps "
                "of an episode"
            )
        return dataclasses.replace(self, decode=decode)

    def entry(self) -> dict[str, Any]:
        """What a run's configuration says of it: what differs from the environment as it is."""
        fields = dataclasses.asdict(self)
        default = dataclasses.asdict(Interface())
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in fields.items()
            if value != default[name]
        }

    def around(self, envs: SafetyEnvs) -> SafetyEnvs:
        """The environments as a learner meets them."""
        return envs if self == Interface() else cast(SafetyEnvs, DecisionEnvs(envs, self))

    def scaled(self, actions: NDArray[Any]) -> NDArray[Any]:
        """The environment's actions for a learner's, [..., A]; as they are without a scale."""
        if not self.action_scale:
            return actions
        return np.clip(actions, -1.0, 1.0) * np.array(self.action_scale, np.float32)

    def decisions(self, control_steps: int) -> int:
        """Decisions in an episode of so many control steps; the last may be a short one."""
        return -(-control_steps // self.action_repeat)


def interface_of(envs: Any) -> Interface:
    """That of environments as a learner meets them."""
    return getattr(envs, "interface", Interface())


def control_steps(infos: Mapping[str, Any], num_envs: int) -> int:
    """Control steps of all worlds in a step, or decision, with these infos."""
    return int(np.broadcast_to(info_of(infos, "control_steps"), num_envs).sum())


def held(envs: SafetyEnvs, action_repeat: int) -> SafetyEnvs:
    """Environments whose actions, their own, are held: what a trained policy is flown in."""
    return Interface(action_repeat).around(envs)


class DecisionEnvs:
    """A `SafetyEnvs` whose step is a decision: the action, scaled, held for several control steps.

    Of a decision's infos, `cost` and the optional ones are sums over its control steps, `d` and
    `d_dot` are those of the state it leads to, and `control_steps` [N] says how many it had: fewer
    than ``action_repeat`` where the episode ended within. Such a world waits until the decision
    of all worlds is over and only then begins its next episode, in a layout of its own (the one
    that the autoreset had drawn is passed over), so ``reset`` must know Gymnasium's
    ``reset_mask``.
    """

    def __init__(self, envs: SafetyEnvs, interface: Interface) -> None:
        self.envs, self.interface = envs, interface

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "envs":
            raise AttributeError(name)
        return getattr(self.envs, name)

    def step(self, actions: Any) -> tuple[Floats, Floats, Flags, Flags, dict[str, Any]]:
        """One decision of every world; the shapes are those of the environments' own step."""
        given = self.interface.scaled(np.asarray(actions))
        count = self.envs.num_envs
        running = np.ones(count, np.bool_)
        terminated, truncated = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
        waiting = np.zeros(count, np.bool_)
        rewards, steps = np.zeros(count), np.zeros(count, np.int64)
        sums = {name: np.zeros(count) for name in ("cost", *OPTIONAL_INFOS)}
        final: dict[str, NDArray[Any]] = {}
        for _ in range(self.interface.action_repeat):
            if not running.any():
                break
            waiting = ~running
            observations, reward, ends, cuts, infos = self.envs.step(given)
            rewards += np.where(running, reward, 0.0)
            steps += running
            for name, total in sums.items():
                if name != "control_steps":
                    total += np.where(running, info_of(infos, name), 0.0)
            ended = (ends | cuts) & running
            if ended.any():
                terminated |= ends & running
                truncated |= cuts & running
                _keep(final, "final_obs", infos["final_obs"], ended)
                for name in ("d", "d_dot"):
                    _keep(final, name, infos["final_info"][name], ended)
                running &= ~ended
        if waiting.any():
            observations, begun = self.envs.reset(options={"reset_mask": waiting})
            infos = {**infos, "d": begun["d"], "d_dot": begun["d_dot"]}
        result: dict[str, Any] = {**sums, "control_steps": steps}
        result |= {name: infos[name] for name in ("d", "d_dot")}
        if final:
            result["final_obs"] = final.pop("final_obs")
            result["final_info"] = final
        return observations, rewards, terminated, truncated, result


def _keep(
    final: dict[str, NDArray[Any]], name: str, values: NDArray[Any], ended: NDArray[np.bool_]
) -> None:
    """The rows of worlds that ended now, among those of worlds that ended before."""
    rows = final.setdefault(name, np.array(values))
    rows[ended] = values[ended]


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
