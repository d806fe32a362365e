"""The safety filter around an environment of Gymnasium, scalar or one of our batches."""

from __future__ import annotations

import time
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from safemr.environments import OPTIONAL_INFOS, SafetyEnvs
from safemr.errors import UserError, show
from safemr.filters.choice import Choice
from safemr.filters.filter import AnyCertificate, Filter, checked_distances, unbound
from safemr.filters.models import grid_of, model_for, span_of
from safemr.learning.interface import held

# What an action's infos say of the filter beside the environment's.
FILTER_INFOS = {
    "filter_intervened": "whether another action was taken than the wanted one",
    "filter_distance": "how far it is from that, in half ranges of the components",
    "filter_margin": "g of the action taken, by the model: kept where < 0",
    "filter_feasible": "whether an action was found that keeps the constraint",
}
SUMMED = ("cost", *(name for name in OPTIONAL_INFOS if name != "control_steps"))


class SafetyFilter(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Replaces an action by the nearest one that keeps a certificate's constraint.

    Without any it takes the one that violates it least. Actions that keep it pass as they are. The
    environment reports ``d`` and ``d_dot`` [M] in its infos, at `reset`, too; a step's infos have
    `FILTER_INFOS` beside.

    certificate: that of `safemr.load(folder)`, or any other. model: ``"point_robot"``,
    ``"simulator"``, ``"critic"`` or ``function(observations, actions) -> d, d_dot``
    (`safemr.filters.models`); None: the exact one, where there is one. state: for a function, what
    it is given in place of the observation, called with the environment. d_min [m]: where the
    environment has none, and the certificate is bound to another. action_repeat: control steps
    of a decision, by default those of the certificate's record; a step then is a decision, whose
    reward and costs are sums. margin: an action must have g < -margin.

    Raises:
        UserError: something is missing or does not fit; it names it and the remedy.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        certificate: AnyCertificate,
        model: Any = None,
        *,
        state: Any = None,
        d_min: float | None = None,
        action_repeat: int | None = None,
        margin: float = 0.0,
    ) -> None:
        if not isinstance(env, gymnasium.Env):
            raise UserError(
                f"{show(type(env).__name__)} is no scalar environment of Gymnasium; a batch is "
                "filtered by safemr.filters.wrapper.FilteredEnvs"
            )
        # What `env.spec` makes it anew from; a certificate is shared, not copied.
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, _disable_deepcopy=True, certificate=certificate, model=model, state=state,
            d_min=d_min, action_repeat=action_repeat, margin=margin,
        )  # fmt: skip
        gymnasium.Wrapper.__init__(self, env)
        self._action_repeat = _repeat(action_repeat, certificate)
        self._state = state
        asked = None if state is None else self._present
        self.filter = _filter(
            env.unwrapped, env, certificate, model, asked, d_min, self._action_repeat, margin
        )
        self._seen: tuple[Any, Any, Any] | None = None

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._look(observation, info, "reset")
        return observation, info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One decision. Raises gymnasium's ResetNeeded before the first reset."""
        if self._seen is None:
            raise gymnasium.error.ResetNeeded(
                "call reset() before the first step, and after an end"
            )
        observation, d, d_dot = self._seen
        wanted = np.asarray(action)
        choice = self.filter.choose(wanted[None], np.asarray(observation)[None], d, d_dot)
        given = choice.actions[0] if choice.intervened[0] else action
        total, sums = 0.0, dict.fromkeys(SUMMED, 0.0)
        taken = 0
        while taken < self._action_repeat:
            taken += 1
            observation, reward, terminated, truncated, info = self.env.step(given)
            total += float(reward)
            for name in SUMMED:
                sums[name] += float(info.get(name, 0.0))
            if terminated or truncated:
                break
        if self._action_repeat > 1:
            info = info | {name: sums[name] for name in SUMMED if name in info}
            info["control_steps"] = taken
        self._look(observation, info, "step")
        if terminated:
            self._seen = None
        said = {
            name: getattr(choice, name.removeprefix("filter_"))[0].item() for name in FILTER_INFOS
        }
        return observation, total, bool(terminated), bool(truncated), info | said

    def _present(self) -> NDArray[Any]:
        return np.asarray(self._state(self.env))[None]

    def _look(self, observation: Any, info: Any, where: str) -> None:
        lacking = [name for name in ("d", "d_dot") if name not in info]
        if lacking:
            raise UserError(
                f"{type(self.env.unwrapped).__name__}: the info of {where} lacks {lacking[0]!r}: "
                "one entry an obstacle, its distance [m] and rate [m/s], is asked there"
            )
        d, d_dot = (
            checked_distances(np.asarray(info[name])[None], name) for name in ("d", "d_dot")
        )
        self._seen = observation, d, d_dot


class FilteredEnvs:
    """A batch (`SafetyEnvs`) behind a filter: the wrapper for N environments stepped together.

    Its arguments are those of `SafetyFilter`, ``envs`` being as they were made: a step is a
    decision of ``action_repeat`` control steps (`safemr.learning.interface.DecisionEnvs`). Infos
    have `FILTER_INFOS` as arrays [N]. ``seconds`` of processor time the filter took so far.
    """

    def __init__(
        self,
        envs: SafetyEnvs,
        certificate: AnyCertificate,
        model: Any = None,
        *,
        d_min: float | None = None,
        action_repeat: int | None = None,
        margin: float = 0.0,
    ) -> None:
        repeat = _repeat(action_repeat, certificate)
        self.envs = held(envs, repeat)
        self.filter = _filter(envs, envs, certificate, model, None, d_min, repeat, margin)
        self.seconds = 0.0

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "envs":
            raise AttributeError(name)
        return getattr(self.envs, name)

    def reset(
        self, *, seed: Any = None, options: Any = None
    ) -> tuple[NDArray[Any], dict[str, Any]]:
        observations, infos = self.envs.reset(seed=seed, options=options)
        self._seen = observations, infos["d"], infos["d_dot"]
        return observations, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """One decision of every world."""
        begun = time.process_time()
        choice: Choice = self.filter.choose(actions, *self._seen)
        self.seconds += time.process_time() - begun
        observations, rewards, terminated, truncated, infos = self.envs.step(choice.actions)
        self._seen = observations, infos["d"], infos["d_dot"]
        said = {name: getattr(choice, name.removeprefix("filter_")) for name in FILTER_INFOS}
        return observations, rewards, terminated, truncated, {**infos, **said}


def _repeat(given: Any, certificate: Any) -> int:
    """Control steps of a decision."""
    if given is None:
        record = getattr(getattr(certificate, "certificate", certificate), "record", None)
        return int(record.interface.action_repeat) if record is not None else 1
    if isinstance(given, bool) or not isinstance(given, int) or given < 1:
        raise UserError(f"action_repeat = {show(given)}: it must be an integer of at least 1")
    return given


def _filter(
    env: Any, outside: Any, certificate: Any, model: Any, state: Any, d_min: float | None,
    action_repeat: int, margin: float,
) -> Filter:  # fmt: skip
    """The filter of an environment; ``outside`` is the same in its wrappers."""
    own = d_min if d_min is not None else getattr(env, "d_min", None)
    plain, least = unbound(certificate, own)
    if least is None:
        raise UserError(
            f"{type(env).__name__} does not say d_min, the distance to be kept: give d_min="
        )
    span = span_of(env)
    looked = model_for(model, env, plain, action_repeat, state)
    return Filter(plain, least, looked, span, grid_of(env, span), margin)
