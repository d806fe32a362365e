"""``safemr check``: what an environment from outside has and lacks, with the remedies.

safemr check my_package:MyTask-v0 --set task.d_min=0.3
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any

from safemr.environments import check_envs
from safemr.errors import UserError, tell
from safemr.experiment.strict_yaml import assignment
from safemr.experiment.task_entries import ForeignTask
from safemr.tasks import make_envs


def lines(identity: str, settings: Mapping[str, Any]) -> tuple[list[str], str]:
    """What to say of an environment, and an algorithm to begin with, none where it is not ready.

    Raises:
        UserError: it cannot be made or played at all.
    """
    from safemr.foreign_check import examined

    task = ForeignTask.said(identity, settings, "safemr check")
    entry = {"name": task.name, "id": task.id, "settings": dict(task.settings), **task.options}
    found = examined(entry)
    said = [f"  {name:14}{text}" for name, text in found.facts]
    said += [f"  {'missing':14}{text}" for text in found.problems]
    said += [f"  {'for energy':14}{text}" for text in found.lacks]
    if not found.problems:
        said.append(f"  {'snapshots':14}none: a resumed run begins new episodes")
        envs = make_envs(entry, 2)
        try:
            check_envs(envs)
        finally:
            envs.close()
    fitting = "sac_lagrangian" if found.lacks else "safemr"
    return said, "" if found.problems else fitting


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a few lines; the exit status is 2 where something is missing.

    Raises:
        UserError: as `lines`.
    """
    parser = argparse.ArgumentParser(
        "safemr check", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("id", help="as gymnasium.make takes it: my_package:MyTask-v0")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="task.NAME=VALUE",
        help="a setting of the environment, or d_min, num_obstacles, vectorization",
    )
    options = parser.parse_args(arguments)
    settings = dict(map(assignment, options.set))
    for name in settings:
        if not name.startswith("task."):
            raise UserError(f"--set {name}: an environment has task.NAME only")
    given = {name.removeprefix("task."): value for name, value in settings.items()}
    said, algorithm = lines(options.id, given)
    flags = "".join(f" --set {text}" for text in options.set)
    verdict = (
        f"ready: safemr train --task {options.id}{flags} --algorithm {algorithm}"
        if algorithm
        else "not ready: see what is missing"
    )
    tell("\n".join([options.id, *said, verdict]), sys.stdout)
    return 0 if algorithm else 2
