"""Recorded episodes as arrays: made by `safemr.measure.trajectories`, read by drawings."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from safemr.files import Arrays

# Attributes of the environment's task that drawings use; stored beside the tracks.
GEOMETRY = ("obstacle_size", "d_min", "goal_size", "extent", "solid_obstacles")


def scene_at(data: Arrays, episode: int, step: int) -> SimpleNamespace:
    """One moment of `trajectories.episodes`, with the attributes of the environment's own scene."""
    box = data["box"][step, episode]
    vase = data["vase"][step, episode] if "vase" in data else None
    return SimpleNamespace(
        task=SimpleNamespace(**{name: data[name].item() for name in GEOMETRY}),
        robot=data["robot"][step, episode],
        goal=data["goal"][step, episode],
        obstacles=data["obstacles"][episode],
        box=None if np.isnan(box).any() else box,
        vase=vase,
    )


def below(arrays: Arrays, prefix: str) -> Arrays:
    """The arrays whose names begin with `prefix`, under what follows it."""
    return {
        name.removeprefix(prefix): values
        for name, values in arrays.items()
        if name.startswith(prefix)
    }
