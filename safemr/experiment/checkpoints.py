"""Interrupted runs: checkpoints, and the session that a training program works in.

Everything unfinished lives in ``<results root>/.work/<digest>/``, which no Snakemake rule declares,
so that a failed or killed job cannot take it away; it is removed when the record is written.

    with RunSession(config, variant, root) as session:
        if not session.complete:
            state = session.resume()
            ...
            session.record(row)
            session.maybe_checkpoint(trainer.state_dict)
            ...
            session.finish(policy_arrays)
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch

from safemr import files, packages
from safemr.errors import UserError, tell
from safemr.experiment import provenance, records
from safemr.experiment.begun import ATTEMPTS as ATTEMPTS
from safemr.experiment.begun import LOCK as LOCK
from safemr.experiment.begun import read_attempts as read_attempts
from safemr.experiment.locks import ProcessLock
from safemr.experiment.signals import StopSignals

CHECKPOINT = "checkpoint.pt"
SHARE = 0.02  # the largest share of the run time that checkpoints may take
# Of checkpoint files: those before 2 did not keep the order of arrays in memory.
FORMAT, _FORMAT_KEY = 2, "format"
_ARRAY = "numpy.ndarray"  # the key that marks an encoded NumPy array


def encode(value: Any, where: str = "state") -> Any:
    """Nested containers of arrays and plain values as what ``torch.load(weights_only=True)`` reads.

    NumPy arrays become tensors that share their memory, under a marking key. The order of an array
    or tensor in memory is part of the state, because products round differently in another order:
    strides are kept. What shows a part of a larger memory is copied, densely and in the order of
    its axes, because torch saves the memory and not the part.

    Raises:
        TypeError: naming the entry that is neither an array nor a plain value.
    """
    if isinstance(value, np.ndarray):
        if any(stride < 0 or stride % value.itemsize for stride in value.strides):
            value = np.array(value)  # torch has no such strides
        return {_ARRAY: _dense(torch.from_numpy(value))}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        return {key: encode(item, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        items = (encode(item, f"{where}[{index}]") for index, item in enumerate(value))
        return type(value)(items)
    if isinstance(value, torch.Tensor):
        return _dense(value)
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"{where} is a {type(value).__name__}, which a checkpoint cannot hold")


def _dense(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor, or a copy that keeps its axes' order, where its memory holds more than it."""
    whole = tensor.untyped_storage().nbytes() == tensor.nbytes
    return tensor if whole else tensor.clone(memory_format=torch.preserve_format)


def decode(value: Any) -> Any:
    """The inverse of `encode`."""
    if isinstance(value, dict):
        if value.keys() == {_ARRAY}:
            return value[_ARRAY].numpy()
        return {key: decode(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(decode(item) for item in value)
    return value


def save(path: Path, content: Mapping[str, Any]) -> None:
    """Write a checkpoint as a whole and durably; after a failure the previous one is untouched."""
    with files.replacing(path) as stream:
        torch.save({_FORMAT_KEY: FORMAT, **encode(content)}, stream)


def load(path: Path) -> dict[str, Any]:
    """Read what `save` wrote. Only tensors and plain values are accepted, so no code can run."""
    try:
        content = decode(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # every damage has its own exception inside torch
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UserError(f"{path} is not a readable checkpoint: {reason}") from error
    if not isinstance(content, dict):
        raise UserError(f"{path} is not a checkpoint of a run")
    if content.pop(_FORMAT_KEY, 1) != FORMAT:
        raise UserError(f"{path} was written by another version of this program")
    return content


def _outside(algorithm: Mapping[str, Any]) -> dict[str, Any]:
    """Where an algorithm and its family of energy functions come from, if from other packages."""
    family = str(algorithm.get("hyperparameters", {}).get("family", ""))
    found = {"algorithm": algorithm["name"]} if "package" in algorithm else {}
    found |= {"family": family} if packages.is_outside(family) else {}
    return {part: packages.provenance(name) for part, name in found.items()}


class RunSession(contextlib.AbstractContextManager["RunSession"]):
    """The life of one training run across interruptions.

    Args:
        config: The resolved run configuration (`safemr.experiment.config`).
        variant: The label of the run in figures and tables.
        root: The results root.
        wait: When another process works on the same run, wait for it instead of failing.
        die_with_parent: Stop, with a checkpoint, when the parent process (Snakemake) is gone.
        minimum_interval: Seconds between checkpoints at least; they are rarer where writing one
            takes long: one is due when, at the mean cost of those before, all of them together
            stay within 2% of the time.
        signals: The handlers of a program that has its own; otherwise the session installs them.
            A signal ends what has not begun to train at once, what trains with a checkpoint at the
            next log point, and has no effect on a run that is recorded.

    Attributes:
        folder: The record's folder.
        rows: The progress rows so far.
        complete: Whether the record was already there, in which case nothing is left to do.
    """

    def __init__(
        self,
        config: Mapping[str, Any],
        variant: str,
        root: Path,
        *,
        wait: bool = False,
        die_with_parent: bool = False,
        minimum_interval: float = 60.0,
        signals: StopSignals | None = None,
    ) -> None:
        self.config, self.variant = config, variant
        self.digest = records.config_digest(config)
        self.folder = root / records.record_path(config, variant)
        self.work = root / ".work" / self.digest
        self.rows: list[dict[str, float]] = []
        self.complete = False
        self._wait, self._minimum_interval = wait, minimum_interval
        self._lock = ProcessLock(self.work / LOCK, f"trains the run {self.digest}")
        self._parent = os.getppid() if die_with_parent else None
        self._signals = signals or StopSignals()
        self._own_signals = signals is None
        self._opened = contextlib.ExitStack()
        self._earlier = {"wall_s": 0.0, "cpu_s": 0.0}
        self._started = time.monotonic()
        self._due = self._started + minimum_interval
        self._outside = _outside(config["algorithm"])  # before it is imported and edited meanwhile
        self._costs: list[float] = []  # seconds of each checkpoint written
        self._saved = 0  # the step of the last checkpoint

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as opened:
            if self._own_signals:
                opened.enter_context(self._signals)
            self._lock.acquire(wait=self._wait, while_waiting=self._stop_waiting)
            opened.callback(self._lock.release)
            # What was waited for was another process's time, which its checkpoints count.
            self._started = time.monotonic()
            self._due = self._started + self._minimum_interval
            self._remove_temporary_files()
            self.complete = records.is_complete(self.folder)
            if self.complete:
                self._signals.ignore()
            self._opened = opened.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with self._opened:
            if self.complete:
                shutil.rmtree(self.work, ignore_errors=True)

    def resume(self) -> dict[str, Any] | None:
        """The trainer state of the last checkpoint, or None where the run starts from nothing."""
        content: dict[str, Any] | None = None
        path = self.work / CHECKPOINT
        if path.exists():
            try:
                content = load(path)
                self.rows = list(content["rows"])
                self._earlier = dict(content["elapsed"])
            except (UserError, KeyError, TypeError, ValueError) as error:
                content = None
                tell(f"warning: starting again from step 0: {error}")
        self._saved = self._step()
        started = {"started": provenance.now(), "step": self._saved}
        where = {**provenance.source_revision(), **provenance.place()}
        self._note({**started, **where, **self._outside})
        self._signals.defer()
        return content["state"] if content else None

    def fail(self, reason: str) -> None:
        """Keep why training cannot go on, for `safemr records` to tell."""
        self._note({"failed": provenance.now(), "reason": reason})

    def failure(self) -> str | None:
        """Why the last attempt said that training cannot go on; None where it did not."""
        try:
            reason: str | None = read_attempts(self.work)[-1].get("reason")
        except (FileNotFoundError, IndexError):
            return None
        return reason

    def elapsed(self) -> dict[str, float]:
        """Wall and CPU seconds of the run, without what was lost between checkpoint and kill."""
        return {
            "wall_s": self._earlier["wall_s"] + time.monotonic() - self._started,
            "cpu_s": self._earlier["cpu_s"] + time.process_time(),
        }

    def record(self, row: Mapping[str, float]) -> None:
        """Append a progress row and copy all rows to ``.work/<digest>/progress.csv``."""
        self.rows.append(dict(row))
        with self._survive_full_disk("progress"):
            text = records.format_progress(self.rows)
            files.write(self.work / records.PROGRESS, text.encode(), durable=False)

    def maybe_checkpoint(self, state: Callable[[], Mapping[str, Any]]) -> None:
        """Save ``state()`` when one is due or the process was told to stop; in that case exit."""
        begun = time.monotonic()
        if self._reason_to_stop() is None and begun < self._due:
            return
        with self._survive_full_disk("checkpoint"):
            content = {"rows": self.rows, "elapsed": self.elapsed(), "state": state()}
            save(self.work / CHECKPOINT, content)
            self._saved = self._step()
        ended = time.monotonic()
        self._costs.append(ended - begun)
        with_next = sum(self._costs) * (1 + 1 / len(self._costs))
        self._due = max(ended + self._minimum_interval, self._started + with_next / SHARE)
        reason = self._reason_to_stop()  # also one that came while the checkpoint was written
        if reason is not None:
            step = self._step()
            here = "here" if self._saved == step else f"at step {self._saved}"
            tell(f"stopped by {reason} at step {step}; the same command continues {here}")
            raise SystemExit(128 + (self._signals.received or signal.SIGTERM))

    def finish(
        self, policy: Mapping[str, np.ndarray] | None, notes: Mapping[str, Any] | None = None
    ) -> None:
        """Write the record, provenance last, and remove everything unfinished.

        notes: what else the provenance says.
        """
        attempts = read_attempts(self.work)
        origin = {
            **provenance.collect(),
            **self._outside,
            **(notes or {}),
            **{name: round(value, 3) for name, value in self.elapsed().items()},
            "started": next((e["started"] for e in attempts if "started" in e), None),
            "finished": provenance.now(),
            "attempts": [{k: v for k, v in event.items() if k != "run"} for event in attempts],
        }
        try:
            records.write_record(self.folder, self.config, self.variant, self.rows, origin, policy)
        except OSError as error:
            raise UserError(
                f"cannot write the record {self.folder}: {error.strerror}; the last checkpoint is "
                "kept: make room and repeat the command"
            ) from error
        self.complete = True
        self._signals.ignore()

    def _step(self) -> int:
        return int(self.rows[-1]["step"]) if self.rows else 0

    def _note(self, event: Mapping[str, Any]) -> None:
        label = f"{self.variant} {self.config['task']['name']} seed {self.config['seed']}"
        with open(self.work / ATTEMPTS, "a") as stream:
            # The line break comes first: a line torn by a power failure spoils only itself.
            stream.write("\n" + json.dumps({"run": label, **event}))

    def _reason_to_stop(self) -> str | None:
        if self._signals.received is not None:
            return self._signals.received.name
        if self._parent is not None and os.getppid() != self._parent:
            return "the end of its parent process"
        return None

    def _stop_waiting(self) -> None:
        """An orphan gives up its place in the queue; a signal raises by itself."""
        if (reason := self._reason_to_stop()) is not None:
            tell(f"stopped by {reason} while it waited")
            raise SystemExit(128 + signal.SIGTERM)

    def _remove_temporary_files(self) -> None:
        for folder in (self.work, self.folder):
            for leftover in folder.glob(".*.tmp"):
                leftover.unlink(missing_ok=True)

    @contextlib.contextmanager
    def _survive_full_disk(self, what: str) -> Iterator[None]:
        """Turn a failed write into a warning: the previous file is intact and training goes on."""
        try:
            yield
        except (OSError, RuntimeError) as error:  # torch reports a full disk as RuntimeError
            cause = error if isinstance(error, OSError) else error.__context__
            if not isinstance(cause, OSError):
                raise
            tell(f"warning: no new {what} in {self.work}: {cause.strerror}; the previous one stays")
