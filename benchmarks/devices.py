"""Updates a second of SafeMR on this machine's devices, by the networks' width and the batch.

    python -m benchmarks.devices [--widths 64 256 1024] [--batches 256 4096] [--blocks 5]
        [--output FILE.csv]

An update is all of Algorithm 1: targets, critics, and with their delays policy, multiplier and
zeta, on random transitions with the shapes of Pillars-0.15-Goal (39 observations, 2 actions, 4
obstacles). The CPU has one thread, as in training. Times are wall time, after the
device has finished; the variants take turns block by block and the table shows medians.
"""

from __future__ import annotations

import argparse
import csv
import platform
import time
from pathlib import Path
from statistics import median

import torch

from safemr.algorithms import safemr
from safemr.experiment.provenance import cpu_model
from safemr.learning.replay import Batch

OBSERVATIONS, ACTIONS, OBSTACLES, PARTS = 39, 2, 4, 4
COLUMNS = ("width", "batch", "variant", "updates_per_s")


def transitions(count: int, device: str) -> Batch:
    """Random ones, as many as ``PARTS`` updates need."""
    random = torch.Generator().manual_seed(0)

    def uniform(*shape: int, low: float = -1.0, high: float = 1.0) -> torch.Tensor:
        values = torch.rand((PARTS * count, *shape), generator=random)
        return (low + (high - low) * values).to(device)

    return Batch(
        observations=uniform(OBSERVATIONS),
        actions=uniform(ACTIONS),
        returns=uniform(),
        discounts=torch.full((PARTS * count,), 0.95, device=device),
        bootstraps=uniform(OBSERVATIONS),
        costs=uniform(low=0.0),
        d=uniform(OBSTACLES, low=0.2, high=1.5),
        d_dot=uniform(OBSTACLES),
        d_next=uniform(OBSTACLES, low=0.2, high=1.5),
        d_dot_next=uniform(OBSTACLES),
    )


def variants() -> dict[str, tuple[str, str]]:
    """Name -> device and backend; the CPU's always, a GPU's where there is one."""
    found = {"CPU, fused": ("cpu", "fused"), "CPU, torch": ("cpu", "torch")}
    if torch.cuda.is_available():
        found[torch.cuda.get_device_name()] = ("cuda", "torch")
    return found


def rate(agent: safemr.Agent, batch: Batch, seconds: float) -> float:
    """Updates a second, measured for about ``seconds``."""
    on_gpu = agent.config.device != "cpu"
    begin, done = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        agent.update(batch, PARTS)
        done += PARTS
        if on_gpu and done % (8 * PARTS) == 0:
            torch.cuda.synchronize()
    if on_gpu:
        torch.cuda.synchronize()
    return done / (time.perf_counter() - begin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--widths", type=int, nargs="+", default=[64, 256, 1024])
    parser.add_argument("--batches", type=int, nargs="+", default=[256, 4096])
    parser.add_argument("--blocks", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=0.5, help="of a block")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{cpu_model()}, Python {platform.python_version()}, PyTorch {torch.__version__}")
    rows = []
    for width in arguments.widths:
        for batch in arguments.batches:
            agents, data = {}, {}
            for name, (device, backend) in variants().items():
                config = safemr.Config(
                    hidden=width, batch_size=batch, device=device, backend=backend
                )
                agents[name] = safemr.Agent(config, OBSERVATIONS, ACTIONS, 0.25, 0, 10**7)
                data[name] = transitions(batch, device)
                rate(agents[name], data[name], 0.0)  # compiles, and fills the moments
            measured: dict[str, list[float]] = {name: [] for name in agents}
            for _ in range(arguments.blocks):
                for name, agent in agents.items():
                    measured[name].append(rate(agent, data[name], arguments.seconds))
            rows += [(width, batch, name, median(found)) for name, found in measured.items()]
    print("| width | batch | variant | updates/s |", "|---|---|---|---|", sep="\n")
    for width, batch, name, found in rows:
        print(f"| {width} | {batch:,} | {name} | {found:,.0f} |")
    if arguments.output:
        with arguments.output.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerows([COLUMNS, *rows])


if __name__ == "__main__":
    main()
