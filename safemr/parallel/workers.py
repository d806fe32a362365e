"""What runs beside the driver: samplers, buffers and learners, ordinary objects without Ray.

A sampler is an equal share of the run's environments, random start and schedules. Each has a ring
of its own in one buffer, so that n-step returns never mix two of them. Arrays that come from
another process are read-only.
"""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from safemr.learning.acting import Acting
from safemr.learning.contract import MakeEnvs, TrainingDivergedError, generator
from safemr.learning.off_policy import MEASURE_EVERY
from safemr.learning.replay import Batch, Replay
from safemr.learning.soft_actor_critic import SoftActorCritic
from safemr.parallel.gradients import Arrays, Learning, take_over

Chunk = dict[str, NDArray[np.float32]]  # field of a replay memory -> [decisions, N, ...]
SAMPLER, BUFFER, LEARNER, DRIVER = range(4)  # kinds, which draw from streams of their own


class Sizes(NamedTuple):
    """What networks and memory need to know of the task."""

    observation_dim: int
    action_dim: int
    num_obstacles: int
    d_min: float
    updates: int  # gradient steps of the run

    def agent(self, agent_type: Any, config: Any, seed: int) -> SoftActorCritic:
        """A fresh agent of the task."""
        dims = self.observation_dim, self.action_dim
        return agent_type(config, *dims, self.d_min, seed, self.updates)


class Experience(NamedTuple):
    """What a sampler did in one go."""

    chunk: Chunk
    steps: int  # control steps
    decisions: int
    episodes: NDArray[np.float64]  # rows of the finished ones, as `EpisodeStatistics.finished`
    cpu_s: float  # of the process so far
    diverged: tuple[str, float] | None = None  # a quantity that is not finite, and its value


def share_of(config: Any, samplers: int) -> Any:
    """The hyperparameters of one of ``samplers``, of a run with these."""
    return dataclasses.replace(
        config,
        **dict.fromkeys(("samplers", "buffers", "learners"), 1),
        num_envs=config.num_envs // samplers,
        start_steps=-(-config.start_steps // samplers),
        replay_capacity=max(config.replay_capacity // samplers, config.batch_size),
    )


class Worker:
    """What is asked of every kind."""

    def present(self) -> int:
        """The number of its process, which a dead one cannot say."""
        return os.getpid()


class Sampler(Worker):
    """Acts with a policy that is sent to it. ``step``: where its share of the run has got to."""

    def __init__(
        self,
        agent_type: Any,
        config: Any,
        make_envs: MakeEnvs,
        sizes: Sizes,
        total_steps: int,
        seed: int,
        step: int = 0,
    ) -> None:
        torch.set_num_threads(1)
        own = share_of(config, config.samplers)
        self._acting = Acting(own, make_envs, seed, -(-total_steps // config.samplers))
        self._acting.step = step
        self._agent = sizes.agent(agent_type, own, seed)

    def collect(self, policy: Arrays, decisions: int) -> Experience:
        """``decisions`` of each of its sub-environments."""
        take_over(self._agent, policy)
        acting, before, made = self._acting, self._acting.step, []
        try:
            for _ in range(decisions):
                # What the next decision overwrites is copied.
                fields = acting.interact(self._agent.act)
                made.append({name: value.numpy().copy() for name, value in fields.items()})
        except TrainingDivergedError as error:
            nothing = acting.episodes.finished[:0]
            said = error.quantity, error.value
            return Experience({}, 0, 0, nothing, time.process_time(), said)
        chunk = {name: np.stack([each[name] for each in made]) for name in made[0]}
        episodes = acting.episodes.finished
        acting.episodes.pop()
        steps, count = acting.step - before, decisions * acting.config.num_envs
        return Experience(chunk, steps, count, episodes, time.process_time())

    def state(self) -> dict[str, Any]:
        return self._acting.acting_state()

    def load(self, state: Mapping[str, Any]) -> bool:
        """Whether its episodes go on; where not, its ring has to be cut."""
        return self._acting.load_acting_state(state)


class Buffer(Worker):
    """Rings of some of the samplers, by the sampler's number."""

    def __init__(self, config: Any, samplers: tuple[int, ...], sizes: Sizes, seed: int) -> None:
        torch.set_num_threads(1)
        own = share_of(config, config.samplers)
        self._rings = {
            sampler: Replay(
                max(own.replay_capacity // own.num_envs, own.n_step),
                own.num_envs,
                sizes.observation_dim,
                sizes.action_dim,
                sizes.num_obstacles,
                gamma=own.gamma,
                n_step=own.n_step,
            )
            for sampler in samplers
        }
        self._batch_size = config.batch_size
        self._random, self._sampling = np.random.default_rng(seed), generator(seed, 2)

    def store(self, sampler: int, experience: Experience) -> tuple[Experience, float]:
        """Takes in what a sampler did; gives it back without the transitions, and its CPU time."""
        fields = {name: np.array(values) for name, values in experience.chunk.items()}
        for step in range(len(fields.get("rewards", ()))):
            tensors = {name: torch.from_numpy(values[step]) for name, values in fields.items()}
            self._rings[sampler].add(**tensors)
        return experience._replace(chunk={}), time.process_time()

    def draw(self) -> tuple[NDArray[np.float32], ...]:
        """The fields of a `Batch`, uniformly from everything held."""
        rings = [ring for ring in self._rings.values() if ring.size]
        held = np.array([ring.size for ring in rings], float)
        counts = self._random.multinomial(self._batch_size, held / held.sum())
        parts = [
            ring.sample(int(count), self._sampling)
            for ring, count in zip(rings, counts, strict=True)
            if count
        ]
        return tuple(torch.cat(fields).numpy() for fields in zip(*parts, strict=True))

    def cut(self, sampler: int) -> None:
        """What its sampler did last is not continued."""
        if self._rings[sampler].size:
            self._rings[sampler].cut()

    def state(self, sampler: int) -> dict[str, Any]:
        """That of one ring; of all at once there may be no room between processes."""
        state = self._rings[sampler].state_dict()
        fields = {name: values.numpy() for name, values in state["fields"].items()}
        return {**state, "fields": fields}

    def load(self, sampler: int, state: Mapping[str, Any]) -> None:
        fields = {name: np.array(values) for name, values in state["fields"].items()}
        self._rings[sampler].load_state_dict({**state, "fields": fields})


class Gradients(NamedTuple):
    """What a learner answers."""

    arrays: Arrays
    info: dict[str, float]
    cpu_s: float  # of the process so far


class Learner(Worker):
    """Forms gradients of weights and transitions that are sent to it."""

    def __init__(self, agent_type: Any, config: Any, sizes: Sizes, seed: int) -> None:
        torch.set_num_threads(1)
        self._agent = sizes.agent(agent_type, config, seed)
        self._learning = Learning(self._agent)

    def gradients(self, weights: Arrays, drawn: tuple[Any, ...], number: int) -> Gradients:
        """Those of the ``number``-th gradient step."""
        take_over(self._agent, weights)
        batch = Batch(*(torch.from_numpy(np.array(field)) for field in drawn))
        measure = number % MEASURE_EVERY == 0
        found, info = self._learning.gradients(batch, number, measure)
        return Gradients(found, info, time.process_time())
