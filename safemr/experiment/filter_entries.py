"""The ``filters`` entry of a configuration: which final policies fly behind which certificates.

Each also flies without a filter.

filters:
  policies: [PPO-L, SafeMR, scripted, random] # labels of `algorithms`, or what nobody trained
  certificates: [phi_h, JointSIS, SafeMR] # phi_0, phi_h, or labels: that of the run of equal seed
  episodes: 100
  seed: 20000 # of the first layout
  tasks: [Pillars-0.15-Goal] # by default all whose robot has a model
  seeds: [0] # by default all that these policies and certificates have
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from safemr import paper
from safemr.conventions import unseen_seed
from safemr.experiment.sections import LARGEST_SEED, Section, distinct, integer, listed, seeds_in
from safemr.names import unknown

# Certificates that nobody learns, by their names in a configuration.
HANDCRAFTED = {"phi_0": paper.PHI_0, "phi_h": paper.PHI_H}
# Policies that nobody learns: the scripted controllers of the task, and random actions.
UNLEARNED = ("scripted", "random")


@dataclass(frozen=True)
class Filters:
    """Final policies behind safety filters, on ``episodes`` layouts, the first with ``seed``."""

    policies: tuple[str, ...]
    certificates: tuple[str, ...]
    episodes: int
    seed: int
    tasks: tuple[str, ...] | None  # None: all
    seeds: tuple[int, ...]


def read_filters(
    value: Any,
    algorithms: Mapping[str, Sequence[int] | None],
    tasks: Collection[str],
    seeds: Sequence[int],
) -> Filters | None:
    """The entry, for a configuration with these tasks and algorithms; None without it.

    algorithms: label -> seeds, None where they are ``seeds``, those of the configuration.

    Raises UserError for the first fault.
    """
    if not value and (value is None or isinstance(value, Mapping)):
        return None
    keys = ("policies", "certificates", "episodes", "seed", "tasks", "seeds")
    section = Section(value, "filters", keys)

    def names(key: str, kind: str, known: Collection[str]) -> tuple[str, ...]:
        found = listed(section.required(key), f"filters.{key}")
        for name in found:
            if name not in list(known):  # what was written may be anything
                raise unknown(kind, name, known, f"filters.{key}")
        distinct(found, f"filters.{key}")
        return tuple(found)

    policies = names("policies", "policy", {*UNLEARNED, *algorithms})
    certificates = names("certificates", "certificate", {*HANDCRAFTED, *algorithms})
    named = [algorithms[name] for name in (*policies, *certificates) if name in algorithms]
    flown = sorted({seed for own in named or [None] for seed in (own or seeds)})
    asked = seeds_in(section.get("seeds", flown), "filters.seeds")
    for seed in asked:
        if seed not in flown:
            raise unknown("seed", seed, map(str, flown), "filters.seeds")
    return Filters(
        policies,
        certificates,
        integer(section.required("episodes"), "filters.episodes", 1),
        integer(section.get("seed", unseen_seed(min(seeds))), "filters.seed", 0, LARGEST_SEED),
        names("tasks", "task", tasks) if "tasks" in section.value else None,
        asked,
    )
