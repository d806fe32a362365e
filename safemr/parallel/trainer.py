"""PABAL: the off-policy loop spread over samplers, buffers and learners (Duan et al. 2021).

The driver, which is this trainer, holds the weights, and steps on gradients that learners form of
what buffers draw; samplers act by its policy. What is large goes from process to process without
it: transitions from a sampler to its buffer, batches from a buffer to a learner.

- The ratio of gradient steps to experience is that of one process (`ledger.Earnings`): experience
  is ahead of learning by less than two times `chunk` of every environment, and never behind.
- No gradient is older than `max_gradient_age` steps (`ledger.Flights`).
- A sampler or learner that dies is replaced, and what it was asked for is asked for again: a
  sampler's successor begins new episodes, and its predecessor's last ones are cut. A buffer is the
  run's memory: without one the run ends, and continues from its checkpoint.
- At the end of `advance` everything asked for has come and everything earned is learned, so that a
  checkpoint finds nothing under way.

Which gradient comes first is a matter of chance, hence no run can be repeated bit for bit.

Differences from the authors' code (Feasible-Actor-Critic, their off-policy asynchronous optimiser):
it bounds neither the ratio nor the age, and there a buffer gets chunks of all samplers, here those
of its own, which n-step returns ask for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch

from safemr.errors import UserError
from safemr.learning.contract import MakeEnvs, TrainingDivergedError, check_finite, process_seed
from safemr.learning.episode_statistics import EpisodeStatistics
from safemr.learning.hyperparameters import Hyperparameters
from safemr.learning.interface import interface_of
from safemr.learning.observation import ObservationTransform
from safemr.learning.policies import Policy
from safemr.parallel import workers
from safemr.parallel.crew import Crew, LostError, RayCrew
from safemr.parallel.gradients import step, weights
from safemr.parallel.ledger import Earnings, Flights, Numbers
from safemr.parallel.workers import BUFFER, DRIVER, LEARNER, SAMPLER

MOST_LOST = 10  # tasks in a row, after which whatever is wrong will not go away


@dataclass(frozen=True)
class Parallel(Hyperparameters):
    """What the parallel trainer asks beside the hyperparameters of one process."""

    samplers: int = 4  # processes that act, each with its share of num_envs
    buffers: int = 4  # processes that hold transitions
    learners: int = 4  # processes that form gradients
    chunk: int = 8  # decisions that an environment makes in one go
    max_gradient_age: int = 8  # most gradient steps between a gradient's weights and its own step

    RANGES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("samplers", "buffers", "learners"), "[1, 256]"),
        "chunk": "[1, 1000]",
        "max_gradient_age": "[0, 1000]",
    }
    UNUSED: ClassVar[Mapping[str, str]] = {
        "updates_together": "every gradient has a draw of its own",
        "device": "learners are processes on CPUs",
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        environments = vars(self)["num_envs"]  # of the hyperparameters that this is mixed into
        self.require(
            "samplers",
            environments % self.samplers == 0,
            f"must divide num_envs = {environments}, of which each has an equal share",
        )
        self.require(
            "buffers",
            self.buffers <= self.samplers,
            f"must not exceed samplers = {self.samplers}, each of which fills one",
        )


class Task(NamedTuple):
    """What a worker was asked for."""

    kind: int  # SAMPLER or LEARNER
    worker: int  # its index among those of the kind
    number: int = 0  # of the gradient
    version: int = 0  # of the policy that acts
    decisions: int = 0
    most_steps: int = 0  # control steps that these take at most
    acted: bool = False  # whether they are made, and on their way to the buffer


class Means:
    """Means and largest values of what is logged of an interval."""

    def __init__(self) -> None:
        self._values: dict[str, list[float]] = {}

    def note(self, name: str, value: float) -> None:
        self._values.setdefault(name, []).append(value)

    def metrics(self, largest: tuple[str, ...]) -> dict[str, float]:
        """Means; for names in ``largest`` also ``NAME_max``."""
        means = {name: float(np.mean(values)) for name, values in self._values.items()}
        tops = {f"{n}_max": float(max(self._values[n])) for n in largest if n in self._values}
        return means | tops


class Trainer:
    """`safemr.learning.contract.Trainer`; ``agent_type`` is a soft actor-critic's agent.

    crew: makes the crew of some number of workers; of Ray by default. Workers are hired when
    training begins.
    """

    family: ClassVar[str] = "off_policy"
    agent_type: ClassVar[Any]

    def __init__(
        self,
        config: Any,
        make_envs: MakeEnvs,
        seed: int,
        total_steps: int,
        crew: Callable[[int], Crew] = RayCrew,
    ) -> None:
        self.config = config
        self._make_envs, self._seed, self._total_steps = make_envs, seed, total_steps
        envs = make_envs(1)
        self.interface = interface_of(envs)
        self.transform = ObservationTransform.for_envs(envs, self.interface.decode)
        if len(self.transform.unscaled):
            raise UserError(
                "the parallel trainer keeps no running statistics, and observations without bounds "
                "need them: give the environment bounds, or train by the algorithm of one process"
            )
        steps_an_update = config.update_every * self.interface.action_repeat
        self._sizes = workers.Sizes(
            self.transform.dim,
            int(np.prod(envs.single_action_space.shape)),
            envs.num_obstacles,
            envs.d_min,
            max(total_steps - config.start_steps, 0) // steps_an_update,
        )
        envs.close()
        torch.set_num_threads(1)
        self.agent = self._sizes.agent(self.agent_type, config, seed)
        round_of = config.num_envs * config.chunk / config.update_every
        self._earnings = Earnings(config.start_steps, config.update_every, round_of)
        self._flights, self._numbers = Flights(config.max_gradient_age), Numbers()
        self._stored = [0] * config.samplers  # control steps of each
        self._lives = [[0] * n for n in (config.samplers, config.buffers, config.learners)]
        self._cpu = {"earlier": 0.0}  # seconds of the workers
        self._episodes: list[Any] = []
        self._make_crew = crew
        self._crew: Crew | None = None
        self._closed = False
        self._workers: list[list[Any]] = []
        self._of_crew: dict[str, Any] = {}  # what its `notes` said
        self._resumed: Mapping[str, Any] | None = None

    @property
    def step(self) -> int:
        return self._earnings.steps

    # Workers

    def _staff(self) -> Crew:
        """The crew, hired at first use, with what a checkpoint says of it."""
        if self._crew is not None:
            return self._crew
        if self._closed:
            raise ValueError("this trainer was closed, and what its buffers held is gone")
        config, resumed = self.config, self._resumed
        crew = self._crew = self._make_crew(config.samplers + config.buffers + config.learners)
        self._of_crew = crew.notes()
        self._workers = [
            [self._hired(kind, index) for index in range(len(lives))]
            for kind, lives in enumerate(self._lives)
        ]
        self._waiting: dict[Any, Task] = {}
        self._landing: dict[int, workers.Gradients] = {}
        self._sent: tuple[int, Any] | None = None  # version of the weights sent last, and these
        self._lost_in_a_row, self._means, self._lost = 0, Means(), 0
        life = max(self._lives[SAMPLER])  # at least the number of resumptions
        self._random = np.random.default_rng(process_seed(self._seed, DRIVER, 0, life))
        if resumed is None:
            return crew
        try:
            for index, (acting, ring) in enumerate(
                zip(resumed["samplers"], resumed["rings"], strict=True)
            ):
                crew.get(crew.ask(self._buffer(index), "load", index, ring))
                sampler = self._workers[SAMPLER][index]
                if acting is None or not crew.get(crew.ask(sampler, "load", acting)):
                    crew.get(crew.ask(self._buffer(index), "cut", index))
        except LostError as error:
            raise UserError(f"the parallel trainer's processes do not start: {error}") from error
        self._resumed = None
        return crew

    def _hired(self, kind: int, index: int) -> Any:
        config, crew = self.config, self._crew
        assert crew is not None
        seed = process_seed(self._seed, kind, index, self._lives[kind][index])
        if kind == SAMPLER:
            return crew.hire(
                workers.Sampler,
                self.agent_type,
                config,
                self._make_envs,
                self._sizes,
                self._total_steps,
                seed,
                self._stored[index],
            )
        if kind == BUFFER:
            samplers = tuple(range(index, config.samplers, config.buffers))
            return crew.hire(workers.Buffer, config, samplers, self._sizes, seed)
        return crew.hire(workers.Learner, self.agent_type, config, self._sizes, seed)

    def _buffer(self, sampler: int) -> Any:
        """The one that a sampler fills."""
        return self._workers[BUFFER][sampler % self.config.buffers]

    def close(self) -> None:
        """Ends the workers, and with them the training."""
        self._closed = True
        if self._crew is None:
            return
        try:
            for each in (worker for kind in self._workers for worker in kind):
                self._crew.dismiss(each)
        finally:
            self._crew.close()
            self._crew = None

    # Training

    def advance(self, until: int) -> dict[str, float]:
        """Trains until at least ``until`` steps; returns the means over the interval.

        Raises TrainingDivergedError, and UserError where a buffer is gone.
        """
        crew = self._staff()
        self._means, self._lost = Means(), 0
        while True:
            self._ask(crew, until)
            if not self._waiting and not self._landing:
                break
            if self._waiting:
                self._receive(crew, crew.first(list(self._waiting)))
            self._land()
        metrics = self._means.metrics(("gradient_age", "policy_age"))
        metrics |= self.agent.metrics()
        metrics |= {"lost_tasks": float(self._lost), "workers_cpu_s": sum(self._cpu.values())}
        check_finite(self.step, metrics)
        return metrics | {f"train_{name}": v for name, v in self._finished().items()}

    def _ask(self, crew: Crew, until: int) -> None:
        """Give work to every worker that has none, as far as there is any."""
        config, flights, earned = self.config, self._flights, self._earnings.earned
        busy = {(task.kind, task.worker) for task in self._waiting.values()}
        for index in sorted(range(config.samplers), key=self._stored.__getitem__):
            out = [task for task in self._waiting.values() if task.kind == SAMPLER]
            planned = self.step + sum(task.most_steps for task in out)
            under_way = sum(task.decisions for task in out)
            if planned >= until or not self._earnings.may_sample(under_way, flights.version):
                break
            if (SAMPLER, index) not in busy:
                self._ask_sampler(crew, index, until - planned)
        for index in range(config.learners):
            if not self._numbers.due(earned) or not flights.may_depart:
                break
            if (LEARNER, index) not in busy:
                self._ask_learner(crew, index)

    def _ask_sampler(self, crew: Crew, index: int, room: int) -> None:
        config = self.config
        environments = config.num_envs // config.samplers
        stride = environments * self.interface.action_repeat
        each = min(config.chunk, -(-room // stride))
        policy = weights(self.agent, "policy")
        promise = crew.ask(self._workers[SAMPLER][index], "collect", policy, each)
        version = self._flights.version
        task = Task(SAMPLER, index, 0, version, each * environments, each * stride)
        self._waiting[promise] = task

    def _ask_learner(self, crew: Crew, index: int) -> None:
        version = self._flights.version
        if self._sent is None or self._sent[0] != version:
            self._sent = version, crew.put(weights(self.agent))
        held = np.zeros(self.config.buffers)
        for sampler, steps in enumerate(self._stored):
            held[sampler % len(held)] += steps
        buffer = self._random.choice(len(held), p=held / held.sum())
        drawn = crew.ask(self._workers[BUFFER][buffer], "draw")
        number = self._numbers.take()
        self._flights.depart(number)
        learner = self._workers[LEARNER][index]
        promise = crew.ask(learner, "gradients", self._sent[1], drawn, number)
        self._waiting[promise] = Task(LEARNER, index, number)

    def _receive(self, crew: Crew, promise: Any) -> None:
        task = self._waiting.pop(promise)
        if task.kind == SAMPLER and not task.acted:
            # Only now: a buffer does what it is asked in turn, and would let draws wait for it.
            stored = crew.ask(self._buffer(task.worker), "store", task.worker, promise)
            self._waiting[stored] = task._replace(acted=True)
            return
        try:
            answer = crew.get(promise)
        except LostError as error:
            self._replace(crew, task, str(error))
            return
        self._lost_in_a_row = 0
        life = self._lives[task.kind][task.worker]
        if task.kind == LEARNER:
            self._landing[task.number] = answer
            self._cpu[f"{task.kind} {task.worker} {life}"] = answer.cpu_s
            return
        experience, buffer_cpu_s = answer
        if experience.diverged is not None:
            raise TrainingDivergedError(self.step, *experience.diverged)
        self._cpu[f"{task.kind} {task.worker} {life}"] = experience.cpu_s
        self._cpu[f"{BUFFER} {task.worker % self.config.buffers}"] = buffer_cpu_s
        self._stored[task.worker] += experience.steps
        self._earnings.store(experience.steps, experience.decisions)
        self._episodes.append(experience.episodes)
        self._means.note("policy_age", self._flights.version - task.version)

    def _land(self) -> None:
        """Step on every gradient that has come, as far as none under way gets too old by it."""
        while ready := [n for n in sorted(self._landing) if self._flights.may_land(n)]:
            answer = self._landing.pop(ready[0])
            for name, gradient in answer.arrays.items():
                check_finite(self.step, {f"{name}_gradient": float(np.abs(gradient).max())})
            check_finite(self.step, answer.info)
            step(self.agent, answer.arrays)
            for name, value in answer.info.items():
                self._means.note(name, value)
            self._means.note("gradient_age", self._flights.land(ready[0]))

    def _replace(self, crew: Crew, task: Task, reason: str) -> None:
        """A task is lost: go on without its worker if that is gone, and ask again."""
        self._lost += 1
        self._lost_in_a_row += 1
        if self._lost_in_a_row > MOST_LOST:
            raise UserError(
                f"{self._lost_in_a_row} tasks of the parallel trainer were lost one after the "
                f"other, the last one because: {reason}"
            )
        for index, buffer in enumerate(self._workers[BUFFER]):
            if not crew.lives(buffer):
                raise UserError(
                    f"buffer {index} of {self.config.buffers} is gone at step {self.step}, and "
                    f"with it what it held ({reason}); the same command continues from the last "
                    "checkpoint"
                )
        kind, index = task.kind, task.worker
        if kind == LEARNER:
            self._flights.lose(task.number)
            self._numbers.give_back(task.number)
        else:
            crew.ask(self._buffer(index), "cut", index)
        if not crew.lives(self._workers[kind][index]):
            self._lives[kind][index] += 1
            self._workers[kind][index] = self._hired(kind, index)

    def _finished(self) -> dict[str, float]:
        """Means over the episodes that samplers finished in the interval."""
        statistics = EpisodeStatistics(1)
        rows = np.concatenate(self._episodes) if self._episodes else statistics.finished
        self._episodes = []
        statistics.load_state_dict({**statistics.state_dict(), "finished": rows})
        return statistics.pop()

    # What the contract asks

    @property
    def policy(self) -> Policy:
        """The current policy with what figures need of the run: lambda's network and zeta."""
        return Policy(
            self.transform,
            self.agent.policy,
            squash=True,
            extras=self.agent.extras(),
            interface=self.interface,
        )

    @property
    def notes(self) -> dict[str, Any]:
        """What a record's provenance says of the run beside the rest."""
        return {"deterministic": False, **self._of_crew}

    def state_dict(self) -> dict[str, Any]:
        """As at the end of `advance`, where nothing is under way. Raises UserError where a buffer
        is gone; a sampler that is gone begins anew."""
        crew = self._staff()
        assert not self._waiting
        try:
            rings = [_copied(crew.get(crew.ask(self._buffer(index), "state", index)))
                     for index in range(self.config.samplers)]  # fmt: skip
        except LostError as error:
            raise UserError(
                f"a buffer is gone at step {self.step}, and with it what it held ({error}); the "
                "same command continues from the last checkpoint"
            ) from error
        samplers: list[Any] = []
        for sampler in self._workers[SAMPLER]:
            try:
                samplers.append(_copied(crew.get(crew.ask(sampler, "state"))))
            except LostError:
                samplers.append(None)
        return {
            "agent": self.agent.state_dict(),
            "earnings": self._earnings.state_dict(),
            "stored": list(self._stored),
            "lives": [list(lives) for lives in self._lives],
            "cpu_s": sum(self._cpu.values()),
            "samplers": samplers,
            "rings": rings,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """The workers take it over when they are hired, in lives of their own: what they draw does
        not repeat what their predecessors drew."""
        self.agent.load_state_dict(state["agent"])
        self._earnings.load_state_dict(state["earnings"])
        self._flights.version = self.agent.updates
        self._numbers.start_after(self.agent.updates)
        self._stored = [int(steps) for steps in state["stored"]]
        self._lives = [[int(life) + 1 for life in lives] for lives in state["lives"]]
        self._cpu = {"earlier": float(state["cpu_s"])}
        self._resumed = state


def _copied(value: Any) -> Any:
    """Nested containers with arrays that lie in memory between processes, as our own."""
    if isinstance(value, np.ndarray):
        return np.array(value)
    if isinstance(value, Mapping):
        return {key: _copied(item) for key, item in value.items()}
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(_copied, value))
    if isinstance(value, (list, tuple)):
        return type(value)(map(_copied, value))
    return value
