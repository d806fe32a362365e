"""Episode statistics of a batched environment, the same in training and in evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr.environments import info_of

# Sums over an episode: metric name -> key of the environment's info, which may be an optional one.
_INFO_SUMS = {
    "cost": "cost",
    "cost_indicator": "cost_indicator",
    "cost_contact": "cost_contact",
    "goals": "goal_met",
    "reward_approach": "reward_approach",
    "reward_push": "reward_push",
    "reward_goal": "reward_goal",
}


class EpisodeStatistics:
    """Accumulates undiscounted sums per sub-environment and averages over finished episodes.

    Metrics (means over the episodes finished since the last `pop`; nan when there was none):
    ``return``, ``cost`` (the authors'), ``cost_indicator``, ``cost_contact``, ``goals``,
    ``reward_approach``, ``reward_push``, ``reward_goal``, ``length`` [control steps],
    ``zero_violation_share`` (share of episodes without a single violating step),
    ``violation_rate`` (violating steps / steps) and ``episodes`` (their number).
    """

    def __init__(self, num_envs: int) -> None:
        self._names = ("return", *_INFO_SUMS, "length")
        self._running = np.zeros((len(self._names), num_envs))
        self._finished: list[NDArray[np.float64]] = []

    def update(
        self,
        rewards: NDArray[np.floating],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        infos: Mapping[str, Any],
        counted: NDArray[np.bool_] | None = None,
    ) -> None:
        """Adds one batched step; ``counted`` masks sub-environments that still count."""
        running = self._running
        running[0] += rewards
        for row, key in enumerate(_INFO_SUMS.values(), start=1):
            running[row] += info_of(infos, key)
        running[-1] += info_of(infos, "control_steps")
        done = terminated | truncated
        if done.any():
            keep = done if counted is None else done & counted
            self._finished.extend(running[:, keep].T.copy())
            running[:, done] = 0.0

    @property
    def finished(self) -> NDArray[np.float64]:
        """[episodes, metrics] sums of the finished episodes, columns in the order of `names`."""
        return np.array(self._finished).reshape(-1, len(self._names))

    @property
    def names(self) -> tuple[str, ...]:
        return self._names

    def pop(self) -> dict[str, float]:
        """Averages over the episodes finished since the last call, and forgets them."""
        table = self.finished
        self._finished = []
        if len(table) == 0:
            nan = float("nan")
            empty = dict.fromkeys(self._names, nan)
            return {**empty, "zero_violation_share": nan, "violation_rate": nan, "episodes": 0.0}
        means = {name: float(value) for name, value in zip(self._names, table.mean(0), strict=True)}
        violations = table[:, self._names.index("cost_indicator")]
        return {
            **means,
            "zero_violation_share": float((violations == 0).mean()),
            "violation_rate": float(violations.sum() / table[:, -1].sum()),
            "episodes": float(len(table)),
        }

    def abandon(self) -> None:
        """Forgets the running episodes, which nobody will finish."""
        self._running[:] = 0.0

    def state_dict(self) -> dict[str, Any]:
        return {"running": self._running.copy(), "finished": self.finished}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._running = np.array(state["running"])
        self._finished = list(np.array(state["finished"]))
