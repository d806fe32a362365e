"""Processes that the driver asks and waits for. The one module that knows Ray, which is an extra.

Where they run, ``RAY_ADDRESS`` says: the address of a running cluster, or, without it, this machine
alone. It is no hyperparameter, since it changes no number that a run could be repeated with.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Sequence
from typing import Any, Protocol

from safemr.errors import UserError

ADDRESS = "RAY_ADDRESS"
STORE_BYTES = 200_000_000  # between processes; what does not fit goes through the disk
STARTS = 3  # tries to start Ray here, which gives up after 30 s where others use the machine
KNOCK_S = 10.0  # within which a cluster answers
ANSWER_S = 60.0  # within which a process that lives says so, where it is not busy


class LostError(Exception):
    """A task will never be done: its process, or the host that held its result, is gone."""


class Crew(Protocol):
    """Workers, objects whose methods are asked for. One does what it is asked in that order."""

    def hire(self, worker: type[Any], *args: Any) -> Any:
        """A new worker, made of a class and its arguments."""

    def ask(self, worker: Any, method: str, *args: Any) -> Any:
        """A promise of what the method returns; promises among the arguments are fulfilled first
        and need not pass through this process."""

    def put(self, value: Any) -> Any:
        """A promise that is fulfilled by ``value``."""

    def first(self, promises: Sequence[Any]) -> Any:
        """One of these that is fulfilled or broken, when there is one."""

    def get(self, promise: Any) -> Any:
        """What was promised. Raises LostError, and UserError where its worker cannot be made."""

    def lives(self, worker: Any) -> bool: ...

    def dismiss(self, worker: Any) -> None: ...

    def notes(self) -> dict[str, Any]:
        """What a record's provenance says of the processes."""

    def close(self) -> None: ...


def _knock(address: str) -> None:
    """Raises UserError where nobody answers at HOST:PORT, which Ray would wait for for minutes."""
    host, _, port = address.rpartition("://")[2].rpartition(":")
    if not port.isdecimal():
        return  # another form than that
    try:
        socket.create_connection((host.strip("[]"), int(port)), KNOCK_S).close()
    except OSError as error:
        raise UserError(
            f"{ADDRESS} = {address}: no cluster of Ray answers there ({error}); start one there "
            "(ray start --head), or unset the variable to use this machine alone"
        ) from error


class RayCrew:
    """Workers as actors of Ray, one CPU of Ray's each.

    Raises UserError where Ray is not installed, the cluster is not there, or it is too small.
    """

    def __init__(self, workers: int) -> None:
        try:
            import ray
        except ImportError as error:
            raise UserError(
                'the parallel trainer needs Ray: pip install ".[ray]" in a clone of this '
                "repository, or train by the algorithm of one process"
            ) from error
        self._ray = ray
        self._own = not ray.is_initialized()
        if self._own:
            self._start(workers)
        held = int(ray.cluster_resources().get("CPU", 0))
        if held < workers:
            self.close()
            raise UserError(
                f"the cluster of Ray has {held} CPUs, and samplers + buffers + learners are "
                f"{workers}: start it with more (ray start --num-cpus), or ask for fewer"
            )
        errors = ray.exceptions
        self._lost = (
            errors.RayActorError,
            errors.WorkerCrashedError,
            errors.ObjectLostError,
            errors.NodeDiedError,
            errors.LocalRayletDiedError,
        )

    def _start(self, workers: int) -> None:
        address = os.environ.get(ADDRESS)
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        where: dict[str, Any] = {"address": address}
        if address:
            _knock(address)
        else:
            sizes = {"num_cpus": workers, "object_store_memory": STORE_BYTES}
            where = {"address": "local", "include_dashboard": False, **sizes}
        # It takes SIGTERM for itself, which the training program answers with a checkpoint.
        handler = signal.getsignal(signal.SIGTERM)
        try:
            for attempt in range(1, STARTS + 1):
                try:
                    self._ray.init(log_to_driver=False, logging_level="CRITICAL", **where)
                    return
                except Exception as error:  # of no common class; a late node's is a bare one
                    self._ray.shutdown()
                    if address or attempt == STARTS:
                        reason = str(error).strip().partition("\n")[0]
                        said = f"{ADDRESS} = {address}" if address else "Ray does not start here"
                        raise UserError(f"{said}: {reason}") from error
        finally:
            if threading.current_thread() is threading.main_thread():
                signal.signal(signal.SIGTERM, handler)

    def hire(self, worker: type[Any], *args: Any) -> Any:
        # Restarting is the trainer's: Ray would do it without the state.
        actor = self._ray.remote(num_cpus=1, max_restarts=0, scheduling_strategy="SPREAD")(worker)
        return actor.remote(*args)

    def ask(self, worker: Any, method: str, *args: Any) -> Any:
        return getattr(worker, method).remote(*args)

    def put(self, value: Any) -> Any:
        return self._ray.put(value)

    def first(self, promises: Sequence[Any]) -> Any:
        # What one worker gives to another stays where it is.
        (done, *_), _ = self._ray.wait(list(promises), num_returns=1, fetch_local=False)
        return done

    def get(self, promise: Any) -> Any:
        try:
            return self._ray.get(promise)
        except self._lost as error:
            lines = [line.strip() for line in str(error).splitlines() if line.strip()]
            reason = lines[-1] if lines else type(error).__name__
            if getattr(error, "actor_init_failed", False):  # and would fail again
                raise UserError(
                    f"a process of the parallel trainer fails at once: {reason}"
                ) from error
            raise LostError(reason) from error

    def lives(self, worker: Any) -> bool:
        try:
            self._ray.get(worker.present.remote(), timeout=ANSWER_S)
        except self._ray.exceptions.GetTimeoutError:
            return True  # it is busy
        except self._lost:
            return False
        return True

    def dismiss(self, worker: Any) -> None:
        self._ray.kill(worker)

    def notes(self) -> dict[str, Any]:
        nodes = sum(1 for node in self._ray.nodes() if node["Alive"])
        return {"ray": self._ray.__version__, "ray_nodes": nodes}

    def close(self) -> None:
        if self._own:
            self._ray.shutdown()
