"""How fast the navigation environments are against the physics alone, and what one costs in memory.

    python -m benchmarks.environments [--tasks ...] [--rounds N] [--num-envs N] [--output FILE.csv]

All variants of a task are timed in turn, round by round, from the same states and with the same
actions, in CPU time of this process; the table shows medians over rounds, and medians of the
ratios within a round, which the noise of a shared machine hardly touches.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import importlib.util
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium
import mujoco
import numpy as np

import envs  # noqa: F401  (registers the tasks)
from envs.navigation_batch import NavigationBatch
from envs.navigation_physics import FRAME_SKIP
from envs.tasks import NAVIGATION_TASKS
from safemr.tasks import make_envs

COLUMNS = (
    "task",
    "sleep",
    "raw steps/s",
    "batched steps/s",
    "scalar steps/s",
    "batched / raw",
    "scalar / raw",
    "MB per extra env",
)
PEERS = {"safety_gymnasium": ("SafetyPointGoal1-v0", "SafetyPointPush1-v0")}
EXTRA_ENVS = 64

MEMORY_PROGRAM = """
import sys
import numpy
from benchmarks.environments import resident_megabytes
from safemr.tasks import make_envs
name, num_envs, sleep = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "True"
vector = make_envs({"name": name, "settings": {"sleep": sleep}}, num_envs)
vector.reset(seed=0)
for _ in range(20):
    vector.step(numpy.zeros((num_envs, 2)))
print(resident_megabytes())
"""


def resident_megabytes() -> float:
    """Resident memory of this process in MB; where /proc is absent, its largest so far."""
    statistics = Path("/proc/self/statm")
    if statistics.exists():
        return int(statistics.read_text().split()[1]) * resource.getpagesize() / 2**20
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 2**20


def measure_task(
    name: str, sleep: bool, num_envs: int, rounds: int, steps: int
) -> dict[str, str | float]:
    """One row of the table: steps per CPU second of physics, batch and scalar environment."""
    env_id = f"{name}-v0"
    batched: Any = make_envs({"name": name, "settings": {"sleep": sleep}}, num_envs)
    scalar = gymnasium.make(env_id, sleep=sleep, disable_env_checker=True)
    raw = NavigationBatch(NAVIGATION_TASKS[name].with_settings(sleep=sleep), num_envs)
    batched.reset(seed=0)
    scalar.reset(seed=0)
    _spread_resets(batched)
    generator = np.random.default_rng(0)
    rates: dict[str, list[float]] = {"raw": [], "batched": [], "scalar": []}
    for round_index in range(rounds + 1):
        actions = generator.uniform(-1, 1, (steps, num_envs, 2)).astype(np.float32)
        raw.set_state(batched.get_state())
        measured = {
            "raw": raw_rate(raw, actions),
            "batched": _rate(_step_batched, batched, actions),
            "scalar": _rate(_step_scalar, scalar, actions.reshape(-1, 2)),
        }
        if round_index > 0:  # the first round compiles and fills caches
            for variant, rate in measured.items():
                rates[variant].append(rate)
    ratios = {
        variant: median(a / b for a, b in zip(rates[variant], rates["raw"], strict=True))
        for variant in ("batched", "scalar")
    }
    return {
        "task": name,
        "sleep": str(sleep),
        "raw steps/s": round(median(rates["raw"])),
        "batched steps/s": round(median(rates["batched"])),
        "scalar steps/s": round(median(rates["scalar"])),
        "batched / raw": round(ratios["batched"], 3),
        "scalar / raw": round(ratios["scalar"], 3),
        "MB per extra env": round(_memory_per_env(name, sleep), 2),
    }


def measure_peer(env_id: str, package: str, steps: int) -> float:
    """Steps per CPU second of a peer's environment under random actions."""
    env = importlib.import_module(package).make(env_id)
    env.reset(seed=0)
    env.action_space.seed(0)

    actions = np.array([env.action_space.sample() for _ in range(steps)])
    return median(_rate(_step_peer, env, actions) for _ in range(5))


def _rate(run: Callable[[Any, np.ndarray], None], target: Any, actions: np.ndarray) -> float:
    """Environment steps per CPU second; actions [..., 2], one step each."""
    start = time.process_time()
    run(target, actions)
    return actions[..., 0].size / (time.process_time() - start)


def _step_peer(env: Any, actions: np.ndarray) -> None:
    for action in actions:
        *_, terminated, truncated, _ = env.step(action)  # these return the cost apart, too
        if terminated or truncated:
            env.reset()


def raw_rate(batch: NavigationBatch, actions: np.ndarray) -> float:
    """The same for MuJoCo alone. Episodes end as in the environment, since a box that was just
    placed costs more than one at rest, but the resets themselves are not timed."""
    worlds = batch.worlds
    pairs = [(m, d, d.ctrl) for m, d in zip(worlds.models, worlds.data, strict=True)]
    elapsed = 0.0
    for step_actions in actions:
        start = time.process_time()
        for (model, data, ctrl), action in zip(pairs, step_actions, strict=True):
            ctrl[:] = action
            mujoco.mj_step(model, data, nstep=FRAME_SKIP)
        elapsed += time.process_time() - start
        batch.steps += 1
        ended = np.flatnonzero(batch.steps >= batch.task.max_episode_steps)
        if ended.size:
            batch.reset(ended.tolist())
    return actions[..., 0].size / elapsed


def _step_batched(vector: Any, actions: np.ndarray) -> None:
    for step_actions in actions:
        vector.step(step_actions)


def _step_scalar(env: gymnasium.Env, actions: np.ndarray) -> None:
    for action in actions:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()


def _spread_resets(vector: Any) -> None:
    """Let the episodes end one after the other, so that every round has its share of resets."""
    state = vector.get_state()
    state["steps"] = np.arange(vector.num_envs) * vector.max_episode_steps // vector.num_envs
    vector.set_state(state)


def _memory_per_env(name: str, sleep: bool) -> float:
    few, many = (
        float(
            subprocess.run(
                [sys.executable, "-c", MEMORY_PROGRAM, name, str(count), str(sleep)],
                check=True,
                capture_output=True,
                text=True,
            ).stdout
        )
        for count in (1, 1 + EXTRA_ENVS)
    )
    return (many - few) / EXTRA_ENVS


def markdown(rows: list[dict[str, str | float]]) -> str:
    """A Markdown table of rows with COLUMNS."""
    lines = ["| " + " | ".join(COLUMNS) + " |", "|" + " --- |" * len(COLUMNS)]
    lines += ["| " + " | ".join(str(row[column]) for column in COLUMNS) + " |" for row in rows]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="benchmarks.environments", description=__doc__)
    parser.add_argument("--tasks", nargs="+", choices=NAVIGATION_TASKS, default=[*NAVIGATION_TASKS])
    parser.add_argument("--num-envs", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--steps", type=int, default=50, help="steps per world and round")
    parser.add_argument("--output", type=Path, help="write the rows as CSV, too")
    options = parser.parse_args(arguments)
    rows = []
    for name in options.tasks:
        for sleep in (False, True) if NAVIGATION_TASKS[name].has_box else (False,):
            rows.append(measure_task(name, sleep, options.num_envs, options.rounds, options.steps))
    print(f"MuJoCo {mujoco.__version__}, {options.num_envs} worlds, one thread\n")
    print(markdown(rows))
    for package, peer_ids in PEERS.items():
        if importlib.util.find_spec(package) is None:
            print(f"\n{package}: not installed, not measured")
            continue
        for peer_id in peer_ids:
            print(f"\n{package} {peer_id}: {measure_peer(peer_id, package, 2000):.0f} steps/s")
    if options.output is not None:
        with options.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
