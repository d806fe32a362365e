"""What a table says of the runs that it lacks."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from safemr.report import statistics


def describe_missing(missing: pd.DataFrame) -> str:
    """ "SafeMR on Hazards-0.15-Push (seeds 3, 4); ..." from rows (task, variant, seed)."""
    groups = missing.groupby(["task", "variant"], sort=False)["seed"]
    return "; ".join(
        f"{variant} on {task} (seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))})"
        for (task, variant), seeds in groups
    )


def missing_notes(
    missing: pd.DataFrame | None, tasks: Sequence[str] | None, variants: Sequence[str] | None
) -> tuple[str, ...]:
    """What a table says of the runs that it lacks, out of `statistics.missing_runs`."""
    if missing is None:
        return ()
    if tasks is not None:
        missing = missing[missing["task"].isin(list(tasks))]
    if variants is not None:
        missing = missing[missing["variant"].isin(list(variants))]
    return (f"Runs missing: {describe_missing(missing)}.",) if len(missing) else ()


def unflown_notes(
    expected: pd.DataFrame, runs: pd.DataFrame, flown: pd.DataFrame
) -> tuple[str, ...]:
    """What a table of flights says of runs that are recorded but were not flown.

    expected: task, variant, seed of what it is about; runs: those recorded; flown: a score table.
    """
    recorded = expected.merge(runs[["task", "variant", "seed"]].drop_duplicates())
    unflown = statistics.missing_runs(recorded, flown)
    if unflown.empty:
        return ()
    return (f"Recorded without a policy, so not flown: {describe_missing(unflown)}.",)
