"""A small score table, for the tests of tables and of claims."""

from __future__ import annotations

import pandas as pd

TASK, OTHER = "Pillars-0.15-Goal", "Hazards-0.15-Push"
RETURNS = {
    (TASK, "SafeMR"): [19.5, 19.6, 18.8],
    (TASK, "JointSIS"): [17.3, 15.9, 16.8],
    (TASK, "FAC-phih"): [15.8, 16.0, 15.1],
    (TASK, "FAC-phi0"): [24.0, 23.5, 24.4],
    (TASK, "CPO"): [21.0, 22.0, 20.5],
    (OTHER, "SafeMR"): [1.7, 1.8, 1.6],
    (OTHER, "JointSIS"): [1.75, 1.7, 1.68],
}
UNSAFE_STEPS = {"FAC-phi0": [3.0, 3.2, 2.9], "CPO": [30.0, 25.0, 40.0]}


def score_rows() -> pd.DataFrame:
    rows = []
    for (task, variant), returns in RETURNS.items():
        steps = UNSAFE_STEPS.get(variant, [0.0, 0.0, 0.0])
        for seed, (value, cost) in enumerate(zip(returns, steps, strict=True)):
            for metric, score in (
                ("eval_return", value),
                ("eval_cost", cost),
                ("eval_cost_indicator", cost),
                ("eval_zero_violation_share", 1.0 if cost == 0 else 0.4),
            ):
                rows.append((task, variant, seed, metric, score))
    return pd.DataFrame(rows, columns=["task", "variant", "seed", "metric", "value"])


def expected_runs(seeds: int = 3) -> pd.DataFrame:
    """A grid (task, variant, seed) with this many seeds of everything in `RETURNS`."""
    rows = [(task, variant, seed) for task, variant in RETURNS for seed in range(seeds)]
    return pd.DataFrame(rows, columns=["task", "variant", "seed"])
