"""What every training loop offers, so that records, resuming and evaluation exist once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
import torch

from safemr.environments import SafetyEnvs
from safemr.learning.policies import Policy

MakeEnvs = Callable[[int], SafetyEnvs]  # from the number of sub-environments

# What is larger counts as infinite: a loss, gradient norm, value, temperature or multiplier, and a
# parameter of the policy. The largest of the recorded runs are 844 and 4.7; a squared error of
# values that have grown to 1 / (1 - gamma) = 1,000 is 1e6.
LARGEST_METRIC = 1e8
LARGEST_PARAMETER = 1e4
# Ratios by quantities that may vanish, dual variables of nearly empty sets, and counts.
_UNBOUNDED = ("explained_variance", "kl_multiplier", "cost_multiplier", "updates")


class TrainingDivergedError(RuntimeError):
    """A quantity of the training became infinite, not a number or absurdly large.

    Attributes: ``step`` (environment steps done), ``quantity`` (its name) and ``value``.
    """

    def __init__(self, step: int, quantity: str, value: float) -> None:
        super().__init__(f"{quantity} became {value} at step {step}")
        self.step, self.quantity, self.value = step, quantity, value


class Trainer(Protocol):
    """A resumable training run of one algorithm with one seed."""

    family: ClassVar[str]
    step: int

    def __init__(self, config: Any, make_envs: MakeEnvs, seed: int, total_steps: int) -> None: ...

    def advance(self, until: int) -> dict[str, float]:
        """Trains until at least ``until`` environment steps; returns the interval's metrics.

        Raises TrainingDivergedError.
        """
        ...

    @property
    def policy(self) -> Policy: ...

    def state_dict(self) -> dict[str, Any]:
        """Everything needed to continue bit for bit: tensors, arrays and plain types only."""
        ...

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes over a `state_dict`, of arrays also the order in memory (``np.array(x)`` keeps it,
        ``x.copy()`` does not): products with them must round as before."""
        ...


def check_finite(step: int, metrics: Mapping[str, float], allowed: tuple[str, ...] = ()) -> None:
    """Raises TrainingDivergedError for the first metric that is not finite, or is absurdly large.

    Episode statistics (``allowed`` prefixes) are nan in an interval without a finished episode.
    """
    for name, value in metrics.items():
        if name.startswith(allowed or ("train_",)):
            continue
        largest = math.inf if name.startswith(_UNBOUNDED) else LARGEST_METRIC
        if not np.isfinite(value) or abs(value) > largest:
            raise TrainingDivergedError(step, name, value)


def check_parameters(step: int, parameters: torch.Tensor) -> None:
    """Raises TrainingDivergedError where a policy's parameter is not finite or absurdly large."""
    largest = float(parameters.detach().abs().max())
    if not largest <= LARGEST_PARAMETER:
        raise TrainingDivergedError(step, "policy_parameters", largest)


def generator(seed: int, stream: int, device: str = "cpu") -> torch.Generator:
    """A torch generator for one purpose (``stream``) of a run, independent of all others."""
    (word,) = np.random.SeedSequence([seed, stream]).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(word >> np.uint64(1)))


def process_seed(seed: int, kind: int, index: int, life: int) -> int:
    """Seed of one of a run's processes; ``life`` counts how often it was started."""
    (word,) = np.random.SeedSequence([seed, kind, index, life]).generate_state(1, np.uint64)
    return int(word)


def environment_seed(seed: int, stream: int) -> int:
    """Seed of a run's first sub-environment; ``stream`` is that of a purpose, as in `generator`.

    Sub-environment i gets this plus i, so the seeds of neighbouring runs (0, 1, 2, ...) themselves
    would give them almost the same layouts.
    """
    (word,) = np.random.SeedSequence([seed, stream]).generate_state(1)
    return int(word >> 1)
