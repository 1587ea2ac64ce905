"""Cluster into which faults are injected."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import dask
from distributed import Client, SpecCluster

from lidarpool.processes.fork_server import start_fork_server
from lidarpool.processes.tracing import trace_to
from lidarpool.run.cluster.connection import local_cluster
from poolpart.deploy import forked_workers

from .events import Board, ChaosPlugin

# Long enough for a worker that imports a lot at once to be heard of again. The scheduler looks
# at such intervals, too: a worker is given up after once to twice this.
TIME_TO_LIVE_S = 10
CLOSING_S = 10.0


class WorkerProcesses:
    """Workers with nannies in a cluster of this process, which die and are started again."""

    cluster: SpecCluster

    def names(self, partition: str) -> list[str]:
        """Return the names of a partition's workers, including those that are down."""
        return sorted(name for name in self.cluster.worker_spec if name.startswith(partition))

    def pid(self, name: str) -> int | None:
        """Return the process ID of a worker, or None if it has no process."""
        nanny = self.cluster.workers.get(name)
        pid = getattr(nanny, "pid", None)
        return pid if pid and _is_there(pid) else None

    def address(self, name: str) -> str | None:
        """Return a worker's address, or None if the scheduler or the nanny does not know it."""
        # The scheduler hears of it first. A nanny whose first worker dies before it has heard
        # of that one gives up.
        nanny = self.cluster.workers.get(name)
        if nanny is None or nanny.status.name != "running":
            return None
        address = getattr(nanny, "worker_address", None)
        return address if address in self.cluster.scheduler.workers else None

    def revive(self, name: str) -> None:
        """Restart a worker whose nanny has exited."""
        nanny = self.cluster.workers.get(name)
        deadline = time.monotonic() + CLOSING_S
        while nanny is not None and nanny.status.name not in ("closed", "failed"):
            if time.monotonic() > deadline:
                self.cluster.sync(nanny.close, timeout=5)
            time.sleep(0.02)
        self.cluster.workers.pop(name, None)
        self.cluster.sync(self.cluster._correct_state)

    @property
    def deserted(self) -> list[str]:
        """Names of workers whose nannies have exited."""
        nannies = list(self.cluster.workers.items())
        return [name for name, nanny in nannies if nanny.status.name in ("closed", "failed")]

    def wait_until_whole(self, timeout_s: float = 300.0) -> None:
        """Wait until all workers are running."""
        deadline = time.monotonic() + timeout_s
        while absent := [name for name in self.cluster.worker_spec if not self.address(name)]:
            for name in self.deserted:  # also one that was killed while it came back
                self.revive(name)
            if time.monotonic() > deadline:
                raise TimeoutError(f"{', '.join(absent)} did not come back in {timeout_s} s.")
            time.sleep(0.02)

    def give_up(self, pid: int) -> None:
        """Make the scheduler treat a process's worker as one without heartbeats."""
        scheduler = self.cluster.scheduler
        workers = list(scheduler.workers.items())
        self.cluster.sync(
            scheduler.restart_workers,
            [address for address, worker in workers if worker.pid == pid],
            wait_for_workers=False,
            stimulus_id="chaos",
        )


class Arena(WorkerProcesses):
    """Local cluster with two casting workers, two LIDAR workers, another worker, and a board.

    `pauses` maps points of the workers to the seconds per scan for which workers are held there.
    The scheduler gives up on a worker that has sent no heartbeat for `time_to_live_s`.
    """

    def __init__(
        self, pauses: Mapping[str, float] | None = None, time_to_live_s: int = TIME_TO_LIVE_S
    ) -> None:
        self._stack = ExitStack()
        self._config = {
            "logging.distributed": "critical",  # half of what is started here is killed
            "distributed.scheduler.worker-ttl": f"{time_to_live_s}s",
        }
        self._pauses = dict(pauses or {})
        self._withdrawn: dict[str, Any] = {}  # {name: how to start it}

    def __enter__(self) -> Arena:
        with ExitStack() as stack:
            stack.enter_context(dask.config.set(self._config))
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="chaos-"))
            self.board = Board(Path(folder))
            start_fork_server()  # as the product does
            stack.enter_context(forked_workers())
            self.cluster = stack.enter_context(local_cluster(gpu_workers=2, other_workers=1))
            spec = self.cluster.worker_spec
            spec["LIDAR-1"] = spec["LIDAR-0"]
            self.cluster.sync(self.cluster._correct_state)
            self.client = stack.enter_context(Client(self.cluster, set_as_default=False))
            stack.callback(trace_to, None)
            self.client.register_plugin(ChaosPlugin(folder, self._pauses))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def withdraw(self, partition: str) -> None:
        """Remove all workers of a partition until `give_up` is called."""
        self.wait_until_whole()
        for name in self.names(partition):
            self._withdrawn[name] = self.cluster.worker_spec.pop(name)
        self.cluster.sync(self.cluster._correct_state)

    def give_up(self, pid: int) -> None:
        """Make the scheduler treat a process's worker as one without heartbeats."""
        super().give_up(pid)
        self.cluster.worker_spec.update(self._withdrawn)
        self._withdrawn.clear()
        self.cluster.sync(self.cluster._correct_state)


def _is_there(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
