"""The entries of a configuration that say on which layouts policies are judged.

evaluation: {points: 20, episodes: 10, seed: 10000} # in a run; seed: of the first layout
unseen_layouts: {episodes: 100, seed: 20000, own: true} # final policies
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Self

from safemr.conventions import evaluation_seed, own_layouts, unseen_seed
from safemr.errors import UserError
from safemr.experiment.filter_entries import Filters
from safemr.experiment.sections import LARGEST_SEED, Section, flag, integer


@dataclass(frozen=True)
class Evaluation:
    """The deterministic evaluation: how often in a run, how many episodes, which first seed."""

    points: int
    episodes: int
    seed: int

    @classmethod
    def read(cls, value: Any, least: int) -> Self:
        """The entry; least: the least seed of a run, by which that of layouts is chosen."""
        section = Section(value, "evaluation", ("points", "episodes", "seed"))
        seed = section.get("seed", evaluation_seed(least))
        return cls(
            integer(section.required("points"), "evaluation.points", 1),
            integer(section.required("episodes"), "evaluation.episodes", 1),
            integer(seed, "evaluation.seed", 0, LARGEST_SEED),
        )


@dataclass(frozen=True)
class UnseenLayouts:
    """Final policies on layouts that no run was evaluated on: how many, and the first seed."""

    episodes: int
    seed: int
    own: bool  # each seed's runs on layouts of their own, not all on the same

    @classmethod
    def read(cls, value: Any, least: int) -> Self | None:
        """The entry, None without it; least: as `Evaluation.read` takes it."""
        if not value and (value is None or isinstance(value, Mapping)):
            return None
        section = Section(value, "unseen_layouts", ("episodes", "seed", "own"))
        seed = section.get("seed", unseen_seed(least))
        return cls(
            integer(section.required("episodes"), "unseen_layouts.episodes", 1),
            integer(seed, "unseen_layouts.seed", 0, LARGEST_SEED),
            flag(section.get("own", False), "unseen_layouts.own"),
        )


def check_layouts(
    evaluation: Evaluation,
    unseen: UnseenLayouts | None,
    filters: Filters | None,
    seeds: Iterable[int],
) -> None:
    """Refuse layouts that there are not, and called unseen though runs are evaluated on them.

    seeds: of all runs whose final policies are flown. Raises UserError.
    """
    evaluated = range(evaluation.seed, evaluation.seed + evaluation.episodes)
    flown = {}
    if unseen:
        for seed in sorted(seeds) if unseen.own else [0]:
            start = own_layouts(unseen.seed, unseen.episodes, seed)
            said = f"unseen_layouts.own: seed {seed}" if unseen.own else "unseen_layouts"
            flown[said] = range(start, start + unseen.episodes)
    if filters:
        flown["filters"] = range(filters.seed, filters.seed + filters.episodes)
    for said, layouts in flown.items():
        if layouts.stop > LARGEST_SEED:
            raise UserError(
                f"{said} would fly layouts up to {layouts.stop}, of at most {LARGEST_SEED}; choose "
                "smaller seeds"
            )
        if layouts.start < evaluated.stop and evaluated.start < layouts.stop:
            raise UserError(
                f"{said} would fly layouts {layouts.start} to {layouts.stop - 1}, but those from "
                f"{evaluated.start} to {evaluated.stop - 1} are of evaluations, not unseen: choose "
                "another seed of the first layout, or leave it out"
            )
