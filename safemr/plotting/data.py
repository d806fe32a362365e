"""Rollout data on disk: dictionaries of numeric arrays as `.npz`, made by `safemr.rollouts`."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from safemr import atomic
from safemr.errors import UserError

Arrays = Mapping[str, NDArray[Any]]

# Attributes of the environment's task that drawings use; stored beside the tracks.
GEOMETRY = ("obstacle_size", "d_min", "goal_size", "extent", "solid_obstacles")


def scene_at(data: Arrays, episode: int, step: int) -> SimpleNamespace:
    """One moment of `rollouts.episodes`, with the attributes of the environment's own scene."""
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


def save(path: Path | str, arrays: Arrays) -> None:
    """Write a compressed `.npz` without pickled objects; it appears whole or not at all."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    with atomic.replacing(Path(path), durable=False) as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def load(path: Path | str) -> Arrays:
    """The arrays of `save`. Raises UserError for anything else."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} is not readable rollout data: {error}") from error


def below(arrays: Arrays, prefix: str) -> Arrays:
    """The arrays whose names begin with `prefix`, under what follows it."""
    return {
        name.removeprefix(prefix): values
        for name, values in arrays.items()
        if name.startswith(prefix)
    }
