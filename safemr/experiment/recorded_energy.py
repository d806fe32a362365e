"""What a record says of its energy function, and whether sigma, k and n are all of it.

Every off-policy algorithm logs its zeta and keeps it in ``policy.npz``. Where phi is more than that
(a network corrects it), whoever read these three numbers alone would measure another function.
"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from safemr.errors import UserError
from safemr.experiment.records import CONFIG, POLICY, policy_arrays

if TYPE_CHECKING:
    import pandas as pd

    from envs.aircraft import AircraftDynamics
    from safemr.learning.policies import Policy

NEURAL = ("neural_safemr",)  # algorithms whose zeta is the fixed part of a neural energy function
NETWORK = "certificate_parameters"  # the array of a policy file that only such runs have


def require_zeta(
    folder: Path, config: Mapping[str, Any], arrays: Container[str] | None = None
) -> None:
    """Raises UserError where the record's energy function is not that of its sigma, k and n.

    arrays: the names in its policy file, where they are known already.
    """
    name = config["algorithm"]["name"]
    if arrays is None and (folder / POLICY).is_file():
        arrays = policy_arrays(folder / POLICY)
    if name in NEURAL or NETWORK in (arrays or ()):
        raise UserError(
            f"{folder}: the energy function of {name} is a network beside a fixed [sigma, k, n], "
            "so these three say nothing of it; its unsafe set is measured on the aircraft "
            "(docs/aircraft.md), its fixed part with safemr certify --sigma --k --n"
        )


@dataclass(frozen=True)
class Saved:
    """What a record says of its certificate."""

    folder: Path
    zeta: NDArray[np.float64]  # [3] in units of length_scale
    length_scale: float  # [m]
    eta: float

    def policy(self) -> Policy:
        from safemr.learning.policies import (
            load_policy,  # torch, which kept measurements do not need
        )

        return load_policy(self.folder)


def learners(
    root: Path,
    runs: pd.DataFrame,
    dynamics: AircraftDynamics,
    needed: Sequence[str] = ("zeta", "length_scale"),
) -> Sequence[tuple[Any, Saved]]:
    """(run, what is saved of its certificate) of every record.

    Raises UserError naming every record whose policy file lacks an array of ``needed``, or one that
    flew in other traffic than ``dynamics``, or whose phi is a network that is not ``needed``.
    """
    from safemr.aircraft.unsafe_sets import (
        dynamics_of,  # a simulator, which the workflow's rules do not need
    )

    found, lacking = [], []
    for run in runs.itertuples():
        folder = root / str(run.folder)
        if not (folder / POLICY).is_file():
            lacking.append(str(run.folder))
            continue
        arrays = policy_arrays(folder / POLICY)
        if not set(needed) <= arrays.keys():
            lacking.append(str(run.folder))
            continue
        config = json.loads((folder / CONFIG).read_text())
        if (flown := dynamics_of(config["task"])) != dynamics:
            raise UserError(
                f"{folder} flew with other_turn = {flown.other_turns[0]:g}, the true unsafe set is "
                f"that of {dynamics.other_turns[0]:g}: compare it with that of its own task"
            )
        if NETWORK not in needed:
            require_zeta(folder, config, arrays)
        saved = Saved(
            folder=folder,
            zeta=arrays["zeta"].astype(float),
            length_scale=float(arrays["length_scale"]),
            eta=float(config["algorithm"]["hyperparameters"]["eta"]),
        )
        found.append((run, saved))
    if lacking:
        raise UserError(
            f"no {POLICY} with {' and '.join(needed)} in {', '.join(lacking)} under "
            f"{root}: take them out of aircraft.algorithms, or train them again"
        )
    return found
