"""Slurm and an SSH server on the loopback interface, as Debian packages them."""

from __future__ import annotations

import getpass
import os
import secrets
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

LOOPBACK = "127.0.0.1"


def _found(program: str) -> str | None:
    # Those of administrators are not in everybody's PATH.
    places = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin", "/usr/local/sbin"])
    return shutil.which(program, path=places)


def _installed(*programs: str) -> bool:
    return all(map(_found, programs))


needs_slurm = pytest.mark.skipif(
    not _installed("slurmctld", "slurmd", "munged", "sbatch"),
    reason="no Slurm here: apt-get install slurmctld slurmd slurm-client munge",
)
needs_sshd = pytest.mark.skipif(
    not _installed("sshd", "ssh-keygen"),
    reason="no SSH server here: apt-get install openssh-server",
)


class Slurm:
    """A queue of one node, which says that it has 16 processors and 2 GPUs."""

    def __init__(self, config: Path) -> None:
        self.environment = {"SLURM_CONF": str(config)}

    def ask(self, *command: str) -> str:
        """Run one of Slurm's commands and return what it says."""
        environment = {**os.environ, **self.environment}
        return subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True, timeout=120
        ).stdout

    def jobs(self) -> dict[str, list[str]]:
        """List what is in the queue: {name of a job: [number, state]}."""
        lines = self.ask("squeue", "--noheader", "--format=%j %i %T").splitlines()
        return {name: rest for name, *rest in (line.split() for line in lines)}


@contextmanager
def slurm(folder: Path) -> Iterator[Slurm]:
    """Start a Slurm of this user for as long as the body runs; its files are in the folder."""
    key = folder / "munge.key"
    key.touch(0o600)
    key.write_bytes(secrets.token_bytes(128))
    with ExitStack() as stack:
        _start(
            stack,
            *("munged", "--foreground", "--force", "--num-threads=2"),
            *(f"--{what}-file={folder}/munge.{what}" for what in ("key", "pid", "log", "seed")),
            f"--socket={folder}/munge.socket",
        )
        wait_until((folder / "munge.socket").exists)
        for _ in range(20):  # a port that was free may be taken by now
            with ExitStack() as attempt:
                node = _node(attempt, folder)
                if node is not None:
                    stack.push(attempt.pop_all())
                    break
        else:
            raise AssertionError((folder / "slurmctld.log").read_text())
        yield node


def _node(stack: ExitStack, folder: Path) -> Slurm | None:
    """Start controller and node on ports that are free; None if one was not, after all."""
    host = socket.gethostname().partition(".")[0]
    for part in ("state", "spool"):
        (folder / part).mkdir(exist_ok=True)
    user = getpass.getuser()
    config = folder / "slurm.conf"
    config.write_text(
        f"""
ClusterName=loopback
SlurmctldHost={host}({LOOPBACK})
SlurmctldPort={_free_port()}
SlurmdPort={_free_port()}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
KillWait=5
GresTypes=gpu
NodeName={host} NodeAddr={LOOPBACK} CPUs=16 RealMemory=65536 Gres=gpu:2 State=UNKNOWN
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""
    )
    (folder / "gres.conf").write_text("Name=gpu File=/dev/null\nName=gpu File=/dev/zero\n")
    node = Slurm(config)
    daemons = [
        _start(stack, "slurmctld", "-D", **node.environment),
        _start(stack, "slurmd", "-D", "-N", host, **node.environment),
    ]

    def ready() -> bool:
        if any(daemon.poll() is not None for daemon in daemons):
            return True
        with suppress(subprocess.CalledProcessError):
            return node.ask("sinfo", "--noheader", "--format=%T").strip() == "idle"
        return False

    wait_until(ready)
    return node if all(daemon.poll() is None for daemon in daemons) else None


def _start(
    stack: ExitStack, program: str, *arguments: str, **environment: str
) -> subprocess.Popen[bytes]:
    daemon = subprocess.Popen(
        [_found(program) or program, *arguments],
        env={**os.environ, **environment},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    stack.callback(daemon.wait, 120)
    stack.callback(daemon.terminate)
    return daemon


def _free_port() -> int:
    with socket.socket() as one:
        one.bind((LOOPBACK, 0))
        return one.getsockname()[1]


@contextmanager
def ssh_server(folder: Path) -> Iterator[dict[str, object]]:
    """Serve SSH on the loopback interface; yields what `asyncssh.connect` is to be told of it."""
    for name in ("host", "user"):
        subprocess.run(
            ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", folder / name], check=True
        )
    shutil.copy(folder / "user.pub", folder / "authorized")
    config = folder / "sshd_config"
    config.write_text(
        f"""
HostKey {folder}/host
AuthorizedKeysFile {folder}/authorized
PidFile none
StrictModes no
UsePAM no
PasswordAuthentication no
SetEnv PYTHONPATH={os.pathsep.join(filter(None, sys.path))}
"""
    )
    command = [_found("sshd") or "sshd", "-i", "-e", "-f", str(config)]
    if os.geteuid() == 0:  # an empty folder that it wants, made by Debian when the machine starts
        Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)
    servers: list[subprocess.Popen[bytes]] = []
    with (
        socket.create_server((LOOPBACK, 0), backlog=100) as listening,
        (folder / "log").open("w") as log,
    ):

        def serve() -> None:
            with suppress(OSError):  # it was closed
                while True:
                    connection, _ = listening.accept()
                    with connection:
                        servers.append(
                            subprocess.Popen(
                                command, stdin=connection, stdout=connection, stderr=log
                            )
                        )

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield {
            "port": listening.getsockname()[1],
            "username": getpass.getuser(),
            "known_hosts": None,
            "client_keys": [str(folder / "user")],
        }
        listening.shutdown(socket.SHUT_RDWR)
        thread.join(120)
    for server in servers:
        server.terminate()
        server.wait(120)


def wait_until(condition: Callable[[], object]) -> None:
    """Wait for something that will be so."""
    stop = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < stop, "waited in vain"
        time.sleep(0.02)
