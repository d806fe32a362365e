"""Training throughput of the on-policy algorithms: environment steps a second, updates included.

    python -m benchmarks.on_policy [--task Pillars-0.15-Goal] [--epochs 3] [--output FILE.csv]

Settings: ``grid`` are the defaults of each algorithm's Config (what config/config.yaml trains
with); ``published`` restores the passes and network of safety-starter-agents and of the JointSIS
authors' comparison; ``omnisafe`` is PPO-Lagrangian with the network, epoch and number of passes of
OmniSafe 0.5.0 (64x64, 20,000 steps, at most 40 passes) and larger minibatches; OmniSafe itself is
measured beside it by `benchmarks.peers`. Passes are those that were made, after PPO's early stop.
One thread; process CPU time, which other programs disturb less.
"""

from __future__ import annotations

import argparse
import csv
import functools
import importlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from benchmarks.training import watch
from safemr.learning.interface import Interface
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
PARTS = ("_collect", "update_policy", "_fit_critics")
BACKENDS = ("torch", "fused")
HELD = {"num_envs": 16, "epoch_steps": 16_000, "value_batch": 320}
COMPARED = (  # task, how its learner meets it, hyperparameters of all, and of PPO-Lagrangian
    ("Pillars-0.15-Goal", Interface(), {}, {}),
    (
        "Hazards-0.30-Push",
        Interface(5, (0.05, 1.0), ("single",)),
        HELD,
        {"policy_batch": 320},
    ),
)


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
    }


def compare(
    algorithm: str,
    task: str,
    interface: Interface,
    overrides: dict[str, Any],
    epochs: int,
) -> list[dict[str, Any]]:
    """CPU ms per 1,000 control steps of both backends by part, a row each."""
    module = importlib.import_module(f"safemr.algorithms.{algorithm}")

    def met(num_envs: int) -> Any:
        envs = make_envs(task, num_envs)
        return interface.fitted(envs).around(envs)

    runs = []
    for backend in BACKENDS:
        config = module.Config(backend=backend, **overrides)
        trainer = module.Trainer(config, met, 100, 10**9)
        trainer.advance(1)
        runs.append((trainer, watch(trainer), []))
    for _ in range(epochs):
        for trainer, stopwatch, samples in runs:
            stopwatch.reset()
            begun = trainer.step
            trainer.advance(begun + 1)
            stopwatch.lap()
            scale = 1e6 / (trainer.step - begun)
            samples.append({part: scale * spent for part, spent in stopwatch.spent.items()})
    rows = []
    for trainer, _, samples in runs:
        parts = {
            part: round(statistics.median(sample[part] for sample in samples), 1)
            for part in samples[0]
        }
        total = round(statistics.median(sum(sample.values()) for sample in samples), 1)
        case = {"algorithm": algorithm, "task": task, "backend": trainer.config.backend}
        rows.append({**case, "total": total, **parts})
    rows[1]["ratio"] = round(rows[0]["total"] / rows[1]["total"], 2)
    return rows


def compared(epochs: int) -> list[dict[str, Any]]:
    """Both backends in all cases."""
    rows = []
    for task, interface, shared, ppo in COMPARED:
        for algorithm in ALGORITHMS:
            overrides = {**shared, **(ppo if algorithm == "ppo_lagrangian" else {})}
            rows += compare(algorithm, task, interface, overrides, epochs)
            for row in rows[-2:]:
                print("  ".join(f"{name}={value}" for name, value in row.items()), flush=True)
    return rows


def grids(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Each algorithm with the settings that are named above."""
    cases = [("ppo_lagrangian", "omnisafe", OMNISAFE)]
    for algorithm in ALGORITHMS:
        published = importlib.import_module(f"safemr.algorithms.{algorithm}").PUBLISHED
        cases += [(algorithm, "grid", {}), (algorithm, "published", published)]
    rows = []
    for case in cases:
        rows.append(measure(*case, arguments.task, arguments.epochs))
        print("  ".join(f"{name}={value}" for name, value in rows[-1].items()), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--task", default="Pillars-0.15-Goal")
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--backends", action="store_true", help="compare the two backends")
    parser.add_argument("--output", help="also write the table to this CSV file")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = compared(arguments.epochs) if arguments.backends else grids(arguments)
    if arguments.output:
        with open(arguments.output, "w", newline="") as stream:
            writer = csv.DictWriter(stream, list(rows[-1]))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
