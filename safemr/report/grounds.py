"""Which runs a claim rests on: those that its rule asks for where nothing is recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import pandas as pd

from safemr import paper
from safemr.report.claims import claims
from safemr.report.findings import Evidence

Pair = tuple[str, str]  # task, variant


@dataclass(frozen=True)
class _Asked(Evidence):
    """Evidence without a run that notes what it is asked for."""

    asked: dict[Pair, None] = field(default_factory=dict)

    def missing(self, pairs: Iterable[Pair]) -> str:
        asked = list(pairs)
        self.asked.update(dict.fromkeys(asked))
        return super().missing(asked)

    def missing_flights(self, variants: Iterable[str]) -> str:
        asked = list(variants)
        self.asked.update(dict.fromkeys((paper.AIRCRAFT_TASK, variant) for variant in asked))
        return super().missing_flights(asked)

    def asks_for(self, pairs: Iterable[Pair]) -> bool:
        self.asked.update(dict.fromkeys(pairs))
        return True


def grounds(points: Mapping[str, tuple[float, float]]) -> dict[str, tuple[Pair, ...]]:
    """Name of each claim -> the (task, variant) pairs whose runs its rule needs, in its order.

    points: variant -> (a, b), as in `Evidence`. A claim about what is computed rests on no run.
    """
    none = pd.DataFrame(columns=["task", "variant", "seed", "metric", "value"])
    found = {}
    for claim in claims():
        evidence = _Asked(scores=none, progress=none, points=points)
        claim.judge(evidence)
        found[claim.name] = tuple(evidence.asked)
    return found
