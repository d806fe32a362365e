"""One training run from Python: what ``safemr train`` does, with a record as the answer."""

from __future__ import annotations

import argparse
import io
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safemr.errors import tell
from safemr.experiment.record import Record
from safemr.experiment.signals import StopSignals


def train(
    task: str,
    algorithm: str = "safemr",
    *,
    steps: int = 320_000,
    seed: int = 100,
    settings: Mapping[str, Any] | None = None,
    interface: Mapping[str, Any] | None = None,
    task_name: str | None = None,
    variant: str | None = None,
    out: Path | str = "results",
    log_points: int = 20,
    eval_episodes: int = 10,
    eval_seed: int | None = None,
    quiet: bool = False,
    **hyperparameters: Any,
) -> Record:
    """Train one run and return its record; one that is there is not trained again.

    Everything is as for ``safemr train``, hence a run that was interrupted continues.

    Args:
        task: A task of this package, or Gymnasium's id of an environment from outside
            (``my_package:MyTask-v0``, docs/your-own.md).
        algorithm: One of those that ``safemr list`` names.
        steps: Environment steps.
        settings: Of the environment; for one from outside also ``d_min``, ``num_obstacles`` and
            ``vectorization``.
        interface: How the learner meets it, as in a configuration (docs/environments.md).
        task_name: What a task with settings of its own is called.
        variant: The label of the run; the algorithm's name where none is given.
        out: The results root.
        hyperparameters: Of the algorithm (``safemr list ALGORITHM``).

    Raises:
        UserError: for what can be mended, in one line.
        TrainingDivergedError: a quantity stopped being finite.
        KeyboardInterrupt: it was interrupted; the same call continues from the last log point.
    """
    from safemr.experiment import train as program
    from safemr.experiment.checkpoints import RunSession  # torch, seconds
    from safemr.learning.contract import TrainingDivergedError

    parts = {"task.": settings or {}, "interface.": interface or {}, "": hyperparameters}
    arguments = argparse.Namespace(
        task=task,
        task_name=task_name,
        algorithm=algorithm,
        seed=seed,
        steps=steps,
        set=[(f"{prefix}{name}", value) for prefix, part in parts.items()
             for name, value in part.items()],
        log_points=log_points,
        eval_episodes=eval_episodes,
        eval_seed=eval_seed,
        resolved=None,
        variant=variant,
    )  # fmt: skip
    config, label = program.resolve(arguments)
    stream = io.StringIO() if quiet else sys.stderr
    # Only the main thread may handle signals; elsewhere those of the program stand.
    main = threading.current_thread() is threading.main_thread()
    with RunSession(config, label, Path(out), signals=None if main else StopSignals()) as session:
        if session.complete:
            tell(f"{label}: already recorded in {session.folder}", stream)
        else:
            try:
                program.train(
                    config, session, label=f"{label} {config['task']['name']}", stream=stream
                )
            except TrainingDivergedError as error:
                session.fail(str(error))
                raise
            except SystemExit as error:  # of a session that a signal ended
                raise KeyboardInterrupt from error
    return Record.open(session.folder)
