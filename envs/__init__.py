"""Environments of the reproduction, registered with Gymnasium on import.

Navigation: `Pillars-0.15-Goal-v0`, `Pillars-0.30-Goal-v0`, `Hazards-0.15-Push-v0` and
`Hazards-0.30-Push-v0`, for `gymnasium.make` and for `gymnasium.make_vec` with
`vectorization_mode="vector_entry_point"`. `PointGoal1-v0`, in the same ways, is Safety Gym's, for
comparison with published results. See docs/environments.md.

Two aircraft: `Aircraft-v0`. See docs/aircraft.md.
"""

from __future__ import annotations

import gymnasium

from envs.aircraft import MAX_EPISODE_STEPS
from envs.tasks import REGISTERED_TASKS

for _task in REGISTERED_TASKS.values():
    gymnasium.register(
        id=f"{_task.name}-v0",
        entry_point="envs.navigation:NavigationEnv",
        vector_entry_point="envs.navigation:NavigationVectorEnv",
        max_episode_steps=_task.max_episode_steps,
        kwargs={"task": _task.name},
    )

gymnasium.register(
    id="Aircraft-v0",
    entry_point="envs.aircraft:AircraftEnv",
    vector_entry_point="envs.aircraft:AircraftVectorEnv",
    max_episode_steps=MAX_EPISODE_STEPS,
)
