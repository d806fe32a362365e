"""Training throughput of the on-policy algorithms: environment steps a second, updates included.

    python -m benchmarks.on_policy [--task Pillars-0.15-Goal] [--epochs 3] [--output FILE.csv]

Settings: ``grid`` are the defaults of each algorithm's Config (what config/config.yaml trains
with); ``published`` restores the passes and network of safety-starter-agents and of the JointSIS
authors' comparison; ``omnisafe`` is PPO-Lagrangian with the network, epoch and number of passes of
OmniSafe 0.5.0 (64x64, 20,000 steps, at most 40 passes) and larger minibatches; OmniSafe's own rate
on SafetyPointGoal1 was about 140 steps/s on one core of a machine of this kind. Passes are those
that were made, after PPO's early stop. One thread; process CPU time, which other programs disturb
less.
"""

from __future__ import annotations

import argparse
import csv
import functools
import importlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from safemr.tasks import make_envs

ALGORITHMS = ("ppo_lagrangian", "trpo_lagrangian", "cpo")
OMNISAFE = {
    "num_envs": 20,
    "epoch_steps": 20_000,
    "hidden": 64,
    "target_kl": 0.02,
    "policy_passes": 40,
    "policy_batch": 2_000,
    "value_passes": 40,
    "value_batch": 2_000,
}
OMNISAFE_STEPS_PER_SECOND = 140.0
PARTS = ("_collect", "update_policy", "_fit_critics")


def timed(trainer: Any, spent: dict[str, float]) -> None:
    """Adds the CPU seconds of the three parts of an epoch to ``spent``."""

    def wrap(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def measured(*arguments: Any) -> Any:
            begun = time.process_time()
            result = function(*arguments)
            spent[name] += time.process_time() - begun
            return result

        return measured

    for name in PARTS:
        setattr(trainer, name, wrap(name, getattr(trainer, name)))


def measure(
    algorithm: str, label: str, overrides: dict[str, Any], task: str, epochs: int
) -> dict[str, Any]:
    """Trains one warm-up epoch and ``epochs`` measured ones."""
    module = importlib.import_module(f"safemr.algorithms.{algorithm}")
    config = module.Config(**overrides)

    trainer = module.Trainer(config, functools.partial(make_envs, task), 100, 10**9)
    trainer.advance(1)
    spent = dict.fromkeys(PARTS, 0.0)
    timed(trainer, spent)
    begun = time.process_time()
    metrics = trainer.advance(trainer.step + epochs * config.epoch_steps)
    total = time.process_time() - begun
    rate = epochs * config.epoch_steps / total
    shares = {name.strip("_"): round(seconds / total, 3) for name, seconds in spent.items()}
    return {
        "algorithm": algorithm,
        "settings": label,
        "steps_per_s": round(rate),
        "s_per_epoch": round(total / epochs, 2),
        "epoch_steps": config.epoch_steps,
        "hidden": config.hidden,
        "policy_passes": round(metrics.get("policy_passes", np.nan), 1),
        "value_passes": config.value_passes,
        **shares,
        "times_omnisafe": round(rate / OMNISAFE_STEPS_PER_SECOND, 1) if label == "omnisafe" else "",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="Pillars-0.15-Goal")
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--output", help="also write the table to this CSV file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cases = [("ppo_lagrangian", "omnisafe", OMNISAFE)]
    for algorithm in ALGORITHMS:
        published = importlib.import_module(f"safemr.algorithms.{algorithm}").PUBLISHED
        cases += [(algorithm, "grid", {}), (algorithm, "published", published)]
    rows = []
    for case in cases:
        rows.append(measure(*case, arguments.task, arguments.epochs))
        print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    if arguments.output:
        with open(arguments.output, "w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
