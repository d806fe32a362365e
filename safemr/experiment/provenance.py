"""Where a result comes from: source revision, packages, machine."""

from __future__ import annotations

import datetime
import os
import platform
import resource
import socket
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

from safemr.files import REPOSITORY

# Where schedulers put the number of a job: Slurm, PBS, LSF.
JOBS = ("SLURM_JOB_ID", "PBS_JOBID", "LSB_JOBID")
PACKAGES = ("gymnasium", "mujoco", "numba", "numpy", "scipy", "torch")


def now() -> str:
    """The current time in UTC, ISO 8601 to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def source_revision() -> dict[str, Any]:
    """Git commit of this source tree and whether it was modified; None outside a repository."""

    def git(*arguments: str) -> str | None:
        try:
            # Git refuses a repository of another owner; whose code runs here is trusted already.
            command = [
                "git",
                "-c",
                f"safe.directory={REPOSITORY}",
                "-C",
                str(REPOSITORY),
                *arguments,
            ]
            # In a session of its own: Ctrl-C must not take the commit out of a record.
            return subprocess.run(
                command, capture_output=True, text=True, check=True, start_new_session=True
            ).stdout
        except (OSError, subprocess.CalledProcessError):
            return None

    commit = git("rev-parse", "HEAD")
    # Only code matters for a result: records that appear while a grid runs do not make it dirty.
    changes = git("status", "--porcelain", "--", "safemr", "envs")
    return {
        "commit": commit.strip() if commit else None,
        "dirty": bool(changes) if changes is not None else None,
    }


def package_versions() -> dict[str, str]:
    """Installed versions of the packages that a run's numbers depend on."""
    return {name: metadata.version(name) for name in PACKAGES}


def distribution_of(module: str) -> dict[str, str | None]:
    """The package that a module of others belongs to, and its version where it is installed."""
    package = module.partition(".")[0]
    names = metadata.packages_distributions().get(package, ())
    version = metadata.version(names[0]) if names else None
    return {"package": names[0] if names else package, "version": version}


def cpu_model() -> str:
    """The processor's marketing name where the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def place() -> dict[str, str]:
    """Where this process runs: the processor, and in a scheduler's job its number and host.

    Processors differ in the last bits, and a host may be faulty. A person's own machine has a name
    that says nothing of a result, and records are published: it is not written down.
    """
    job = next((os.environ[name] for name in JOBS if os.environ.get(name)), None)
    return {"cpu": cpu_model(), **({"host": socket.gethostname(), "job": job} if job else {})}


def peak_rss_mb() -> float:
    """The largest resident set size of this process so far, in MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1e6 if sys.platform == "darwin" else 1e3), 1)


def collect() -> dict[str, Any]:
    """Everything about code and machine that a record keeps."""
    return {
        "source": source_revision(),
        "packages": package_versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": cpu_model(),
        "peak_rss_mb": peak_rss_mb(),
    }
