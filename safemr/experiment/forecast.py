"""What a dry run announces: the runs that are to be trained, and about how long they take."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from safemr.experiment.planning import Run
from safemr.experiment.record import Record
from safemr.experiment.records import RecordError
from safemr.tasks import Described, is_foreign, name_of


class Cost(NamedTuple):
    """What a recorded run took."""

    task: str
    hyperparameters: frozenset[str]  # their names, which tell families apart
    algorithm: str
    cpu_s_per_step: float


def announced(root: Path, runs: Sequence[Run]) -> list[str]:
    """Lines about those of ``runs`` that have no record under ``root``; none when all have one."""
    opened = [(run, opened_at(root / run.path)) for run in runs]
    missing = [run for run, record in opened if record is None]
    if not missing:
        return []
    known = list(costs(record for _, record in opened if record is not None))
    seconds = [estimate(run, known) for run in missing]
    estimated = sum(value for value in seconds if value is not None)
    unknown = sum(value is None for value in seconds)
    time = f"about {duration(estimated)} by the records here"
    if unknown:
        time = "for how long no record tells"
        if estimated:
            time = f"about {duration(estimated)} and {counted(unknown, 'run')} of unknown length"
    lines = [f"To be trained: {counted(len(missing), 'run')}, {time}"]
    for variant in dict.fromkeys(run.variant for run in missing):
        counts: dict[str, int] = {}
        for run in missing:
            if run.variant == variant:
                counts[run.task] = counts.get(run.task, 0) + 1
        places = ", ".join(f"{task} {count}" for task, count in counts.items())
        lines.append(f"  {variant}: {places}")
    return lines


def left_out(tasks: Mapping[str, Described]) -> list[str]:
    """Lines about what is not made for tasks whose environment cannot tell it."""
    without = [name for name, task in tasks.items() if is_foreign(task.entry)]
    if not without:
        return []
    return [
        f"{', '.join(without)}: curves, tables, claims and reports; no check of certificates, "
        "which asks for a model of the robot, and no trajectories, which ask for a scene to draw"
    ]


def opened_at(folder: Path) -> Record | None:
    """The record in a folder, or None where there is none that can be believed."""
    try:
        return Record.open(folder)
    except RecordError:
        return None


def costs(recorded: Iterable[Record]) -> Iterator[Cost]:
    """What those records took that say it."""
    for record in recorded:
        if (seconds := record.provenance.get("cpu_s")) is None:
            continue  # an outside record need not say it
        names = frozenset(record.hyperparameters)
        per_step = seconds / record.config["steps"]
        yield Cost(name_of(record.task), names, record.algorithm, per_step)


def estimate(run: Run, known: Sequence[Cost]) -> float | None:
    """CPU seconds of a run: the mean a step of the most similar algorithm recorded on its task.

    All runs of a plan meet a task through one interface, so a decision takes as many steps.
    """
    algorithm = run.config["algorithm"]
    names = set(algorithm["hyperparameters"])

    def similarity(cost: Cost) -> tuple[bool, float]:
        same = len(names & cost.hyperparameters) / max(len(names | cost.hyperparameters), 1)
        return cost.algorithm == algorithm["name"], same

    on_task = [cost for cost in known if cost.task == run.task]
    if not on_task:
        return None
    best = max(map(similarity, on_task))
    rates = [cost.cpu_s_per_step for cost in on_task if similarity(cost) == best]
    return float(run.config["steps"] * sum(rates) / len(rates))


def duration(seconds: float) -> str:
    """Processor time in words."""
    minutes = seconds / 60
    return f"{minutes / 60:.1f} core-hours" if minutes >= 90 else f"{minutes:.0f} core-minutes"


def counted(number: int, noun: str) -> str:
    """``1 run``, ``2 runs``."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
