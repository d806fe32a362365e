"""``safemr list``: tasks, algorithms and their hyperparameters, as the sources describe them.

safemr list                  tasks and algorithms
safemr list safemr           an algorithm's hyperparameters: type, default, meaning
safemr list --all            those of every algorithm
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import sys
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Any

from safemr import packages
from safemr.errors import tell
from safemr.experiment.catalogue import Algorithm, algorithm_names, load_algorithm
from safemr.learning.hyperparameters import meanings, unused


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


def overview() -> Iterator[str]:
    """Lines about the tasks and the algorithms."""
    from safemr.experiment.planning import task_names

    yield "Tasks (docs/environments.md; --set task.NAME=VALUE changes a setting)"
    yield from (f"  {name}" for name in task_names())
    yield ""
    yield "Algorithms (docs/algorithms.md)"
    algorithms = [load_algorithm(name) for name in algorithm_names()]
    width = max(len(algorithm.name) for algorithm in algorithms)
    for algorithm in algorithms:
        yield f"  {algorithm.name:{width}}  {algorithm.family:10}  {summary(algorithm)}"
    for name, module in sorted(packages.registered(packages.ALGORITHMS).items()):
        yield f"  {name:{width}}  of another package: {module}"
    yield ""
    yield "Hyperparameters: safemr list ALGORITHM, or --all"


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
    width = max((len(name) for name, _, _ in rows), default=0)
    for name, value, text in rows:
        yield f"  {name:{width}}  {value}"
        yield from textwrap.wrap(
            text, columns, initial_indent=" " * (width + 6), subsequent_indent=" " * (width + 6)
        )
    for name, reason in ignored.items():
        yield f"  {name:{width}}  not used: {reason}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the overview, or the hyperparameters of the algorithms named.

    Raises:
        UserError: there is no such algorithm.
    """
    parser = argparse.ArgumentParser(
        "safemr list", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("algorithms", nargs="*", metavar="ALGORITHM")
    parser.add_argument("--all", action="store_true", help="the hyperparameters of all algorithms")
    options = parser.parse_args(arguments)
    names = algorithm_names() if options.all else options.algorithms
    columns = min(max(shutil.get_terminal_size((100, 0)).columns, 60), 120)
    blocks = [details(load_algorithm(name, "safemr list"), columns) for name in names]
    for number, lines in enumerate(blocks or [overview()]):
        tell("\n" * (number > 0) + "\n".join(lines), sys.stdout)
    return 0
