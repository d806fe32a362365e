"""``safemr evaluate``: final policies of records on layouts of their task.

safemr evaluate results/runs/Pillars-0.15-Goal/SafeMR/seed0-* --episodes 100 --seed 20000
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from safemr.conventions import unseen_seed
from safemr.errors import UserError
from safemr.experiment.record import Record
from safemr.learning.evaluation import play
from safemr.measure.store import Measurements
from safemr.tasks import make_envs

EPISODES = 100


def evaluate_record(
    record: Record,
    *,
    episodes: int = EPISODES,
    seed: int | None = None,
    deterministic: bool = True,
) -> dict[str, float]:
    """A record's final policy on ``episodes`` layouts of its task: `evaluate`, and ``return_sd``.

    seed: of the first layout; by default one that no run like it was evaluated on (`unseen_seed`).
    ``return_sd`` is the standard deviation of the return over the layouts (nan for one).

    Raises:
        UserError: the record has no policy.
    """
    policy = record.policy()
    envs = make_envs(record.task, episodes)
    try:
        first = unseen_seed(record.seed) if seed is None else seed
        played = play(policy, envs, first, deterministic)
    finally:
        envs.close()
    returns = played.finished[:, played.names.index("return")]
    return {
        **played.pop(),
        "return_sd": float(returns.std(ddof=1)) if episodes > 1 else float("nan"),
    }


def measured(
    measurements: Measurements, record: Record, *, episodes: int, seed: int
) -> Mapping[str, float]:
    """`evaluate_record`, kept among ``measurements``."""
    inputs = {**record.inputs, "episodes": episodes, "seed": seed}
    return measurements.rows(
        "unseen_layouts",
        record.label,
        inputs,
        lambda: evaluate_record(record, episodes=episodes, seed=seed),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """``safemr evaluate RECORD ...``: one line a record."""
    parser = argparse.ArgumentParser(
        prog="safemr evaluate", description="Fly the final policies of run records."
    )
    parser.add_argument("records", type=Path, nargs="+", metavar="RECORD", help="its folder")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="one layout each")
    parser.add_argument(
        "--seed",
        type=int,
        help="of the first layout (default: those that no run of its kind was evaluated on)",
    )
    parser.add_argument("--exploring", action="store_true", help="sample the actions")
    options = parser.parse_args(arguments)
    if options.episodes < 1 or (options.seed or 0) < 0:
        raise UserError("--episodes must be 1 or more, and --seed 0 or more")
    for folder in options.records:
        found = evaluate_record(
            Record.open(folder),
            episodes=options.episodes,
            seed=options.seed,
            deterministic=not options.exploring,
        )
        print(
            f"{folder}: return {found['return']:.2f} (sd {found['return_sd']:.2f} over "
            f"{options.episodes} layouts), cost {found['cost']:.3f}, violating steps "
            f"{found['cost_indicator']:.3f}, clean episodes {found['zero_violation_share']:.1%}",
            flush=True,
        )
    return 0
