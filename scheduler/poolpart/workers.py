"""Descriptions of workers, and functions that run code on workers and on the scheduler."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

from distributed import Client
from distributed.comm.core import CommClosedError

from .errors import PoolError
from .internals.client import await_scheduler, send_request
from .internals.worker import declared_resources as declared_resources

SILENT_S = 20.0  # time without a heartbeat after which a worker is considered silent
MISSED_BEATS = 3  # number of heartbeats that a worker must miss to be considered silent
_REPR_S = 2.0  # maximum time that a `repr` waits for the scheduler
_CHECK_S = 2.0  # interval between checks for silent workers


@dataclass(frozen=True)
class WorkerInfo:
    """Description of a worker in the cluster.

    Parameters
    ----------
    name, address, host
        Name, address and host of the worker. When its nanny restarts a worker, an explicitly set
        name stays the same. The address changes, and with it the default name, which is derived
        from the address. The name is always a string. Workers of a `LocalCluster` have integers as
        names, so compare it with ``str(get_worker().name)`` in a task.
    nthreads
        Number of threads.
    memory
        Memory limit in bytes, or 0 if there is none.
    gpus
        UUIDs of the CUDA devices that the worker may use, in the order of the device indices.
    resources
        Quantities of the Dask resources that the worker declares, by name.
    """

    name: str
    address: str
    host: str
    nthreads: int
    memory: int = 0
    gpus: tuple[str, ...] = ()
    resources: Mapping[str, float] = field(default_factory=dict)

    @property
    def partitions(self) -> frozenset[str]:
        """Names of the worker's partitions, that is, its resources with at least one slot."""
        return frozenset(name for name, slots in self.resources.items() if slots)

    def with_gpus(self, gpus: Iterable[str]) -> WorkerInfo:
        """Return a copy of this description that includes the given GPUs."""
        return replace(self, gpus=tuple(gpus))

    @classmethod
    def from_identity(cls, address: str, identity: Mapping[str, Any]) -> WorkerInfo:
        """Create a description from the scheduler's information about a worker."""
        return cls(
            name=str(identity["name"]),
            address=address,
            host=identity["host"],
            nthreads=identity["nthreads"],
            memory=identity["memory_limit"] or 0,
            resources=dict(identity["resources"]),
        )


def slots_note(name: str, workers: Iterable[WorkerInfo]) -> str:
    """Return a note about the first worker whose slots and threads differ, or ""."""
    for worker in workers:
        slots = worker.resources.get(name, 0)
        if not slots or slots == worker.nthreads:
            continue
        has = f"Worker {worker.name} has {slots:g} {'slot' if slots == 1 else 'slots'} but "
        has += f"{worker.nthreads} {'thread' if worker.nthreads == 1 else 'threads'}, so "
        has += "threads stay idle" if slots < worker.nthreads else "tasks wait for a thread"
        return f'{has}. Start it with `--resources "{name}={worker.nthreads}"` to use every thread.'
    return ""


def run_on_scheduler(
    client: Client, function: Callable[..., Any], *, answer_s: float | None = None, **kwargs: Any
) -> Any:
    """Call `function(**kwargs, dask_scheduler=…)` in the scheduler's event loop.

    Parameters
    ----------
    client, function
        Client of the scheduler, and the function to run there.
    answer_s
        Maximum time to wait for a response in seconds. By default, the limit of `await_scheduler`.
    kwargs
        Keyword arguments of the function.

    Returns
    -------
    Any
        Return value of the function.

    Raises
    ------
    PoolError
        If poolpart is not installed in the scheduler's environment, or if the client is closed or
        asynchronous.
    OSError
        If the connection to the scheduler is lost, or if it does not respond in time.
    """
    check_client(client)

    async def request() -> Any:
        return await await_scheduler(client, client.run_on_scheduler(function, **kwargs), answer_s)

    try:
        return client.sync(request)
    except ModuleNotFoundError as error:
        raise PoolError(
            f"The scheduler at {client.scheduler.address} cannot import {error.name!r}. Start it "
            "in the same environment as this process."
        ) from error


def query_for_repr(client: Client | None, function: Callable[..., Any], **kwargs: Any) -> Any:
    """Call a function on the scheduler for a `repr`. Return None if the scheduler is unavailable.

    The result is None if there is no response within 2 s, or if waiting would block an event loop.
    """
    # A partition or pipe that a task has received but not used yet has no client.
    if client is None or client.asynchronous or client.status != "running":
        return None
    with suppress(RuntimeError):  # this thread has no running event loop
        if asyncio.get_running_loop() is client.loop.asyncio_loop:
            return None
    try:
        return run_on_scheduler(client, function, answer_s=_REPR_S, **kwargs)
    except (PoolError, OSError):
        return None


def check_client(client: Client) -> None:
    """Raise PoolError if a client is closed or asynchronous.

    Without this check, callers would receive a coroutine that is never awaited, or an
    AttributeError.
    """
    if client.asynchronous:
        raise PoolError(
            "poolpart does not support asynchronous clients. Create a client with "
            "`Client(address)`. In an event loop, use it in a thread, for example with "
            "`asyncio.to_thread`."
        )
    if client.status in ("closing", "closed"):
        raise PoolError(f"The client is {client.status}. Create a new client and a new pool.")


def worker_identities(client: Client) -> dict[str, dict[str, Any]]:
    """Request Dask's description of each worker from the scheduler, by address.

    Raises
    ------
    PoolError
        If the client is closed or asynchronous.
    """
    check_client(client)
    # `Client.scheduler_info(n_workers=-1)` sends the same request but returns an attribute, which
    # the client overwrites every two seconds with a response without workers. On a busy machine, a
    # cluster with hundreds of workers sometimes appeared to be empty.
    identity = client.sync(send_request, client, None, "identity", n_workers=-1)
    workers: dict[str, dict[str, Any]] = identity["workers"]
    return workers


def all_workers(client: Client) -> list[WorkerInfo]:
    """Request a description of each worker, without its GPUs, from the scheduler."""
    return [WorkerInfo.from_identity(a, i) for a, i in worker_identities(client).items()]


def run_on_workers(
    client: Client, function: Callable[..., Any], addresses: Sequence[str]
) -> dict[str, Any]:
    """Run a function on workers, outside tasks, and return the results by address.

    If the function raises an exception on a worker, the exception takes the place of the result.
    Silent workers, and workers that die before they respond, are omitted.
    """

    async def run() -> dict[str, Any]:
        silent: set[str] = set()
        remaining = list(addresses)
        while remaining:  # Client.run would interpret an empty list as all workers
            request = client.run(function, workers=remaining, on_error="return")
            answers = asyncio.ensure_future(request)
            try:
                while silent.isdisjoint(remaining):
                    finished, _ = await asyncio.wait([answers], timeout=_CHECK_S)
                    if finished:
                        return dict(answers.result())
                    present = (await send_request(client, None, "identity", n_workers=-1))[
                        "workers"
                    ]
                    silent = silent_workers({a: w["last_seen"] for a, w in present.items()})
            finally:
                answers.cancel()  # if a worker is silent, the remaining workers are asked again
            remaining = [address for address in remaining if address not in silent]
        return {}

    answers: dict[str, Any] = client.sync(run)
    if not any(isinstance(answer, OSError) for answer in answers.values()):
        return answers
    present = worker_identities(client)
    # If a worker is still present, the function may have raised an OSError itself.
    lost = {a: CommClosedError if a in present else OSError for a in answers}
    return {a: answer for a, answer in answers.items() if not isinstance(answer, lost[a])}


def silent_workers(last_seen: Mapping[str, float]) -> set[str]:
    """Return the addresses of workers that have not sent a heartbeat recently.

    `last_seen` maps each worker's address to the time of its last heartbeat, in seconds. The times
    are compared with the latest heartbeat of all workers, because if all workers are silent, the
    scheduler itself was stopped or busy.
    """
    latest = max(last_seen.values(), default=0.0)
    # Dask's heartbeat interval increases with the size of the cluster.
    patience_s = max(SILENT_S, MISSED_BEATS * (1 + len(last_seen) / 100))
    return {address for address, heartbeat in last_seen.items() if latest - heartbeat > patience_s}
