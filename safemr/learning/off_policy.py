"""The off-policy training loop: act, store, update, written once for every off-policy algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch

from safemr.learning.acting import Acting
from safemr.learning.contract import MakeEnvs, check_finite, generator
from safemr.learning.policies import Policy
from safemr.learning.replay import Replay

# Metrics are read off one update in this many: a multiple of every delay in use.
MEASURE_EVERY = 16


class Trainer(Acting):
    """Trains ``agent_type`` (a `safemr.learning.soft_actor_critic.SoftActorCritic`).

    config: the algorithm's Config; make_envs: number of sub-environments -> batched environment;
    total_steps: environment steps of the whole run, which the learning-rate schedules span.
    """

    family: ClassVar[str] = "off_policy"
    agent_type: ClassVar[Any]

    def __init__(self, config: Any, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        super().__init__(config, make_envs, seed, total_steps)
        steps_an_update = config.update_every * self.interface.action_repeat
        updates = max(total_steps - config.start_steps, 0) // steps_an_update
        self.agent = self.agent_type(
            config, self.transform.dim, self.action_dim, self.envs.d_min, seed, updates
        )
        self.replay = Replay(
            max(config.replay_capacity // config.num_envs, config.n_step),
            config.num_envs,
            self.transform.dim,
            self.action_dim,
            self.envs.num_obstacles,
            gamma=config.gamma,
            n_step=config.n_step,
            device=config.device,
        )
        self._sampling = generator(seed, 2)  # rows are drawn on the CPU and looked up on the device
        self._owed = 0.0  # gradient steps earned by experience, not yet done

    def advance(self, until: int) -> dict[str, float]:
        """Trains until at least ``until`` steps; returns the means over the interval."""
        config = self.config
        sums: dict[str, float] = {}
        counts: dict[str, int] = {}
        while self.step < until:
            self.replay.add(**self.interact(self.agent.act))
            if self.step < config.start_steps:
                continue
            self._owed += config.num_envs / config.update_every
            updates = int(self._owed)
            if updates < config.updates_together:
                continue
            self._owed -= updates
            drawn = self.replay.sample(updates * config.batch_size, self._sampling)
            drawn = self.normaliser.batch(drawn)
            done = self.agent.updates
            measure = (done + updates) // MEASURE_EVERY > done // MEASURE_EVERY
            info = self.agent.update(drawn, updates, measure)
            values = {name: float(value) for name, value in info.items()}
            check_finite(self.step, values)
            for name, value in values.items():
                sums[name] = sums.get(name, 0.0) + value
                counts[name] = counts.get(name, 0) + 1
        metrics = {name: total / counts[name] for name, total in sums.items()}
        metrics |= self.agent.metrics()
        check_finite(self.step, metrics)
        return metrics | {f"train_{name}": v for name, v in self.episodes.pop().items()}

    @property
    def policy(self) -> Policy:
        """The current policy with what figures need of the run: lambda's network and zeta."""
        return Policy(
            self.normaliser.settled(self.transform),
            self.agent.policy,
            squash=True,
            extras=self.agent.extras(),
            interface=self.interface,
        )

    def state_dict(self) -> dict[str, Any]:
        return {
            **self.acting_state(),
            "owed": self._owed,
            "agent": self.agent.state_dict(),
            "replay": self.replay.state_dict(),
            "sampling": self._sampling.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._owed = float(state["owed"])
        self.agent.load_state_dict(state["agent"])
        self.replay.load_state_dict(state["replay"])
        self._sampling.set_state(torch.as_tensor(state["sampling"]))
        if not self.load_acting_state(state):
            self.replay.cut()
