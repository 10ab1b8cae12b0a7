"""A Slurm cluster of four nodes on this machine, in a folder of its own.

It needs root and Debian's packages slurmctld, slurmd, slurm-client and munge. Nothing of the machine's own
configuration is read or changed: munge has its own key and socket, and Slurm's programs are told where their
configuration lies.
"""

import os
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path

import pytest

NODES = ["n1", "n2", "n3", "n4"]
PROGRAMS = ["munged", "slurmctld", "slurmd", "sbatch"]

CONFIGURATION = """
ClusterName=harness
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
MpiDefault=none
ReturnToService=2
MinJobAge=3600
KillWait=5
SchedulerParameters=sched_interval=1
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
{nodes}
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def free_port() -> int:
    with socket.socket() as opened:
        opened.bind(("127.0.0.1", 0))
        return opened.getsockname()[1]


class Cluster:
    def __init__(self, folder: Path):
        self.folder = folder
        self.configuration = folder / "slurm.conf"
        self.environment = os.environ | {"SLURM_CONF": str(self.configuration)}
        self.daemons: list[subprocess.Popen] = []

    def start(self) -> None:
        host = socket.gethostname()
        for name in ["state", *(f"spool-{node}" for node in NODES)]:
            (self.folder / name).mkdir()
        nodes = "\n".join(
            f"NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 Port={free_port()} CPUs=1 RealMemory=1000"
            for node in NODES
        )
        text = CONFIGURATION.format(host=host, port=free_port(), folder=self.folder, nodes=nodes)
        self.configuration.write_text(text)
        (self.folder / "cgroup.conf").write_text("CgroupPlugin=cgroup/v1\n")
        key = self.folder / "munge.key"
        key.write_bytes(os.urandom(1024))
        key.chmod(0o600)
        self.folder.chmod(0o755)
        files = {"key-file": key}
        files |= {name: self.folder / f"munge.{name.split('-')[0]}" for name in ("pid-file", "log-file", "seed-file")}
        files["socket"] = self.folder / "munge.socket"
        options = [f"--{name}={path}" for name, path in files.items()]
        self.daemon("munged", "--foreground", "--force", *options)
        wait_for(files["socket"].exists, "munge")
        self.daemon("slurmctld", "-D", "-f", str(self.configuration))
        for node in NODES:
            self.daemon("slurmd", "-D", "-N", node, "-f", str(self.configuration))
        wait_for(lambda: self("sinfo", "--noheader", "--format=%t %D").split() == ["idle", "4"], "idle nodes")

    def daemon(self, *command: str) -> None:
        log = (self.folder / f"{command[0]}.out").open("a")
        program = shutil.which(command[0], path=f"{os.environ['PATH']}:/usr/sbin")
        started = subprocess.Popen([program, *command[1:]], env=self.environment, stdout=log, stderr=log)
        self.daemons.append(started)

    def __call__(self, *command: str) -> str:
        """What a command of Slurm prints; nothing, if it fails."""
        answer = subprocess.run(command, env=self.environment, capture_output=True, text=True, check=False)
        return answer.stdout

    def stop(self) -> None:
        self("scancel", "--state=PENDING", "--state=RUNNING", "--user=root")
        time.sleep(1)
        for daemon in reversed(self.daemons):
            daemon.send_signal(signal.SIGTERM)
        for daemon in self.daemons:
            try:
                daemon.wait(10)
            except subprocess.TimeoutExpired:
                daemon.kill()


def wait_for(condition, what: str, seconds: float = 300) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"no {what} after {seconds:.0f} s"
        time.sleep(0.2)


@pytest.fixture
def cluster(tmp_path):
    missing = [program for program in PROGRAMS if shutil.which(program, path=f"{os.environ['PATH']}:/usr/sbin") is None]
    assert not missing, f"{', '.join(missing)} missing: setup/setup.sh --cluster installs Slurm"
    cluster = Cluster(tmp_path)
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop()
