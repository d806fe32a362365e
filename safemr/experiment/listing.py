"""``safemr list``: what there is to choose from and to set, as the sources describe it.

safemr list                    tasks, algorithms, configurations
safemr list safemr             an algorithm's hyperparameters: type, default, meaning
safemr list Pillars-0.15-Goal  a task's settings, likewise
safemr list --all              the hyperparameters of every algorithm
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import itertools
import math
import re
import shutil
import sys
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from safemr import packages
from safemr.errors import tell
from safemr.experiment.catalogue import Algorithm, algorithm_names, load_algorithm
from safemr.experiment.task_entries import task_names
from safemr.files import REPOSITORY
from safemr.learning.hyperparameters import meanings, unused
from safemr.names import unknown
from safemr.tasks import SIMULATION, make_envs, traits


def summary(algorithm: Algorithm) -> str:
    """The first line of an algorithm's file."""
    return (sys.modules[algorithm.trainer.__module__].__doc__ or "").strip().partition("\n")[0]


def kind(hint: Any) -> str:
    """A type as it is written in a configuration: ``float``, ``fused | torch``."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Literal:
        return " | ".join(map(str, arguments))
    if origin in (typing.Union, types.UnionType):
        return " | ".join(map(kind, arguments))
    return getattr(hint, "__name__", str(hint)) if origin is None else str(hint)


def overview(columns: int) -> Iterator[str]:
    """Lines about the tasks, the algorithms and the configurations, the last ones cut to fit."""
    yield "Tasks (docs/environments.md)"
    tasks = task_names()
    width = max(map(len, tasks))
    yield from (f"  {name:{width}}  {scene(name)}" for name in tasks)
    yield ""
    yield "Algorithms (docs/algorithms.md)"
    algorithms = [load_algorithm(name) for name in algorithm_names()]
    width = max(len(algorithm.name) for algorithm in algorithms)
    for algorithm in algorithms:
        yield f"  {algorithm.name:{width}}  {algorithm.family:10}  {summary(algorithm)}"
    for name, module in sorted(packages.registered(packages.ALGORITHMS).items()):
        yield f"  {name:{width}}  of another package: {module}"
    files = sorted((REPOSITORY / "config").glob("*.yaml"))
    if files:  # which an installed package does not have
        yield ""
        yield "Configurations (make.py all --configfile config/NAME, safemr progress)"
        width = max(len(file.name) for file in files)
        for file in files:
            text = textwrap.shorten(purpose(file), columns - width - 4, placeholder=" ...")
            yield f"  {file.name:{width}}  {text}"
    yield ""
    yield "What can be set, with defaults and meaning: safemr list ALGORITHM or TASK, or --all"


def scene(task: str) -> str:
    """A registered task in a line."""
    envs = make_envs(task, 1)
    count, steps = envs.num_obstacles, traits(envs).episode_steps
    spaces = (envs.single_observation_space, envs.single_action_space)
    sizes = [math.prod(space.shape) for space in spaces]
    envs.close()
    return (
        f"{count} obstacle{'s' * (count != 1)}, d_min {envs.d_min:g} m, "
        f"episodes of {steps:,} steps, observation [{sizes[0]}], action [{sizes[1]}]"
    )


def purpose(file: Path) -> str:
    """The first sentence of the comment that a configuration begins with."""
    lines = itertools.takewhile(lambda line: line.startswith("#"), file.read_text().splitlines())
    return re.split(r"\.(?: |$)", " ".join(line.strip("# ") for line in lines))[0]


def settings(task: str, columns: int) -> Iterator[str]:
    """Lines about the settings of a registered task, as `details`."""
    envs: Any = make_envs(task, 1)
    fields = getattr(envs, "task", None)  # the dataclass whose fields the settings are, or none
    meaning = meanings(type(fields)) if fields else {}
    keywords = inspect.signature(type(envs).__init__).parameters

    def default(name: str) -> Any:
        if fields:
            return getattr(fields, name)
        value = keywords[name].default  # of a keyword without one, what the environment then has
        return getattr(envs, name) if value is None else value

    yield f"{task}: {scene(task)}"
    kept = "".join(f" ({name} apart)" for name in SIMULATION if name in envs.setting_names)
    yield f"Another value makes another task{kept}: --task-name NAME --set task.SETTING=VALUE"
    yield from _fields(
        [(name, f"= {default(name)}", meaning.get(name, "")) for name in envs.setting_names],
        columns,
    )
    envs.close()


def _fields(rows: Sequence[tuple[str, str, str]], columns: int) -> Iterator[str]:
    """Lines of (name, value, meaning); the meaning is wrapped below."""
    width = max((len(name) for name, _, _ in rows), default=0)
    for name, value, text in rows:
        yield f"  {name:{width}}  {value}"
        yield from textwrap.wrap(
            text, columns, initial_indent=" " * (width + 6), subsequent_indent=" " * (width + 6)
        )


def details(algorithm: Algorithm, columns: int) -> Iterator[str]:
    """Lines about an algorithm's hyperparameters, at most ``columns`` wide where words allow it."""
    yield f"{algorithm.name} ({algorithm.family}, version {algorithm.version})"
    yield from textwrap.wrap(summary(algorithm), columns)
    config = algorithm.hyperparameters
    hints, meaning, ignored = typing.get_type_hints(config), meanings(config), unused(config)
    rows = [
        (field.name, f"{kind(hints[field.name])} = {field.default}", meaning[field.name])
        for field in dataclasses.fields(config)
        if field.init and field.name not in ignored
    ]
    yield from _fields(rows, columns)
    width = max((len(name) for name, _, _ in rows), default=0)
    for name, reason in ignored.items():
        yield f"  {name:{width}}  not used: {reason}"


def _block(name: str, columns: int) -> Iterator[str]:
    """Lines about what has a name. Raises UserError where nothing has."""
    if name in task_names():
        return settings(name, columns)
    if "-" in name:  # which no module's name has
        raise unknown("task", name, task_names(), "safemr list")
    return details(load_algorithm(name, "safemr list"), columns)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the overview, or what can be set of the algorithms and tasks named.

    Raises:
        UserError: there is no such algorithm or task.
    """
    parser = argparse.ArgumentParser(
        "safemr list", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="an algorithm or a task")
    parser.add_argument("--all", action="store_true", help="the hyperparameters of all algorithms")
    options = parser.parse_args(arguments)
    names = algorithm_names() if options.all else options.names
    columns = min(max(shutil.get_terminal_size((100, 0)).columns, 60), 120)
    blocks = [_block(name, columns) for name in names]
    for number, lines in enumerate(blocks or [overview(columns)]):
        tell("\n" * (number > 0) + "\n".join(lines), sys.stdout)
    return 0
