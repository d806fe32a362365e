"""Safety-Gymnasium's Goal and Push tasks for `safemr`, simulated by another Python (README.md)."""

import gymnasium

ROBOTS = ("Point", "Car", "Racecar", "Doggo", "Ant")
TASKS = ("Goal1", "Goal2", "Push1", "Push2")

for _robot in ROBOTS:
    for _task in TASKS:
        gymnasium.register(
            id=f"Safety{_robot}{_task}-v0",
            entry_point="safety_bridge.world:SafetyWorld",
            vector_entry_point="safety_bridge.batch:SafetyBatch",
            max_episode_steps=1000,
            kwargs={"name": f"Safety{_robot}{_task}-v0"},
        )
