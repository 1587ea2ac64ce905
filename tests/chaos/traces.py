"""What a run may leave behind: on the scheduler, in the process, on the disk."""

from __future__ import annotations

import gc
import os
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import psutil
from distributed import Client

SETTLE_S = 120.0  # for what was closed to be gone: connections and processes end a moment later


def scheduler_state(client: Client) -> dict[str, Any]:
    """All that a scheduler knows, as sets and counts that can be compared."""
    state: dict[str, Any] = client.run_on_scheduler(_look)
    return state


def _look(dask_scheduler: Any) -> dict[str, Any]:
    extensions = dask_scheduler.extensions
    queues, variables = extensions["queues"], extensions["variables"]
    events, locks = extensions.get("events"), extensions.get("semaphores")
    return {
        "tasks": sorted(map(str, dask_scheduler.tasks)),
        "unrunnable": sorted(str(task.key) for task in dask_scheduler.unrunnable),
        "queued": len(dask_scheduler.queued),
        "clients": len(dask_scheduler.clients) - _clients_of_workers(dask_scheduler),
        "queues": sorted(queues.queues),
        "queue references": sorted(map(str, queues.client_refcount)),
        "queued futures": sorted(map(str, queues.future_refcount)),
        "variables": sorted(variables.variables),
        "variables waited for": sorted(map(str, variables.waiting)),
        "variable conditions": sorted(map(str, getattr(variables, "waiting_conditions", ()))),
        "events": sorted(map(str, getattr(events, "_events", ()))),
        "semaphores": sorted(map(str, getattr(locks, "leases", ()))),
        "plugins": sorted(dask_scheduler.plugins),
        "worker plugins": sorted(dask_scheduler.worker_plugins),
        "nanny plugins": sorted(dask_scheduler.nanny_plugins),
        "extensions": sorted(extensions),
        "handlers": sorted(dask_scheduler.handlers),
        "stream handlers": sorted(dask_scheduler.stream_handlers),
        "workers": sorted(str(worker.name) for worker in dask_scheduler.workers.values()),
        "resources": {
            str(worker.name): dict(worker.resources) for worker in dask_scheduler.workers.values()
        },
        # Not what Dask counts: a stolen task stays with the worker that it was taken from.
        "resources used": {
            str(worker.name): [task.resource_restrictions for task in worker.processing]
            for worker in dask_scheduler.workers.values()
        },
        "host restrictions": sorted(map(str, getattr(dask_scheduler, "host_restrictions", ()))),
    }


def _clients_of_workers(dask_scheduler: Any) -> int:
    """Each worker whose tasks have used a client has one, until it leaves."""
    return sum(str(name).startswith("Client-worker") for name in dask_scheduler.clients)


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Say what is not as it was."""
    return [
        f"{name}: {before.get(name)} before, {after.get(name)} after"
        for name in sorted(before.keys() | after.keys())
        if before.get(name) != after.get(name)
    ]


def settled_differences(client: Client, before: dict[str, Any]) -> list[str]:
    """Say what a scheduler knows that it did not, once it has heard of all that was closed."""
    return _settled(lambda: differences(before, scheduler_state(client)))


def _settled(look: Callable[[], list[str]]) -> list[str]:
    """Look until there is nothing, or nothing will change any more."""
    deadline = time.monotonic() + SETTLE_S
    while (left := look()) and time.monotonic() < deadline:
        time.sleep(0.2)
    return left


@dataclass(frozen=True)
class Footprint:
    """What this process holds of the machine."""

    descriptors: Counter[str]  # what they lead to
    processes: frozenset[str]
    files: frozenset[str]

    @classmethod
    def now(cls, folder: Path) -> Footprint:
        """Look; `folder` is the one for temporary files."""
        gc.collect()
        resource_tracker.ensure_running()  # it stays as long as this process
        children = psutil.Process().children(recursive=True)
        return cls(
            descriptors=Counter(_targets()),
            processes=frozenset(
                f"{child.pid} {' '.join(child.cmdline())}"
                for child in children
                if child.status() != psutil.STATUS_ZOMBIE
                and "resource_tracker" not in " ".join(child.cmdline())
            ),
            files=frozenset(
                str(path.relative_to(folder))
                for path in folder.rglob("*")
                if path.is_file() and path.stat().st_size
            ),
        )

    def left_in(self, folder: Path) -> list[str]:
        """Say what there is in the end that there was not at first."""
        return _settled(lambda: self._more_in(Footprint.now(folder)))

    def _more_in(self, after: Footprint) -> list[str]:
        left = [f"process {process}" for process in sorted(after.processes - self.processes)]
        left += [f"file {file}" for file in sorted(after.files - self.files)]
        left += [
            f"{count} descriptors of {target}"
            for target, count in sorted((after.descriptors - self.descriptors).items())
        ]
        return left


def _targets() -> Iterator[str]:
    """What the descriptors of this process lead to; sockets and pipes without their numbers."""
    for path in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # the one that lists them is gone again
            target = str(path.readlink())
            yield target.partition(":[")[0]


@contextmanager
def own_temporary_folder() -> Iterator[Path]:
    """Have this process, and those that it starts, put temporary files into a new folder."""
    with tempfile.TemporaryDirectory(prefix="chaos-") as name:
        earlier = tempfile.tempdir, os.environ.get("TMPDIR")
        tempfile.tempdir = os.environ["TMPDIR"] = name
        try:
            yield Path(name)
        finally:
            tempfile.tempdir = earlier[0]
            del os.environ["TMPDIR"]
            if earlier[1] is not None:
                os.environ["TMPDIR"] = earlier[1]
