"""PID-Lagrangian: proximal policy optimisation whose multiplier a PID controller sets.

Stooke, Achiam & Abbeel, "Responsive safety in reinforcement learning by PID Lagrangian methods"
(arXiv:2007.03964), Algorithm 2. Dual ascent is integral control, which answers late and overshoots;
a proportional and a derivative term damp it. The policy's steps are those of PPO-Lagrangian.

| equation | function |
|---|---|
| lambda = (K_P D + K_I I + K_D d)_+ with D = J_C - d_limit | `Controller.update` |
| I <- (I + D)_+, d = (J_C - J_C,previous)_+ | `Controller.update` |
| (surrogate - lambda cost surrogate) / (1 + lambda) | `safemr.learning.lagrange.penalised` |

Differences: the derivative is that of one epoch, not of several, and lambda has a largest value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from safemr.algorithms import ppo_lagrangian
from safemr.learning.contract import MakeEnvs

VERSION = 1

_NO_ASCENT = "a controller sets the multiplier, which has no optimiser"


@dataclass(frozen=True)
class Config(ppo_lagrangian.Config):
    """PPO-Lagrangian's hyperparameters and the gains, per unit of an episode's cost."""

    k_p: float = 0.02  # proportional gain
    k_i: float = 0.002  # integral gain, an epoch
    k_d: float = 0.02  # derivative gain, of a rise of the cost from one epoch to the next
    smoothing: float = 0.5  # share of the past in the averages that P and D see
    multiplier_max: float = 100.0  # largest lambda

    RANGES: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(("k_p", "k_i", "k_d"), "[0, 1000]"),
        "smoothing": "[0, 1)",
        "multiplier_max": "(0, 1e6]",
    }
    UNUSED: ClassVar[Mapping[str, str]] = dict.fromkeys(
        ("multiplier_initial", "multiplier_lr", "multiplier_optimizer"), _NO_ASCENT
    )


class Controller:
    """lambda >= 0 from the costs of episodes; stands where PPO-Lagrangian has its multiplier."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.value, self.integral = 0.0, 0.0
        self.error: float | None = None  # the averages, None before the first epoch
        self.cost: float | None = None

    def update(self, episode_cost: float, cost_limit: float) -> None:
        """One control step after an epoch with this mean cost of an episode."""
        config, error = self.config, episode_cost - cost_limit
        cost_before = episode_cost if self.cost is None else self.cost
        self.error = self._averaged(self.error, error)
        self.cost = self._averaged(self.cost, episode_cost)
        self.integral = max(self.integral + error, 0.0)
        rise = max(self.cost - cost_before, 0.0)
        wanted = config.k_p * self.error + config.k_i * self.integral + config.k_d * rise
        self.value = min(max(wanted, 0.0), config.multiplier_max)

    def _averaged(self, before: float | None, value: float) -> float:
        past = self.config.smoothing
        return value if before is None else past * before + (1.0 - past) * value

    def state_dict(self) -> dict[str, Any]:
        names = ("value", "integral", "error", "cost")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)


class Trainer(ppo_lagrangian.Trainer):
    """PPO-Lagrangian's trainer with a `Controller`."""

    config: Config

    def __init__(self, config: Config, make_envs: MakeEnvs, seed: int, total_steps: int) -> None:
        super().__init__(config, make_envs, seed, total_steps)
        self.multiplier: Any = Controller(config)
