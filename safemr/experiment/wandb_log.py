"""Optional copy of a run's progress to Weights & Biases. The record is the CSV file, never this."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, Self

from safemr.errors import UserError, tell
from safemr.experiment.checkpoints import RunSession

INSTALL = 'install it by `pip install "safemr[wandb]"`'


class WandbLog(contextlib.AbstractContextManager["WandbLog"]):
    """Logs rows to wandb when its mode is ``offline`` or ``online``.

    Runs are grouped by task and algorithm. The first failure, a missing package included, is told
    once and ends the copy; it never ends the run.
    """

    def __init__(
        self, config: Mapping[str, Any], session: RunSession, settings: Mapping[str, str]
    ) -> None:
        self._config, self._session = config, session
        self._mode: Any = settings.get("mode", "disabled")
        self._project = settings.get("project", "safemr")
        self._run: Any = None

    def __enter__(self) -> Self:
        if self._mode != "disabled":
            self._attempt(self._start)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._run is not None:
            self._attempt(lambda: self._run.finish(exit_code=0 if kind is None else 1))

    def log(self, row: Mapping[str, float]) -> None:
        """Copies one progress row."""
        if self._run is not None:
            self._attempt(lambda: self._run.log(dict(row), step=int(row["step"])))

    def _start(self) -> None:
        try:
            import wandb
        except ModuleNotFoundError as error:
            if error.name != "wandb":  # it is there, and broken
                raise
            raise UserError(f"the package is missing; {INSTALL}") from error

        task, seed = self._config["task"]["name"], self._config["seed"]
        # Beside the run's working folder, which is removed when the record is written.
        folder = self._session.work.parents[1] / "wandb"
        folder.mkdir(parents=True, exist_ok=True)
        self._run = wandb.init(
            project=self._project,
            mode=self._mode,
            dir=str(folder),
            group=f"{task}/{self._session.variant}",
            name=f"{task}/{self._session.variant}/seed{seed}",
            id=f"{self._session.digest}-{len(self._session.rows)}",
            config=dict(self._config),
        )
        for row in self._session.rows:
            self._run.log(dict(row), step=int(row["step"]))

    def _attempt(self, action: Callable[[], object]) -> None:
        try:
            action()
        except Exception as error:  # whatever wandb does, training goes on
            reason = str(error).partition("\n")[0]
            tell(f"warning: wandb is off for this run: {reason}")
            self._run = None
