"""How often a trained policy breaks its certificate's constraint, and how often needlessly.

The constraint is between two states a decision apart, so decisions are what is counted: actions,
each held for as many control steps as the policy says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr.certificates.energy import constraint, largest
from safemr.certificates.falsification import make_simulator, simulated_grid
from safemr.certificates.families import Parameters, phi_at
from safemr.environments import info_of
from safemr.learning.evaluation import Acts
from safemr.learning.interface import Interface
from safemr.tasks import Task


@dataclass(frozen=True)
class PolicyCheck:
    """How often a policy violated Eq. cstr0, and how often it need not have."""

    decisions: int
    violating: int  # decisions with g >= 0
    examined: int  # violating decisions whose action grid was searched
    avoidable: int  # of these: a safe action existed

    @property
    def violating_share(self) -> float:
        return self.violating / self.decisions

    @property
    def avoidable_share(self) -> float:
        """Share of all decisions that picked a violating action although a safe one existed."""
        return self.violating_share * self.avoidable / self.examined if self.examined else 0.0


def check_policy(
    policy: Acts,
    task: Task,
    zeta: Parameters,
    *,
    eta: float = 0.0,
    num_envs: int = 32,
    steps: int = 1000,
    seed: int = 0,
    limit: int = 256,
    action_scale: Sequence[float] = (),
) -> PolicyCheck:
    """Run the deterministic policy and search its violating decisions for a safe action.

    steps: control steps of each of ``num_envs`` worlds. At most `limit` of the violating decisions,
    a seeded sample, are searched, in the simulator: `action_grid` within ``action_scale``, held as
    long as the policy's own actions. A decision that the end of an episode cuts short is not
    counted: nothing that is held as long can be compared with it.
    """
    interface = Interface(getattr(policy, "action_repeat", 1))
    envs = interface.around(make_simulator(task, num_envs))
    observations, infos = envs.reset(seed=seed)
    gyro = envs.observation_layout["gyro"]
    found: list[tuple[dict[str, NDArray[Any]], float, float]] = []
    total = 0
    for _ in range(interface.decisions(steps)):
        before = envs.get_state()["worlds"]
        phi = largest(phi_at(infos["d"], infos["d_dot"], envs.d_min, zeta))
        turn_rates = observations[:, gyro][:, 2]
        observations, _, terminated, truncated, infos = envs.step(policy.act(observations))
        reached = {name: infos[name].copy() for name in ("d", "d_dot")}
        done = terminated | truncated
        for name in reached if done.any() else ():
            reached[name][done] = infos["final_info"][name][done]
        phi_next = largest(phi_at(reached["d"], reached["d_dot"], envs.d_min, zeta))
        whole = np.full(num_envs, info_of(infos, "control_steps") == interface.action_repeat)
        total += int(whole.sum())
        for index in np.flatnonzero(whole & (constraint(phi, phi_next, eta) >= 0)):
            world = {name: array[index] for name, array in before.items()}
            found.append((world, turn_rates[index], phi[index]))
    envs.close()
    chosen = np.random.default_rng(seed).permutation(len(found))[:limit]
    if not len(chosen):
        return PolicyCheck(total, 0, 0, 0)
    simulator = make_simulator(task)
    worlds = {name: np.stack([found[i][0][name] for i in chosen]) for name in found[0][0]}
    rates, phis = (np.array([found[i][column] for i in chosen]) for column in (1, 2))
    held = (interface.action_repeat, action_scale)
    g = simulated_grid(simulator, worlds, rates, phis, zeta, eta, *held)[1]
    simulator.close()
    return PolicyCheck(total, len(found), len(chosen), int((g.min(1) < 0).sum()))
