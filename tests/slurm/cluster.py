"""A private Slurm for one test: its own munge key, controller and nodes on the loopback address, in one folder.

Nothing outside the folder is touched. Slurm's commands find the cluster through small scripts in `bin/`, which is put first
into PATH: the executor plugin removes every SLURM_* variable inside a job, so a variable would not reach what a job calls.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

DAEMONS = ("munged", "slurmctld", "slurmd")
COMMANDS = ("sbatch", "srun", "squeue", "scontrol", "scancel", "sinfo", "sacct", "sacctmgr")
MEMORY = 8000  # MB a node says it has; nothing enforces it here


def lacking() -> list[str]:
    """The programs that are not installed."""
    return [name for name in (*DAEMONS, *COMMANDS[:6]) if not shutil.which(name, path=system_path())]


def system_path() -> str:
    """PATH with the folders where daemons live."""
    return os.pathsep.join([os.environ["PATH"], "/usr/sbin", "/sbin"])


def free_ports(count: int) -> list[int]:
    """Ports of the loopback address that nobody uses now."""
    sockets = [socket.socket() for _ in range(count)]
    for s in sockets:
        s.bind(("127.0.0.1", 0))
    ports = [s.getsockname()[1] for s in sockets]
    for s in sockets:
        s.close()
    return ports


def configuration(folder: Path, nodes: int, cpus: int) -> str:
    """slurm.conf: no cgroups, no accounting; memory and cores are counted, finished jobs noted in `jobs.txt`."""
    host = socket.gethostname().split(".")[0]
    user = subprocess.run(["id", "-un"], capture_output=True, text=True, check=True).stdout.strip()
    controller, *ports = free_ports(nodes + 1)
    lines = [
        "ClusterName=kibs",
        f"SlurmctldHost={host}(127.0.0.1)",
        f"SlurmctldPort={controller}",
        f"SlurmUser={user}",
        f"SlurmdUser={user}",
        "AuthType=auth/munge",
        f"AuthInfo=socket={folder}/munge.socket",
        "CredType=cred/munge",
        f"StateSaveLocation={folder}/state",
        f"SlurmdSpoolDir={folder}/spool/%n",
        f"SlurmctldPidFile={folder}/slurmctld.pid",
        f"SlurmdPidFile={folder}/slurmd.%n.pid",
        f"SlurmctldLogFile={folder}/slurmctld.log",
        f"SlurmdLogFile={folder}/slurmd.%n.log",
        "ProctrackType=proctrack/linuxproc",
        "TaskPlugin=task/none",
        "JobAcctGatherType=jobacct_gather/none",
        "AccountingStorageType=accounting_storage/none",
        "JobCompType=jobcomp/filetxt",
        f"JobCompLoc={folder}/jobs.txt",
        "MpiDefault=none",
        "SwitchType=switch/none",
        "SelectType=select/cons_tres",
        "SelectTypeParameters=CR_CPU_Memory,CR_LLN",
        "SchedulerType=sched/backfill",
        "SchedulerParameters=batch_sched_delay=0,sched_interval=1,sched_min_interval=0,bf_interval=1",
        "SlurmdParameters=config_overrides",
        "MinJobAge=300",
        "KillWait=2",
        "ReturnToService=2",
    ]
    lines += [
        f"NodeName=n{i} NodeHostname={host} NodeAddr=127.0.0.1 Port={port} CPUs={cpus} RealMemory={MEMORY} State=UNKNOWN"
        for i, port in enumerate(ports, start=1)
    ]
    lines += ["PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE DefMemPerCPU=500 State=UP"]
    return "\n".join(lines) + "\n"


class Cluster:
    """A running cluster; `environment` leads programs to it. Use it with `with`: the daemons end with the block."""

    def __init__(self, folder: Path, nodes: int = 3, cpus: int = 2):
        self.folder, self.nodes, self.cpus = folder, nodes, cpus
        path = os.pathsep.join([str(folder / "bin"), system_path()])
        self.environment = {**os.environ, "PATH": path, "SLURM_CONF": str(folder / "slurm.conf")}

    def __enter__(self) -> Cluster:
        for name in ("state", "spool", "bin"):
            (self.folder / name).mkdir(parents=True)
        (self.folder / "slurm.conf").write_text(configuration(self.folder, self.nodes, self.cpus))
        for name in COMMANDS:
            real = shutil.which(name, path=system_path())
            if real:
                self.script(name, f'SLURM_CONF="{self.folder}/slurm.conf" exec {real} "$@"')
        key = self.folder / "munge.key"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o400)
        try:
            self._start(
                "munged", "--force", f"--key-file={key}", f"--socket={self.folder}/munge.socket",
                f"--pid-file={self.folder}/munged.pid", f"--log-file={self.folder}/munged.log",
                f"--seed-file={self.folder}/munged.seed",
            )  # fmt: skip
            self._start("slurmctld", "-c", "-f", f"{self.folder}/slurm.conf")
            for i in range(1, self.nodes + 1):
                (self.folder / "spool" / f"n{i}").mkdir()
                self._start("slurmd", "-N", f"n{i}", "-f", f"{self.folder}/slurm.conf")
            self._wait_for_nodes()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """End the daemons this cluster started, the nodes first."""
        for pattern in ("slurmd.*.pid", "slurmctld.pid", "munged.pid"):
            for file in self.folder.glob(pattern):
                pid = int(file.read_text().strip() or 0)
                for sign in (signal.SIGTERM, signal.SIGKILL):
                    if not pid or not self._lives(pid):
                        break
                    os.kill(pid, sign)
                    deadline = time.monotonic() + 10
                    while self._lives(pid) and time.monotonic() < deadline:
                        time.sleep(0.05)

    def script(self, name: str, body: str) -> Path:
        """Put a shell script into the folder that comes first in PATH."""
        path = self.folder / "bin" / name
        path.write_text(f"#!/bin/sh\n{body}\n")
        path.chmod(0o755)
        return path

    def cancel(self) -> None:
        """Cancel all jobs, as a user does after a killed run (docs/scaling.md), and wait for their end."""
        user = subprocess.run(["id", "-un"], capture_output=True, text=True, check=True).stdout.strip()
        subprocess.run(["scancel", "--user", user], env=self.environment, check=True)
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            queue = subprocess.run(["squeue", "--noheader"], env=self.environment, capture_output=True, text=True)
            if not queue.stdout.strip():
                return
            time.sleep(0.2)
        raise RuntimeError(f"cancelled jobs do not end:\n{queue.stdout}")

    def ended(self) -> list[dict[str, str]]:
        """Jobs that came to an end, as Slurm noted them: JobId, JobState, NodeList and so on."""
        file = self.folder / "jobs.txt"
        lines = file.read_text().splitlines() if file.exists() else []
        return [dict(word.split("=", 1) for word in line.split() if "=" in word) for line in lines]

    def _start(self, *command: str) -> None:
        subprocess.run(command, env=self.environment, check=True, capture_output=True)

    def _wait_for_nodes(self) -> None:
        deadline = time.monotonic() + 60
        states: list[str] = []
        while time.monotonic() < deadline:
            done = subprocess.run(
                ["sinfo", "-h", "-N", "-o", "%T"], env=self.environment, capture_output=True, text=True
            )
            states = done.stdout.split()
            if states == ["idle"] * self.nodes:
                return
            time.sleep(0.2)
        logs = "\n".join(f.read_text()[-1000:] for f in self.folder.glob("*.log"))
        raise RuntimeError(f"the nodes did not come up ({states}):\n{logs}")

    @staticmethod
    def _lives(pid: int) -> bool:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return False
        stat = Path(f"/proc/{pid}/stat")
        return not stat.exists() or stat.read_text().rsplit(")", 1)[1].split()[0] != "Z"
