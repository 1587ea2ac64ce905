"""Partitions of a cluster from the command line: named workers and others, nannies and none."""

import os
import signal
import subprocess
import sys
import time

import pytest
from distributed import Client
from tests.poolpart.helpers import LONG_S, here, kill_nannied

from poolpart import Pool, n_workers, named, rest, worker_identities


class CommandLine:
    """Starts processes of Dask, and ends them."""

    def __init__(self):
        self.processes = []
        run = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1"]
        run += ["--port", "0", "--dashboard-address", "127.0.0.1:0"]
        scheduler = subprocess.Popen(run, stderr=subprocess.PIPE, text=True)
        self.processes.append(scheduler)
        self.address = next(line.split()[-1] for line in scheduler.stderr if "Scheduler at" in line)
        scheduler.stderr.close()

    def worker(self, *options):
        run = [sys.executable, "-m", "distributed.cli.dask_worker", self.address, *options]
        run += ["--nthreads", "1", "--host", "127.0.0.1", "--no-dashboard"]
        self.processes.append(subprocess.Popen(run, stderr=subprocess.DEVNULL))
        return self.processes[-1]

    def close(self):
        for process in reversed(self.processes):
            process.send_signal(signal.SIGINT)
            process.wait(LONG_S)


@pytest.fixture
def command_line():
    processes = CommandLine()
    yield processes
    processes.close()


def declared(client):
    """What workers declare, by number of their process."""
    workers = worker_identities(client)
    return {w["name"]: w["resources"] for w in workers.values()}


def await_workers(client, count):
    client.wait_for_workers(count, timeout=LONG_S)


@pytest.mark.slow
def test_live_late_killed_and_undone(command_line, wait_until):
    """A user's cluster: it is divided, workers die, join and come back, and it is as before."""
    command_line.worker("--name", "named")
    command_line.worker()
    plain = command_line.worker("--name", "plain", "--no-nanny")
    with Client(command_line.address) as client:
        await_workers(client, 3)
        parts = Pool.from_client(client).divide(
            {"A": named("named"), "B": n_workers(1, slots=3), "C": rest()}
        )
        before = sorted(map(str, declared(client).values()))
        assert before == ["{'A': 1}", "{'B': 3}", "{'C': 1}"]
        # Whoever is killed comes back where it was, with a nanny, and tasks that wait run.
        for address, pid in client.run(os.getpid).items():
            if pid != plain.pid:
                kill_nannied(client, address)
        waiting = [parts[name].submit(here) for name in "AB" for _ in range(3)]
        ran = {future.result(LONG_S) for future in waiting}
        assert ran <= {w.name for name in "AB" for w in parts[name].workers}
        # One without a nanny does not; the next that joins fills the gap.
        plain.kill()
        wait_until(lambda: len(parts["C"]) == 0 or len(parts["B"]) == 0, LONG_S)
        command_line.worker("--no-nanny")
        wait_until(lambda: sorted(map(str, declared(client).values())) == before, LONG_S)
        command_line.worker("--name", "late")
        wait_until(lambda: len(parts["C"]) == 2)
        # Moved while it runs, and killed after: its nanny knows.
        assert len(parts["B"].grow(2)) == 2
        address = next(w.address for w in parts["B"].workers if w.name == "late")
        kill_nannied(client, address)
        waiting = [parts["B"].submit(here) for _ in range(9)]
        wait_until(lambda: address not in worker_identities(client), LONG_S)
        wait_until(lambda: len(parts["B"]) == 3)
        assert {future.result(LONG_S) for future in waiting} <= {w.name for w in parts["B"].workers}
        assert "late" in {worker.name for worker in parts["B"].workers}
    with Client(command_line.address) as client:
        assert sorted(Pool.from_client(client).dissolve()) == ["A", "B", "C"]
        assert set(map(str, declared(client).values())) == {"{}"}
        old = set(worker_identities(client))
        client.restart(wait_for_workers=False)
        # Dask gives up one whose nanny takes long; what matters is how the others come back.
        wait_until(lambda: worker_identities(client) and not worker_identities(client).keys() & old)
        time.sleep(0.1)
        assert set(map(str, declared(client).values())) == {"{}"}
