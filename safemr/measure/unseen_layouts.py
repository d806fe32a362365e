"""Final policies on layouts that no run was evaluated on.

A run's evaluations repeat ten layouts, so that its curve is smooth; intervals over seeds say
nothing of other layouts. Here every final policy flies the same larger set, once.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from safemr.conventions import own_layouts
from safemr.experiment.record import Record
from safemr.files import NoPolicyError
from safemr.measure import evaluate
from safemr.measure.controllers import SCORE_COLUMNS
from safemr.measure.store import Measurements
from safemr.tasks import name_of


def measured_scores(
    measurements: Measurements,
    folders: Sequence[Path],
    *,
    episodes: int,
    seed: int,
    own: bool = False,
) -> pd.DataFrame:
    """Score table of records on ``episodes`` layouts, the first with ``seed``; each is kept.

    own: not all on these, but each on those of its seed (`own_layouts`). Metrics are those of the
    final evaluations (``eval_return``, ...) and ``eval_return_sd``, the standard deviation over
    layouts. A record without a policy, which is optional, gives what was measured before it was
    left out, or no row.
    """
    rows = []
    for folder in folders:
        record = Record.open(folder)
        first = own_layouts(seed, episodes, record.seed) if own else seed
        try:
            found = evaluate.measured(measurements, record, episodes=episodes, seed=first)
        except NoPolicyError:
            print(f"no policy in {folder}")
            continue
        name = (name_of(record.task), record.variant, record.seed)
        rows += [(*name, f"eval_{metric}", value) for metric, value in found.items()]
    return pd.DataFrame(rows, columns=SCORE_COLUMNS)
