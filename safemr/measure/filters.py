"""Final policies behind safety filters: on unseen layouts, and one episode for a drawing.

The certificate may be another run's than the policy's, or handcrafted: a filter asks only for phi.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from gymnasium.spaces import Box
from numpy.typing import NDArray

from safemr.certificates.certificate import Certificate, EnergyCertificate
from safemr.environments import info_of
from safemr.errors import UserError
from safemr.experiment.filter_entries import HANDCRAFTED
from safemr.experiment.planning import installed
from safemr.experiment.record import Record
from safemr.files import Arrays
from safemr.filters.models import energy_of
from safemr.filters.wrapper import FilteredEnvs
from safemr.learning.episode_statistics import EpisodeStatistics
from safemr.learning.evaluation import Acts
from safemr.learning.interface import held
from safemr.measure.controllers import controllers_of
from safemr.measure.store import Measurements
from safemr.measure.tracks import GEOMETRY
from safemr.tasks import Task, make_envs, name_of

SCORES = ["task", "variant", "filter", "seed", "metric", "value"]
CHOICES = ("intervened", "distance", "margin", "feasible")  # of `Choice`, for a drawing
UNFILTERED = ""  # the name of no filter in a score table


class RandomActions:
    """Uniform actions, each held for `HELD` control steps: what learners do before they learn.

    space: of an environment's actions; seed: of the draws, one for each world and new action.
    """

    HELD = 10

    def __init__(self, space: Box, seed: int) -> None:
        self._space, self._draw, self._steps = space, np.random.default_rng(seed), 0

    def act(self, observations: Any, deterministic: bool = True) -> NDArray[np.float32]:
        """Actions [N, A] for observations [N, D], which are not looked at."""
        if self._steps % self.HELD == 0:
            low, high = self._space.low, self._space.high
            size = (len(observations), *low.shape)
            self._actions = self._draw.uniform(low, high, size).astype(np.float32)
        self._steps += 1
        return self._actions


def fly(
    make_policy: Callable[[Any], Acts],
    task: Task,
    certificate: Certificate | None,
    *,
    episodes: int,
    seed: int,
) -> dict[str, float]:
    """A policy behind the filter of a certificate, on ``episodes`` layouts from ``seed`` on.

    make_policy: from the batched environment, which scripted ones look into.

    The metrics of `EpisodeStatistics`, and of the filter, over all decisions: the shares
    ``intervened`` and ``infeasible`` (no action found that keeps the constraint), the mean
    ``distance`` of the actions taken in place of others [half ranges], and ``microseconds`` of
    processor time that it took for a control step of one world, on this machine.
    """
    envs = make_envs(task, episodes)
    policy = make_policy(envs)
    repeat = int(getattr(policy, "action_repeat", 1))
    filtered = (
        None if certificate is None else FilteredEnvs(envs, certificate, action_repeat=repeat)
    )
    flown: Any = filtered or held(envs, repeat)
    statistics, running = EpisodeStatistics(episodes), np.ones(episodes, bool)
    decisions = intervened = infeasible = 0
    distance = steps = 0.0
    try:
        observations, _ = flown.reset(seed=seed)
        while running.any():
            actions = policy.act(observations)
            observations, rewards, terminated, truncated, infos = flown.step(actions)
            statistics.update(rewards, terminated, truncated, infos, counted=running)
            decisions += int(running.sum())
            steps += float((np.ones(episodes) * infos.get("control_steps", 1)).sum())
            if filtered is not None:
                changed = infos["filter_intervened"] & running
                intervened += int(changed.sum())
                distance += float(infos["filter_distance"][changed].sum())
                infeasible += int((~infos["filter_feasible"] & running).sum())
            running &= ~(terminated | truncated)
    finally:
        envs.close()
    return {
        **statistics.pop(),
        "intervened": intervened / decisions,
        "infeasible": infeasible / decisions,
        "distance": distance / intervened if intervened else 0.0,
        "microseconds": 1e6 * filtered.seconds / steps if filtered is not None else 0.0,
    }


def measured(
    measurements: Measurements,
    record: Record,
    certificate: Certificate | None,
    *,
    episodes: int,
    seed: int,
) -> Mapping[str, float]:
    """`fly` of a record's policy, kept among ``measurements``."""
    flight = {"certificate": _inputs_of(certificate), "episodes": episodes, "seed": seed}
    return measurements.rows(
        "filters",
        f"{record.label} {_behind(certificate)}",
        {**record.inputs, **flight},
        lambda: fly(
            lambda _: record.policy(), record.task, certificate, episodes=episodes, seed=seed
        ),
    )


def measured_unlearned(
    measurements: Measurements,
    kind: str,
    task: Task,
    certificate: Certificate | None,
    *,
    episodes: int,
    seed: int,
) -> dict[str, Mapping[str, float]]:
    """`fly` of each policy of a kind of `UNLEARNED` that fits the task, by name, kept."""
    made: dict[str, Callable[[Any], Acts]] = {
        kind: lambda envs: RandomActions(envs.single_action_space, seed)
    }
    if kind == "scripted":
        with closing(make_envs(task, 1)) as one:
            made = dict(controllers_of(one))
    flight = {"certificate": _inputs_of(certificate), "episodes": episodes, "seed": seed}
    return {
        name: measurements.rows(
            "filters",
            f"{name_of(task)} {name} {_behind(certificate)}",
            {"policy": name, "task": installed(task), **flight},
            lambda make=make: fly(make, task, certificate, episodes=episodes, seed=seed),
        )
        for name, make in made.items()
    }


def _inputs_of(certificate: Certificate | None) -> dict[str, Any] | None:
    """What a flight behind this certificate depends on."""
    return certificate and {
        "family": certificate.family, "parameters": dict(certificate.parameters),
        "eta": certificate.eta, "length_scale": certificate.length_scale,
        "record": certificate.record and certificate.record.inputs,
    }  # fmt: skip


def _behind(certificate: Certificate | None) -> str:
    return "unfiltered" if certificate is None else f"behind {certificate.name}"


def measured_scores(
    measurements: Measurements,
    policies: Sequence[Path],
    certificates: Mapping[str, Sequence[Path]],
    *,
    episodes: int,
    seed: int,
    unlearned: Sequence[str] = (),
    task: Task = "",
    seeds: Sequence[int] = (),
) -> pd.DataFrame:
    """Score table of the records ``policies``, each without a filter and behind each certificate.

    Then of ``unlearned`` policies (`UNLEARNED`) in ``task``, behind the certificates of ``seeds``;
    where no run's certificate is in it a flight is the same for all seeds, and a row of the first.

    certificates: name -> records of the runs that learned it, of which the one with the policy's
    seed is taken; none for a handcrafted one (`HANDCRAFTED`). A record without a policy gives no
    row, a certificate without a run of that seed neither.
    """
    learned = {
        (name, record.seed): record
        for name, folders in certificates.items()
        for record in map(Record.open, folders)
    }

    def behind(seed: int) -> Iterator[tuple[str, Certificate | None]]:
        yield UNFILTERED, None
        for name in certificates:
            if name in HANDCRAFTED:
                yield name, handcrafted(name)
            elif (name, seed) in learned:
                yield name, learned[name, seed].certificate()
            else:
                print(f"no run of {name} with seed {seed}")

    rows: list[tuple[Any, ...]] = []
    for folder in policies:
        record = Record.open(folder)
        if not record.has_policy:
            print(f"no policy in {folder}")
            continue
        for name, certificate in behind(record.seed):
            found = measured(measurements, record, certificate, episodes=episodes, seed=seed)
            key = (name_of(record.task), record.variant, name, record.seed)
            rows += [(*key, metric, value) for metric, value in found.items()]
    for kind in unlearned:
        for run in seeds:
            for name, certificate in behind(run):
                if run != seeds[0] and (name == UNFILTERED or name in HANDCRAFTED):
                    continue
                flown = measured_unlearned(
                    measurements, kind, task, certificate, episodes=episodes, seed=seed
                )
                rows += [
                    (name_of(task), policy, name, run, metric, value)
                    for policy, found in flown.items()
                    for metric, value in found.items()
                ]
    return pd.DataFrame(rows, columns=SCORES)


def handcrafted(name: str) -> EnergyCertificate:
    """phi_0 or phi_h. Raises UserError for another name."""
    if name not in HANDCRAFTED:
        raise UserError(f"{name} is no handcrafted certificate: use {' or '.join(HANDCRAFTED)}")
    return EnergyCertificate(name, HANDCRAFTED[name])


def episode(
    policy: Acts, task: Task, certificate: Certificate, *, seed: int, steps: int, act: bool
) -> Arrays:
    """One episode for a drawing: the layout of ``seed``, ``steps`` control steps at most.

    With ``act`` the filter's actions are flown, otherwise the policy's, and the filter only says
    what it would do. All of T steps: phi of the state in which it is taken, and d, d_dot of the
    obstacle that phi is of; reward, goal_met and violating; the filter's `CHOICES`, repeated while
    an action is held; d_min; in a task with a scene robot [T, 1, 3], goal, box, vase and obstacles
    [1, M, 2] as in `trajectories.episodes`, with the geometry.
    """
    envs: Any = make_envs(task, 1)
    repeat = int(getattr(policy, "action_repeat", 1))
    chooser = FilteredEnvs(envs, certificate, action_repeat=repeat).filter
    d_min = float(envs.d_min)
    drawn = hasattr(envs, "scene")
    tracks: dict[str, list[Any]] = {}

    def note(**values: Any) -> None:
        for name, value in values.items():
            tracks.setdefault(name, []).append(value)

    def state(infos: Mapping[str, Any], seen: NDArray[Any]) -> None:
        d, d_dot = infos["d"], infos["d_dot"]
        each = [
            float(energy_of(certificate, d[:, [j]], d_dot[:, [j]], d_min, seen)[0])
            for j in range(d.shape[1])
        ]
        worst = int(np.argmax(each))
        note(phi=each[worst], d=d[0, worst], d_dot=d_dot[0, worst])
        if drawn:
            scene = envs.scene(0)
            note(robot=[scene.robot], goal=[scene.goal])
            note(box=[np.full(3, np.nan) if scene.box is None else scene.box])
            note(**({} if scene.vase is None else {"vase": [scene.vase]}))

    observations, infos = envs.reset(seed=seed)
    obstacles = envs.scene(0).obstacles if drawn else None
    for step in range(min(steps, envs.max_episode_steps)):
        state(infos, observations)
        if step % repeat == 0:
            wanted = policy.act(observations)
            choice = chooser.choose(wanted, observations, infos["d"], infos["d_dot"])
            actions = choice.actions if act else wanted
        observations, reward, terminated, truncated, infos = envs.step(actions)
        note(
            reward=reward[0], goal_met=np.ravel(info_of(infos, "goal_met"))[0],
            violating=info_of(infos, "cost_indicator")[0] > 0,
            **{name: getattr(choice, name)[0] for name in CHOICES},
        )  # fmt: skip
        if terminated[0] or truncated[0]:
            break
    geometry = {name: np.array(getattr(envs.task, name)) for name in GEOMETRY} if drawn else {}
    envs.close()
    data = {name: np.array(values) for name, values in tracks.items()}
    data |= {"obstacles": obstacles[None], **geometry} if obstacles is not None else {}
    return {**data, "d_min": np.array(d_min)}
