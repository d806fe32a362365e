"""An implementation outside `safemr`: cross-entropy search over linear policies, NumPy only.

It shows what any program, in any language and with any learner, must do to stand in the curves and
tables beside the others: read a run's configuration, train, and write the record that
examples/outside/README.md describes. It imports nothing of `safemr`, and uses the repository's
environments only because the comparison is about them.

    python examples/outside/cross_entropy.py --config CONFIG.json --variant NAME --out FOLDER

Method: de Boer et al., "A tutorial on the cross-entropy method" (2005). A population of policies
a = clip(W f(o)) of a few features f is drawn from a diagonal Gaussian; each plays one episode in a
sub-environment of its own; mean and spread move to those of the best by return - penalty * cost.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

import envs  # noqa: F401  registers the tasks

Array = NDArray[np.float64]
SCHEMA = 1
DEFAULTS = {"population": 32, "elites": 8, "spread": 1.0, "least_spread": 0.1, "penalty": 0.1}


def features(layout: Mapping[str, slice], observations: Array) -> Array:
    """[N, F]: each lidar's readings as a vector (forward, left), then velocity, turning, 1."""
    columns = []
    for name in sorted(name for name in layout if name.endswith("_lidar")):
        readings = observations[:, layout[name]]
        angles = 2.0 * np.pi * (np.arange(readings.shape[1]) + 0.5) / readings.shape[1]
        columns += [readings @ np.cos(angles), readings @ np.sin(angles)]
    velocity, turning = observations[:, layout["velocimeter"]], observations[:, layout["gyro"]]
    columns += [velocity[:, 0], velocity[:, 1], turning[:, 2] / 3.0, np.ones(len(observations))]
    return np.stack(columns, 1)


def play(
    environments: Any, weights: Array, seed: int | None, interface: Mapping[str, Any]
) -> dict[str, Array]:
    """One episode of each policy, weights [N, F, act]; sums over the episode, each [N].

    An action is held for ``action_repeat`` control steps, after which all policies, whose episodes
    begin together, decide anew; every control step counts in the sums.
    """
    repeat = interface.get("action_repeat", 1)
    scale = np.array(interface.get("action_scale", 1.0))
    observations, _ = environments.reset(seed=seed)
    count, step = len(weights), 0
    running = np.ones(count, bool)
    names = ("return", "cost", "cost_indicator", "goals", "length")
    sums = {name: np.zeros(count) for name in names}
    while running.any():
        if step % repeat == 0:
            inputs = features(environments.observation_layout, observations)
            actions = scale * np.clip(np.einsum("no,noa->na", inputs, weights), -1.0, 1.0)
        step += 1
        observations, rewards, terminated, truncated, infos = environments.step(actions)
        goals = infos.get("goal_met", np.zeros(count))  # where a task has goals
        terms = (rewards, infos["cost"], infos["cost_indicator"], goals, running)
        for total, term in zip(sums.values(), terms, strict=True):
            total[running] += term[running]
        running &= ~(terminated | truncated)
    return sums


def summary(sums: Mapping[str, Array], prefix: str) -> dict[str, float]:
    """Metrics under the names of the record's schema."""
    means = {f"{prefix}_{name}": float(values.mean()) for name, values in sums.items()}
    violations, length = sums["cost_indicator"], sums["length"]
    means[f"{prefix}_zero_violation_share"] = float((violations == 0).mean())
    means[f"{prefix}_violation_rate"] = float(violations.sum() / length.sum())
    return means


def search(config: Mapping[str, Any]) -> list[dict[str, float]]:
    """Runs the search; one row of metrics a generation, with the mean policy's evaluation."""
    settings = DEFAULTS | dict(config["algorithm"]["hyperparameters"])
    population, task = int(settings["population"]), config["task"]
    evaluation, interface = config["evaluation"], config.get("interface", {})

    def make(count: int) -> Any:
        registered = task.get("base", task["name"])  # a task with other settings has its own name
        return gymnasium.make_vec(
            f"{registered}-v0", count, "vector_entry_point", **task["settings"]
        )

    environments, test = make(population), make(evaluation["episodes"])
    random = np.random.default_rng(config["seed"])
    observation = np.zeros((1, environments.single_observation_space.shape[0]))
    inputs = features(environments.observation_layout, observation).shape[1]
    shape = (inputs, environments.single_action_space.shape[0])
    mean, spread = np.zeros(shape), np.full(shape, settings["spread"])
    rows: list[dict[str, float]] = []
    step, begun = 0, time.perf_counter()
    while step < config["steps"]:
        candidates = mean + spread * random.standard_normal((population, *shape))
        seed = int(random.integers(2**31)) if not rows else None
        sums = play(environments, candidates, seed, interface)
        order = np.argsort(settings["penalty"] * sums["cost"] - sums["return"])
        elites = candidates[order[: int(settings["elites"])]]
        mean = elites.mean(0)
        spread = np.maximum(elites.std(0), settings["least_spread"])
        before, step = step, step + int(sums["length"].sum())
        row = {"step": step, **summary(sums, "train"), "spread": float(spread.mean())}
        if step // evaluation["every"] > before // evaluation["every"] or step >= config["steps"]:
            policies = np.repeat(mean[None], evaluation["episodes"], 0)
            row |= summary(play(test, policies, evaluation["seed"], interface), "eval")
        rows.append(row | {"time_wall_s": time.perf_counter() - begun})
    return rows


def write_record(
    folder: Path, text: str, variant: str, rows: Sequence[Mapping[str, float]]
) -> None:
    """The three files of a record; provenance.json, which vouches for the others, comes last."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text(text + "\n")
    columns = ["step", *sorted({name for row in rows for name in row} - {"step"})]
    with open(folder / "progress.csv", "w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    provenance = {
        "schema": SCHEMA,
        "digest": hashlib.sha256(text.encode()).hexdigest()[:12],
        "variant": variant,
        "status": "complete",
        "implementation": "examples/outside/cross_entropy.py",
        "packages": {"gymnasium": gymnasium.__version__, "numpy": np.__version__},
        "wall_s": rows[-1]["time_wall_s"],
        "files": {
            name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
            for name in ("config.json", "progress.csv")
        },
    }
    (folder / "provenance.json").write_text(json.dumps(provenance, sort_keys=True, indent=1) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--config", required=True, help="the run's canonical JSON, or a file of it")
    parser.add_argument("--variant", required=True, help="label in figures and tables")
    parser.add_argument("--out", required=True, type=Path, help="the record's folder")
    arguments = parser.parse_args()
    text = arguments.config
    if not text.startswith("{"):
        text = Path(text).read_text().strip()
    config = json.loads(text)
    unknown = sorted(config["algorithm"]["hyperparameters"].keys() - DEFAULTS.keys())
    if unknown:
        parser.error(f"unknown hyperparameter {unknown[0]!r}; known: {', '.join(DEFAULTS)}")
    write_record(arguments.out, text, arguments.variant, search(config))


if __name__ == "__main__":
    main()
