"""A Slurm cluster of two one-CPU nodes on this machine, as any user and in a folder of its own.

    with SlurmCluster(folder) as cluster:
        subprocess.run(["sbatch", ...], env=cluster.environment)
        cluster.crash("node1")

Where the kernel lets this user make namespaces each node has its own host name and processes, and
crashes as one; elsewhere the nodes are names with ports of their own on one host. Either way they
share the network, the disk and the locks of this machine, and nothing is written outside the
folder. There is no accounting.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import secrets
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Self

NODES = ("node1", "node2")
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel", "scontrol")
PATH = os.pathsep.join([os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"])
# With --keep-caps an ordinary user may name the host that is only his.
OWN = ["--uts", "--pid", "--mount", "--mount-proc", "--fork", "--kill-child"]
NAMESPACES = (
    ["unshare", *OWN],
    ["unshare", "--user", "--map-current-user", "--keep-caps", *OWN],
)
CONF = """\
ClusterName=trial
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
ReturnToService=2
SlurmdTimeout=20
KillWait=30
NodeName=node1 {node} NodeAddr=127.0.0.1 Port={ports[1]} CPUs=1 RealMemory=1600
NodeName=node2 {node} NodeAddr=127.0.0.1 Port={ports[2]} CPUs=1 RealMemory=1600
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


class Job(NamedTuple):
    """A job in Slurm's queue; ``comment`` is the rule and wildcards that Snakemake gave it."""

    number: str
    state: str
    node: str
    comment: str


def lacking() -> str | None:
    """Why there can be no cluster here, or None."""
    absent = [name for name in PROGRAMS if shutil.which(name, path=PATH) is None]
    return f"Slurm is not installed: no {', '.join(absent)}" if absent else None


def namespaces() -> list[str] | None:
    """The command that starts a program as a host of its own, or None where that is forbidden."""
    for command in NAMESPACES:
        tried = [*command, "hostname", NODES[0]]
        with contextlib.suppress(OSError):
            if subprocess.run(tried, capture_output=True).returncode == 0:
                return command
    return None


class SlurmCluster(contextlib.AbstractContextManager["SlurmCluster"]):
    """The daemons of a cluster, from ``with`` to its end.

    Args:
        folder: Keys, state and logs; must be writable by this user alone.
        separate: Whether nodes may be namespaces; by default where that is allowed.

    Attributes:
        environment: Variables with which Slurm's commands reach this cluster.
        separate: Whether the nodes are namespaces.
    """

    def __init__(self, folder: Path, *, separate: bool = True) -> None:
        self.folder = folder.absolute()
        self._host = namespaces() if separate else None
        self.separate = self._host is not None
        self._daemons: dict[str, subprocess.Popen[bytes]] = {}
        # The executor takes Slurm's variables from the environment of `srun`, which therefore
        # finds the configuration by a command of the same name.
        self._conf = self.folder / "slurm.conf"
        srun = self.folder / "bin/srun"
        self.environment = {
            **{name: value for name, value in os.environ.items() if "SLURM" not in name},
            "PATH": os.pathsep.join([str(srun.parent), PATH]),
            "SLURM_CONF": str(self._conf),
        }

    def __enter__(self) -> Self:
        for name in ("bin", "state", *(f"spool-{node}" for node in NODES)):
            (self.folder / name).mkdir(parents=True, mode=0o700)
        self.folder.chmod(0o700)
        srun = self.folder / "bin/srun"
        real = shutil.which("srun", path=PATH)
        srun.write_text(f'#!/bin/sh\nSLURM_CONF={self._conf} exec {real} "$@"\n')
        srun.chmod(0o755)
        with contextlib.ExitStack() as ports:
            sockets = [ports.enter_context(socket.socket()) for _ in range(3)]
            for one in sockets:
                one.bind(("127.0.0.1", 0))
            numbers = [one.getsockname()[1] for one in sockets]
        self._conf.write_text(
            CONF.format(
                host=socket.gethostname(),
                folder=self.folder,
                ports=numbers,
                user=pwd.getpwuid(os.getuid()).pw_name,
                node="" if self.separate else f"NodeHostname={socket.gethostname()}",
            )
        )
        key = self.folder / "munge.key"
        key.write_bytes(secrets.token_bytes(128))
        key.chmod(0o600)
        try:
            self._start(
                "munged",
                ["munged", "--foreground", "--force", f"--key-file={key}"]
                + [f"--{name}-file={self.folder}/munged.{name}" for name in ("pid", "log", "seed")]
                + [f"--socket={self.folder}/munge.socket"],
            )
            until(lambda: (self.folder / "munge.socket").exists(), "munged", 30)
            self._start("slurmctld", ["slurmctld", "-D", "-f", str(self._conf)])
            for node in NODES:
                self.start(node)
            until(lambda: self.idle() == len(NODES), "both nodes", 120)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for node in NODES:
            self.crash(node)
        for name in ("slurmctld", "munged"):
            if (daemon := self._daemons.get(name)) is not None:
                daemon.terminate()
                daemon.wait()

    def start(self, node: str) -> None:
        """Boot a node."""
        command = ["slurmd", "-D", "-f", str(self._conf)]
        if self._host is not None:
            inside = f'hostname {node}; exec "$@"'
            self._start(node, [*self._host, "sh", "-c", inside, "sh", *command])
        else:
            self._start(node, [*command, "-N", node])

    def crash(self, node: str) -> None:
        """Kill everything that runs on a node at once, as a power failure would."""
        daemon = self._daemons.pop(node, None)
        if daemon is None:
            return
        if not self.separate:
            for process in running_on(node):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
        daemon.kill()  # its --kill-child ends the namespace and all in it
        daemon.wait()

    def tell(self, *command: str) -> str:
        """What one of Slurm's commands prints."""
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True)
        assert done.returncode == 0, f"{' '.join(command)}: {done.stderr}"
        return done.stdout

    def idle(self) -> int:
        """How many nodes wait for work."""
        try:
            return self.tell("sinfo", "--noheader", "-N", "-t", "idle", "-o", "%N").count("node")
        except AssertionError:
            return 0  # the controller is not there yet

    def jobs(self) -> list[Job]:
        """Those in the queue and those that ended lately."""
        lines = self.tell("squeue", "--noheader", "--states=all", "-o", "%i|%T|%N|%k").splitlines()
        return [Job(*line.split("|", 3)) for line in lines]

    def _start(self, name: str, command: Sequence[str]) -> None:
        with open(self.folder / f"{name}.out", "ab") as stream:
            self._daemons[name] = subprocess.Popen(
                command,
                env={**self.environment, "PATH": PATH},
                stdout=stream,
                stderr=stream,
                start_new_session=True,
            )


def running_on(node: str) -> list[int]:
    """The processes of a node that shares its host with others, those that report deaths first."""
    daemons, tasks = [], []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, IndexError):
            words = (entry / "cmdline").read_bytes().split(b"\0")
            if words[0].endswith(b"slurmd") and node.encode() in words:
                daemons.append(int(entry.name))
            if f"SLURMD_NODENAME={node}".encode() in (entry / "environ").read_bytes().split(b"\0"):
                tasks.append(int(entry.name))
                parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
                if Path("/proc", parent, "cmdline").read_bytes().startswith(b"slurmstepd"):
                    daemons.append(int(parent))
    return [*dict.fromkeys(daemons), *tasks]


def until(condition: Callable[[], bool], what: str, seconds: float) -> None:
    """Wait for a condition.

    Raises:
        TimeoutError: naming ``what`` did not come.
    """
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"{what} did not come within {seconds:.0f} s")
        time.sleep(0.5)
