"""The public face: what a program or a notebook outside this repository needs.

load             a record: its policy, its certificate, its progress
load_policy      the trained policy of a record, to act with
read_records     all records under a results root as tables
evaluate_record  a recorded policy on layouts of its task
make_envs        a batched environment of a task
SafetyFilter     a wrapper of Gymnasium that keeps actions within a certificate
filter_actions   the same without an environment
EnergyCertificate, Zeta  the paper's family of certificates, and its sigma, k and n
train            one run on a task of this package or on an environment from outside
UserError        what all of them raise where the user can fix it

Each is imported when it is first asked for: `import safemr` itself costs nothing. Within the
repository a name is imported from its module, where `safemr.experiment.sources` sees it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from safemr.certificates.certificate import EnergyCertificate
    from safemr.errors import UserError
    from safemr.experiment.loaded import load
    from safemr.experiment.records import read_records
    from safemr.experiment.runs import train
    from safemr.filters.filter import filter_actions
    from safemr.filters.wrapper import SafetyFilter
    from safemr.learning.policies import load_policy
    from safemr.measure.evaluate import evaluate_record
    from safemr.paper import Zeta
    from safemr.tasks import make_envs

__all__ = [
    "EnergyCertificate",
    "SafetyFilter",
    "UserError",
    "Zeta",
    "evaluate_record",
    "filter_actions",
    "load",
    "load_policy",
    "make_envs",
    "read_records",
    "train",
]

_HOMES = {
    "EnergyCertificate": "safemr.certificates.certificate",
    "SafetyFilter": "safemr.filters.wrapper",
    "UserError": "safemr.errors",
    "Zeta": "safemr.paper",
    "evaluate_record": "safemr.measure.evaluate",
    "filter_actions": "safemr.filters.filter",
    "load": "safemr.experiment.loaded",
    "load_policy": "safemr.learning.policies",
    "make_envs": "safemr.tasks",
    "read_records": "safemr.experiment.records",
    "train": "safemr.experiment.runs",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
