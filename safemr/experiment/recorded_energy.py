"""What a record says of its energy function, and whether sigma, k and n are all of it.

Every off-policy algorithm logs its zeta and keeps it in ``policy.npz``. Where phi is more than that
(a network corrects it), whoever read these three numbers alone would measure another function.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

from safemr.errors import UserError
from safemr.files import POLICY, policy_arrays

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
