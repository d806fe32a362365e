"""How near a training run is to the least time its own arithmetic and physics need.

    python -m benchmarks.training [--algorithms ...] [--task NAME] [--config FILE] [--blocks N]
        [--output FILE.csv]

Settings are an algorithm's defaults, or what a configuration's runs of it on the task have: their
hyperparameters, how the learner meets the task and the task's settings.

The floor of a part of the program is the time of what it cannot avoid: the simulator's own calls
for the environment, timed in the run, and its matrix products, each timed alone at its own shape,
by whichever of PyTorch and scipy's BLAS is faster. Everything else is counted as overhead:
activations, biases, losses, Adam, gathering samples, sensors, resets, Python. The products are
those that the ``torch`` backend asks PyTorch for, recorded while it trains, without the gradients
with respect to observations, which nothing needs and the numba backend leaves out.

Times are CPU time of this process, per 1,000 environment steps, with a replay memory as full as in
the middle of a long run; backends take turns block by block, and the table shows medians of blocks.
"""

from __future__ import annotations

import argparse
import csv
import functools
import importlib
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
import numba
import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.stopwatch import REST, Stopwatch
from envs import navigation_physics
from envs.tasks import NAVIGATION_TASKS
from safemr.experiment.config import load
from safemr.experiment.planning import load_algorithm, resolve
from safemr.learning.evaluation import evaluate
from safemr.learning.interface import Interface
from safemr.tasks import make_envs

OFF_POLICY = ("safemr", "joint_sis", "fac", "sac_lagrangian")
ON_POLICY = ("ppo_lagrangian", "trpo_lagrangian", "cpo")
BACKENDS = ("torch", "fused")
COLUMNS = ("algorithm", "backend", "part", "ms", "floor_ms", "mflop")

# Part of the program -> where it is done, for each family; times of nested parts are exclusive.
PARTS = {
    "off_policy": {
        "environment": ("envs", "step"),
        "inference": ("agent", "act"),
        "storing": ("replay", "add"),
        "gathering": ("replay", "sample"),
        "targets": ("agent", "critic_targets"),
        "critic step": ("agent.backend", "update_critics"),
        "actor, multiplier step": ("agent.backend", "update_policy"),
        "target networks": ("agent.backend", "follow_critics"),
        "certificate": ("agent", "update_certificate"),
        "update, other": ("agent", "update"),
        "episode statistics": ("episodes", "update"),
    },
    "on_policy": {
        "environment": ("envs", "step"),
        "inference, storing": ("", "_collect"),
        "values, advantages": ("", "_batch"),
        "policy update": ("", "update_policy"),
        "critic step": ("", "_fit_critics"),
        "episode statistics": ("statistics", "update"),
    },
}


def watch(trainer: Any) -> Stopwatch:
    """A stopwatch of the parts of PARTS that this trainer has."""
    stopwatch = Stopwatch()
    for part, (path, method) in PARTS[trainer.family].items():
        owner = functools.reduce(getattr, filter(None, path.split(".")), trainer)
        stopwatch.time(part, owner, method)
    return stopwatch


class SimulatorClock:
    """CPU seconds in the simulator while it is entered: from `mj_step2` to `mj_forward`, between
    which a step of `envs.navigation_physics` calls nothing else."""

    def __init__(self) -> None:
        self.spent = self._begun = 0.0

    def __getattr__(self, name: str) -> Any:
        return getattr(mujoco, name)

    def mj_step2(self, model: Any, data: Any) -> None:
        self._begun = time.process_time()
        mujoco.mj_step2(model, data)

    def mj_forward(self, model: Any, data: Any) -> None:
        mujoco.mj_forward(model, data)
        if self._begun:  # a reset calls it, too
            self.spent += time.process_time() - self._begun
            self._begun = 0.0

    def __enter__(self) -> SimulatorClock:
        navigation_physics.mujoco = self  # type: ignore[assignment]
        return self

    def __exit__(self, *_: object) -> None:
        navigation_physics.mujoco = mujoco


Product = tuple[torch.Size, tuple[int, ...], torch.Size, tuple[int, ...]]


class Products(TorchDispatchMode):
    """Counts matrix products by part, shape and layout."""

    def __init__(self, stopwatch: Stopwatch) -> None:
        super().__init__()
        self.counts: Counter[tuple[str, Product]] = Counter()
        self._stopwatch = stopwatch

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        aten = torch.ops.aten
        first = {aten.mm: 0, aten.bmm: 0, aten.addmm: 1, aten.baddbmm: 1}.get(func.overloadpacket)
        if first is not None:
            a, b = (x if x.dim() == 3 else x[None] for x in args[first : first + 2])
            product = (a.shape, a.stride(), b.shape, b.stride())
            self.counts[self._stopwatch.parts[-1], product] += 1
        return func(*args, **(kwargs or {}))


@numba.njit
def _dot(a: Any, b: Any, out: Any, repeats: int) -> None:
    for _ in range(repeats):
        for member in range(len(a)):
            np.dot(a[member], b[member], out[member])


def _random(shape: torch.Size, stride: tuple[int, ...]) -> torch.Tensor:
    """Normal numbers in the same layout; stride 0 is an operand that all members share."""
    shared = torch.Size(1 if step == 0 else size for size, step in zip(shape, stride, strict=True))
    return torch.empty_strided(shared, stride).normal_().expand(shape)


def product_seconds(product: Product, repeats: int = 20, rounds: int = 3) -> float:
    """CPU seconds of one product by the faster of PyTorch, as it was asked for it, and scipy."""
    shape_a, stride_a, shape_b, stride_b = product
    a, b = _random(shape_a, stride_a), _random(shape_b, stride_b)
    out = torch.empty(shape_a[0], shape_a[1], shape_b[2])
    plain = a.contiguous().numpy(), b.contiguous().numpy(), out.numpy().copy()
    _dot(*plain, 1)
    best = np.inf
    for _ in range(rounds):
        begun = time.process_time()
        for _ in range(repeats):
            torch.bmm(a, b, out=out)
        middle = time.process_time()
        _dot(*plain, repeats)
        best = min(best, middle - begun, time.process_time() - middle)
    return best / repeats


def flop(product: Product) -> float:
    shape_a, _, shape_b, _ = product
    return 2.0 * shape_a.numel() * shape_b[2]


class Run:
    """A trainer in the middle of a run, and its stopwatch."""

    def __init__(
        self,
        algorithm: str,
        task: str,
        held: int,
        backend: str,
        hyperparameters: Mapping[str, Any] | None = None,
        task_settings: Mapping[str, Any] | None = None,
        interface: Mapping[str, Any] | None = None,
        decisions: int = 1024,
    ) -> None:
        module = importlib.import_module(f"safemr.algorithms.{algorithm}")
        settings = dict(hyperparameters or {}) | {"backend": backend}
        off_policy = load_algorithm(algorithm).family == "off_policy"
        if off_policy:  # the middle of a run, sooner
            settings["start_steps"] = 512
        if hasattr(module.Config, "certificate_start"):
            settings["certificate_start"] = 0.0
        config = module.Config(**settings)
        self.described = {"name": task, "settings": dict(task_settings or {})}
        self.interface = Interface.read(interface).fitted(make_envs(self.described, 1))
        self.trainer = module.Trainer(config, self._environments, 100, 10**7)
        self.algorithm, self.backend = algorithm, backend
        # One block: decisions enough for every kind of update, an epoch where there are epochs.
        self.block = decisions * self.interface.action_repeat if off_policy else config.epoch_steps
        self.trainer.advance(2 * self.block if off_policy else self.block)
        if off_policy:
            self._fill_memory(held)
        self.stopwatch = watch(self.trainer)

    def _environments(self, num_envs: int) -> Any:
        return self.interface.around(make_envs(self.described, num_envs))

    def _fill_memory(self, held: int) -> None:
        """Repeats the experience so far: where the samples lie decides how long gathering takes."""
        replay = self.trainer.replay
        state = replay.state_dict()
        times = min(held // replay.num_envs, replay.capacity - 1) // state["size"]
        fields = {
            name: values.repeat(times, *[1] * (values.dim() - 1))
            for name, values in state["fields"].items()
        }
        size = times * state["size"]
        replay.load_state_dict({"head": size, "size": size, "fields": fields})

    def advance(self) -> tuple[dict[str, float], float]:
        """CPU milliseconds by part per 1,000 steps of one block, and those in the simulator.

        Timed in the run, since what a step costs changes within an episode: a box that was just
        placed is awake, one at rest sleeps. Reading the clock twice a step adds one percent.
        """
        trainer, before = self.trainer, self.trainer.step
        self.stopwatch.reset()
        with SimulatorClock() as clock:
            trainer.advance(before + self.block)
        self.stopwatch.lap()
        each = 1e6 / (trainer.step - before)
        return {part: each * spent for part, spent in self.stopwatch.spent.items()}, (
            each * clock.spent
        )

    def products(self, blocks: int = 2) -> dict[tuple[str, Product], float]:
        """Matrix products per 1,000 steps."""
        trainer, before = self.trainer, self.trainer.step
        with Products(self.stopwatch) as products:
            for _ in range(blocks):
                trainer.advance(trainer.step + self.block)
        counts: dict[tuple[str, Product], float] = defaultdict(float)
        for (part, product), count in products.counts.items():
            counts[part, self._needed(part, product)] += 1e3 * count / (trainer.step - before)
        return counts

    def _needed(self, part: str, product: Product) -> Product:
        """Of the gradient with respect to a critic's input, the columns of the action."""
        shape_a, stride_a, shape_b, stride_b = product
        if part == "actor, multiplier step" and len(shape_b) == 3:
            agent = self.trainer.agent
            inputs = agent.critics.shape.sizes[0]
            gradient = shape_b == (agent.critics.shape.count, agent.config.hidden, inputs)
            if gradient and stride_b == (agent.config.hidden * inputs, inputs, 1):
                columns = torch.Size((*shape_b[:2], agent.action_dim))
                width = agent.action_dim
                return shape_a, stride_a, columns, (agent.config.hidden * width, width, 1)
        return product


def settings_of(config: Path, task: str) -> dict[str, dict[str, Any]]:
    """What a configuration's runs on a task are trained with, by algorithm: `Run`'s keywords."""
    found: dict[str, dict[str, Any]] = {}
    for run in resolve(load([config])).trained:
        if run.task == task:
            algorithm = run.config["algorithm"]
            found.setdefault(
                algorithm["name"],
                {
                    "hyperparameters": algorithm["hyperparameters"],
                    "task_settings": run.config["task"]["settings"],
                    "interface": run.config.get("interface"),
                },
            )
    return found


def measure(
    algorithm: str, task: str, blocks: int, held: int, settings: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Rows of COLUMNS for one algorithm, part by part; settings: `settings_of` it."""
    family = load_algorithm(algorithm).family
    runs = [Run(algorithm, task, held, backend, **settings) for backend in BACKENDS]
    products = runs[0].products()
    for run in runs[1:]:  # all at the same stage: what a step of the simulator costs depends on it
        run.products()
    times: list[dict[str, list[float]]] = [defaultdict(list) for _ in runs]
    floors: list[dict[str, list[float]]] = [defaultdict(list) for _ in runs]
    for _ in range(blocks):
        # Taken in turn with training: the machine's speed changes with what its other users do.
        shared: dict[str, float] = defaultdict(float)
        for (part, product), count in products.items():
            shared[part] += 1e3 * count * product_seconds(product)
        for run, found, floor in zip(runs, times, floors, strict=True):
            parts, simulator = run.advance()
            for part, spent in (shared | {"environment": simulator}).items():
                floor[part].append(spent)
            for part, spent in parts.items():
                found[part].append(spent)
    work: dict[str, float] = defaultdict(float)
    for (part, product), count in products.items():
        work[part] += 1e-6 * count * flop(product)
    rows = []
    for run, found, floor in zip(runs, times, floors, strict=True):
        for part in (*PARTS[family], REST):
            spent, least = (median(values[part] or [0.0]) for values in (found, floor))
            values = (algorithm, run.backend, part, spent, least, work[part])
            rows.append(dict(zip(COLUMNS, values, strict=True)))
    return rows


def measure_evaluation(task: str, episodes: int, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The row of a deterministic evaluation, whose floor is the physics alone."""
    run = Run("fac", task, 1, "fused", **settings)
    envs = make_envs(run.described, episodes)
    with SimulatorClock() as clock:
        result = evaluate(run.trainer.policy, envs, 10_000)
    steps = result["episodes"] * result["length"]
    begun = time.process_time()
    evaluate(run.trainer.policy, envs, 10_000)
    spent = time.process_time() - begun
    spent_ms, floor_ms = (1e6 * seconds / steps for seconds in (spent, clock.spent))
    values = ("evaluation", "-", "evaluation", spent_ms, floor_ms, 0.0)
    return dict(zip(COLUMNS, values, strict=True))


def cases(rows: list[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Rows by algorithm and backend, the sum of the parts last."""
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        found[row["algorithm"], row["backend"]].append(row)
    for parts in found.values():
        total = {name: sum(row[name] for row in parts) for name in COLUMNS[3:]}
        parts.append({"part": "all", **total})
    return found


def markdown(rows: list[dict[str, Any]]) -> str:
    """A table a case: parts, their times and floors."""
    lines = []
    for (algorithm, backend), parts in cases(rows).items():
        lines += [f"\n{algorithm}, backend {backend}: CPU ms per 1,000 environment steps\n"]
        lines += ["| part | measured | floor | MFLOP | GFLOP/s |", "|" + " --- |" * 5]
        for row in parts:
            rate = f"{row['mflop'] / row['ms']:.0f}" if row["mflop"] > 1 else "-"
            lines.append(
                f"| {row['part']} | {row['ms']:.1f} | {row['floor_ms']:.1f} "
                f"| {row['mflop']:.0f} | {rate} |"
            )
    return "\n".join(lines)


def summary(rows: list[dict[str, Any]]) -> str:
    """One line a case."""
    header = ("algorithm", "backend", "measured", "floor", "measured / floor")
    lines = ["\n| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    for case, parts in cases(rows).items():
        spent, floor = parts[-1]["ms"], parts[-1]["floor_ms"]
        cells = (*case, f"{spent:.0f}", f"{floor:.0f}", f"{spent / floor:.2f}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.training", description=__doc__)
    every = (*OFF_POLICY, *ON_POLICY)
    parser.add_argument("--algorithms", nargs="+", choices=every, default=every)
    parser.add_argument("--task", choices=NAVIGATION_TASKS, default="Pillars-0.15-Goal")
    parser.add_argument("--config", type=Path, help="a configuration with runs on the task")
    parser.add_argument("--blocks", type=int, default=9)
    parser.add_argument("--held", type=int, default=150_000, help="transitions in the memory")
    parser.add_argument("--episodes", type=int, default=20, help="of the evaluation")
    parser.add_argument("--output", type=Path, help="write the rows as CSV, too")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    settings: dict[str, dict[str, Any]] = {}
    if options.config is not None:
        settings = settings_of(options.config, options.task)
    rows = []
    for algorithm in options.algorithms:
        blocks = options.blocks if algorithm in OFF_POLICY else max(options.blocks // 3, 1)
        chosen = settings.get(algorithm, {})
        rows += measure(algorithm, options.task, blocks, options.held, chosen)
        print(f"{algorithm} measured", file=sys.stderr, flush=True)
    rows.append(measure_evaluation(options.task, options.episodes, settings.get("fac", {})))
    print(markdown(rows))
    print(summary(rows))
    if options.output is not None:
        with options.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
