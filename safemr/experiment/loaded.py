"""``safemr.load(folder)``: a record as another program uses it."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safemr.certificates.bound import BoundCertificate
from safemr.environments import SafetyEnvs
from safemr.experiment.record import Record
from safemr.tasks import make_envs

if TYPE_CHECKING:
    from safemr.learning.policies import Policy


@dataclass(frozen=True)
class Loaded:
    """A verified record, whose parts are read when they are first asked for.

    ``record`` is the record itself, as the pipeline opens it.
    """

    record: Record

    @property
    def folder(self) -> Path:
        return self.record.folder

    @property
    def name(self) -> str:
        """The run among others of its task: ``SafeMR (seed 0)``."""
        return self.record.name

    @property
    def config(self) -> Mapping[str, Any]:
        """The resolved configuration of the run."""
        return self.record.config

    @property
    def progress(self) -> Sequence[Mapping[str, float]]:
        """The logged rows, the last one being the end of training."""
        return self.record.rows

    @functools.cached_property
    def policy(self) -> Policy:
        """The trained policy: ``policy(observation)`` is the environment's action.

        Each is to be held for ``policy.action_repeat`` control steps. Raises UserError where the
        record holds none.
        """
        return self.record.policy()

    @functools.cached_property
    def certificate(self) -> BoundCertificate:
        """The certificate that the run ended with, for the d_min of its task.

        Raises UserError where its algorithm has none.
        """
        certificate = self.record.certificate()
        envs = self.make_envs(1)
        try:
            return BoundCertificate(certificate, float(envs.d_min))
        finally:
            envs.close()

    def make_envs(self, num_envs: int = 1) -> SafetyEnvs:
        """A batch of the run's task, control step by control step."""
        return make_envs(self.record.task, num_envs)


def load(folder: Path | str) -> Loaded:
    """The record in ``folder``, verified.

    Raises:
        UserError: there is none, or one that must not be believed; with the repair.
    """
    return Loaded(Record.open(folder))
