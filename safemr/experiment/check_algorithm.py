"""Check that an algorithm, here or of another package, keeps to the contract of a trainer.

    safemr check-algorithm my_package.my_algorithm --set hidden=32

Each line is one promise of `safemr.learning.contract` that records, resuming and evaluation rest
on. It is tried in short trainings on a task; nothing is recorded. Exit status 1 where one is
broken. A package's own tests call `check`.
"""

from __future__ import annotations

import argparse
import dataclasses
import io
import tempfile
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from safemr import paper
from safemr.environments import exact_resume
from safemr.errors import UserError, show
from safemr.experiment import planning, records
from safemr.experiment.catalogue import Algorithm, hyperparameters, load_algorithm
from safemr.experiment.strict_yaml import assignment
from safemr.learning.hyperparameters import Hyperparameters, declared, meanings, within
from safemr.learning.interface import Interface
from safemr.tasks import Task, make_envs

# What makes a training short, where an algorithm has it and nothing else is asked for.
SMALL: Mapping[str, Mapping[str, Any]] = {
    "off_policy": {"num_envs": 4, "hidden": 16, "batch_size": 32, "start_steps": 200},
    "on_policy": {"num_envs": 4, "hidden": 16, "epoch_steps": 600, "value_batch": 200},
}
STEPS = 2_400
HELD = 3  # control steps of an action, where actions are held


@dataclass(frozen=True)
class Checked:
    """One promise: whether it is kept and, where it is not, what is wrong and what to do."""

    promise: str
    fault: str = ""


class BrokenError(Exception):
    """A promise is broken; the text says what was seen, and the remedy."""


def check(
    name: str,
    task: Task = paper.AIRCRAFT_TASK,
    settings: Mapping[str, Any] | None = None,
    steps: int = STEPS,
) -> Iterator[Checked]:
    """Every promise of the contract, tried one after the other until one is broken.

    name: as in a configuration. task: a name, an id from outside, or an entry of a run's config.
    settings: hyperparameters. steps: control steps of a training. On a task without snapshots a
    resumed run begins new episodes, so that only what it resumes from is compared.
    Raises UserError where there is no such algorithm or task, or a setting does not fit.
    """
    algorithm = load_algorithm(name)
    fields = {field.name for field in dataclasses.fields(algorithm.hyperparameters)}
    short = {k: v for k, v in SMALL[algorithm.family].items() if k in fields}
    values = hyperparameters(algorithm, {**short, **(settings or {})}, name)
    entry = _entry(task)
    planning.check_setting(algorithm, values, entry, steps, name, HELD)
    trial = _Trial(algorithm, values, entry, steps)
    for promise, attempt in trial.promises().items():
        try:
            attempt()
        except BrokenError as error:
            yield Checked(promise, str(error))
            return
        except Exception as error:  # whatever it is, its author wants to know in which part
            reason = str(error).partition("\n")[0]
            yield Checked(promise, f"{type(error).__name__}: {reason}; {_place(error)}")
            return
        yield Checked(promise)


def _entry(task: Task) -> dict[str, Any]:
    """The entry of a task in a run's config."""
    if not isinstance(task, str):
        return dict(task)
    if not planning.is_id(task):
        return planning.describe_task(task, {}, "--task")
    foreign = planning.ForeignTask.said(task, {}, "--task")
    return planning.describe_foreign(foreign.name, foreign)


def _place(error: Exception) -> str:
    """The last line of code on the way to an error."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return f"{trace.tb_frame.f_code.co_filename}:{trace.tb_lineno}" if trace else ""


class _Counting:
    """Environments as a learner meets them, which count the control steps that were made."""

    def __init__(self, envs: Any) -> None:
        self.envs, self.control_steps = envs, 0

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "envs":
            raise AttributeError(name)
        return getattr(self.envs, name)

    def step(self, actions: Any) -> Any:
        result = self.envs.step(actions)
        self.control_steps += int(np.sum(result[-1].get("control_steps", self.envs.num_envs)))
        return result


class _Trial:
    """Short trainings of one algorithm, each made when it is needed."""

    def __init__(
        self, algorithm: Algorithm, values: Mapping[str, Any], task: Mapping[str, Any], steps: int
    ) -> None:
        self.algorithm, self.values, self.task, self.steps = algorithm, values, task, steps
        self._first: tuple[Any, dict[str, float]] | None = None

    def promises(self) -> dict[str, Callable[[], None]]:
        """What is promised -> what tries it."""
        return {
            "every number among the hyperparameters has a range and a meaning": self.declares,
            "trains until the step it is asked for, with finite metrics": self.trains,
            "its policy is saved as plain arrays and acts the same again": self.saves,
            "a seed decides the numbers, and nothing else does": self.repeats,
            "its state goes through a checkpoint and continues bit for bit": self.resumes,
            "held actions count as the control steps they last": self.holds,
        }

    def trainer(self, seed: int = 100, hold: int = 1) -> Any:
        interface = Interface(hold)
        config = self.algorithm.hyperparameters(**self.values)
        return self.algorithm.trainer(
            config,
            lambda count: _Counting(interface.around(make_envs(self.task, count))),
            seed,
            self.steps,
        )

    def first(self) -> tuple[Any, dict[str, float]]:
        """A trainer that is half way, and its metrics."""
        if self._first is None:
            trainer = self.trainer()
            self._first = trainer, trainer.advance(self.steps // 2)
        return self._first

    def declares(self) -> None:
        config = self.algorithm.hyperparameters
        try:
            records.canonical_json(dataclasses.asdict(config()))
        except (TypeError, ValueError) as error:
            raise BrokenError(
                f"{error}: a record says every hyperparameter; give each a default that is a "
                "number, a text, true or false, or a tuple of them"
            ) from error
        if not issubclass(config, Hyperparameters):
            return  # it may do without ranges
        ranges, said = declared(config, "RANGES"), meanings(config)
        hints = typing.get_type_hints(config)
        for field in dataclasses.fields(config):
            if not said[field.name]:
                raise BrokenError(f"{field.name}: write its meaning in a comment behind the field")
            if hints[field.name] not in (int, float):
                continue
            if field.name not in ranges:
                raise BrokenError(f"{field.name}: say its interval in RANGES")
            if not within(getattr(config(), field.name), ranges[field.name]):
                raise BrokenError(f"{field.name}: its default lies outside {ranges[field.name]}")

    def trains(self) -> None:
        trainer, metrics = self.first()
        if trainer.step < self.steps // 2:
            raise BrokenError(
                f"step is {trainer.step} after advance({self.steps // 2}); go on until it is there"
            )
        for name, value in metrics.items():
            if not isinstance(value, float | int):
                raise BrokenError(f"the metric {name} is {show(value)}; make it a float")
            if not np.isfinite(value) and not name.startswith("train_"):
                raise BrokenError(f"the metric {name} is {value}; leave it out where it is unknown")
        parameters = trainer.policy.network.parameters.detach()
        if not bool(parameters.isfinite().all()):
            raise BrokenError("a parameter of the policy is not finite")

    def saves(self) -> None:
        from safemr.learning.policies import Policy

        trainer, _ = self.first()
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **trainer.policy.arrays())
        buffer.seek(0)
        with np.load(buffer, allow_pickle=False) as arrays:
            again = Policy.from_arrays(dict(arrays))
        envs = make_envs(self.task, 5)
        observations, _ = envs.reset(seed=1)
        actions = trainer.policy.act(observations)
        shape = (5, *envs.single_action_space.shape)
        envs.close()
        if actions.shape != shape or actions.dtype != np.float32 or np.abs(actions).max() > 1.0:
            raise BrokenError(
                f"act gives {actions.dtype} of shape {actions.shape}, up to "
                f"{np.abs(actions).max():.3g}; make it float32 of shape {shape} in [-1, 1]"
            )
        if not np.array_equal(again.act(observations), actions):
            raise BrokenError(
                "the saved policy acts otherwise; see safemr.learning.policies.Policy"
            )

    def repeats(self) -> None:
        import torch

        trainer, _ = self.first()
        state = np.random.get_state(), torch.get_rng_state()  # noqa: NPY002
        try:
            np.random.seed(12345)  # noqa: NPY002
            torch.manual_seed(12345)
            other, changed = self.trainer(), self.trainer(seed=101)
            for each in (other, changed):
                each.advance(self.steps // 2)
        finally:
            np.random.set_state(state[0])  # noqa: NPY002
            torch.set_rng_state(state[1])
        if (name := _differing(trainer, other)) is not None:
            raise BrokenError(
                f"two runs with one seed differ in {name}; draw from generators of "
                "safemr.learning.contract.generator, never from torch's or NumPy's own"
            )
        if _differing(trainer, changed) is None:
            raise BrokenError("two seeds give the same policy; seed weights and environments")

    def resumes(self) -> None:
        from safemr.experiment import checkpoints

        trainer, _ = self.first()
        resumed = self.trainer()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / checkpoints.CHECKPOINT
            checkpoints.save(path, {"state": trainer.state_dict()})
            resumed.load_state_dict(checkpoints.load(path)["state"])
        if resumed.step != trainer.step:
            raise BrokenError(f"step is {resumed.step}, not {trainer.step}, after load_state_dict")
        if (name := _differing(trainer, resumed)) is not None:
            raise BrokenError(f"after load_state_dict {name} of the policy is another")
        if not exact_resume(trainer.envs if hasattr(trainer, "envs") else None):
            return  # its episodes begin anew
        rows = [each.advance(self.steps) for each in (trainer, resumed)]
        if (name := _differing(trainer, resumed)) is not None:
            raise BrokenError(
                f"the resumed run ends with another {name}; its state lacks something that the "
                "next steps read: a generator, an optimiser, a multiplier, the environments"
            )
        texts = [records.format_progress([{**row, "step": 1}]) for row in rows]
        if texts[0] != texts[1]:
            raise BrokenError("the resumed run logs other metrics; keep their sums in the state")

    def holds(self) -> None:
        trainer = self.trainer(hold=HELD)
        trainer.advance(self.steps // 2)
        made = trainer.envs.control_steps if hasattr(trainer, "envs") else trainer.step
        if trainer.step != made:
            raise BrokenError(
                f"step is {trainer.step} after {made} control steps; add infos['control_steps'] of "
                "each step, as safemr.learning.interface gives it"
            )
        if trainer.policy.action_repeat != HELD:
            raise BrokenError(
                "its policy does not hold actions; make it with interface=interface_of(envs)"
            )


def _differing(one: Any, other: Any) -> str | None:
    """The first array in which two trainers' policies differ, or None."""
    arrays, others = one.policy.arrays(), other.policy.arrays()
    names = (name for name in arrays if not np.array_equal(arrays[name], others.get(name)))
    return next(names, None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints a line a promise; returns 1 where one is broken.

    Raises:
        UserError: as `check`.
    """
    parser = argparse.ArgumentParser(
        "safemr check-algorithm",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("algorithm", help="its name, or PACKAGE.MODULE")
    parser.add_argument(
        "--task", default=paper.AIRCRAFT_TASK, help="default %(default)s; or PACKAGE:NAME-v0"
    )
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE",
                        help="a hyperparameter")  # fmt: skip
    parser.add_argument("--steps", type=int, default=STEPS, help="of a training: %(default)s")
    options = parser.parse_args(arguments)
    if options.steps < 2:
        raise UserError("--steps must be at least 2")
    settings = dict(map(assignment, options.set))
    found = check(options.algorithm, options.task, settings, options.steps)
    broken = False
    for checked in found:
        broken = bool(checked.fault)
        print(f"{'BROKEN' if broken else 'ok':6}  {checked.promise}")
        if broken:
            print(f"        {checked.fault}")
    if not broken:
        algorithm = load_algorithm(options.algorithm)
        print(f"{algorithm.name}, version {algorithm.version}, keeps the contract on "
              f"{options.task}")  # fmt: skip
    return int(broken)
