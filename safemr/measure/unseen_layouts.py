"""Final policies on layouts that no run was evaluated on.

A run's evaluations repeat ten layouts, so that its curve is smooth; intervals over seeds say
nothing of other layouts. Here every final policy flies the same larger set, once.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from safemr.experiment import records
from safemr.measure import evaluate
from safemr.measure.controllers import SCORE_COLUMNS
from safemr.measure.store import Measurements


def measured_scores(
    measurements: Measurements, folders: Sequence[Path], *, episodes: int, seed: int
) -> pd.DataFrame:
    """Score table of records on ``episodes`` layouts, the first with ``seed``; each is kept.

    Metrics are those of the final evaluations (``eval_return``, ...) and ``eval_return_sd``, the
    standard deviation over layouts. A record without a policy, which is optional, gives no row.
    """
    rows = []
    for folder in folders:
        if not (folder / records.POLICY).exists():
            print(f"no policy in {folder}")
            continue
        found = evaluate.measured(measurements, folder, episodes=episodes, seed=seed)
        config = json.loads((folder / records.CONFIG).read_text(encoding="utf-8"))
        provenance = json.loads((folder / records.PROVENANCE).read_text(encoding="utf-8"))
        name = (config["task"]["name"], provenance["variant"], config["seed"])
        rows += [(*name, f"eval_{metric}", value) for metric, value in found.items()]
    return pd.DataFrame(rows, columns=SCORE_COLUMNS)
