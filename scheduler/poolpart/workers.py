"""Descriptions of workers, and running functions on workers and scheduler."""

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

SILENT_S = 20.0  # without a heartbeat, after which a worker counts as stopped or stuck
MISSED_BEATS = 3  # heartbeats that a worker may miss at least
_REPR_S = 2.0  # longest wait of a `repr` for the scheduler
_LOOK_S = 2.0  # between looks for silent workers


@dataclass(frozen=True)
class WorkerInfo:
    """Description of a worker in a cluster.

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
        """Names of the worker's partitions, which are the resources with at least one slot."""
        return frozenset(name for name, slots in self.resources.items() if slots)

    def with_gpus(self, gpus: Iterable[str]) -> WorkerInfo:
        """Return a copy of this description with the given GPUs."""
        return replace(self, gpus=tuple(gpus))

    @classmethod
    def from_identity(cls, address: str, identity: Mapping[str, Any]) -> WorkerInfo:
        """Create a description from the information that the scheduler has about a worker."""
        return cls(
            name=str(identity["name"]),
            address=address,
            host=identity["host"],
            nthreads=identity["nthreads"],
            memory=identity["memory_limit"] or 0,
            resources=dict(identity["resources"]),
        )


def slots_note(name: str, workers: Iterable[WorkerInfo]) -> str:
    """Return a note on a worker whose slots of a partition differ from its threads, or ""."""
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

    `answer_s` is the longest wait for the answer in seconds, by default that of
    `await_scheduler`.

    Raises
    ------
    PoolError
        If the scheduler's environment lacks this package, or the client cannot be asked.
    OSError
        If the scheduler is gone, or does not answer in time.
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
    """Call a function on the scheduler for a `repr`.

    Returns None if there is no answer in 2 s, or if waiting for one would block an event loop.
    """
    # A task that has not used its partition or pipe yet has no client.
    if client is None or client.asynchronous or client.status != "running":
        return None
    with suppress(RuntimeError):  # no event loop runs in this thread
        if asyncio.get_running_loop() is client.loop.asyncio_loop:
            return None
    try:
        return run_on_scheduler(client, function, answer_s=_REPR_S, **kwargs)
    except (PoolError, OSError):
        return None


def check_client(client: Client) -> None:
    """Raise PoolError if a client cannot be used.

    Otherwise the result would be a coroutine that nobody awaits, or an AttributeError.
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
    """Ask the scheduler for all its workers, by address.

    Raises
    ------
    PoolError
        If the client is closed, or asynchronous.
    """
    check_client(client)
    # `Client.scheduler_info(n_workers=-1)` asks too, but returns an attribute, into which the
    # client puts an answer without workers every two seconds: on a busy machine a cluster of
    # hundreds looks empty now and then.
    identity = client.sync(send_request, client, None, "identity", n_workers=-1)
    workers: dict[str, dict[str, Any]] = identity["workers"]
    return workers


def all_workers(client: Client) -> list[WorkerInfo]:
    """Ask the scheduler for all its workers, without their GPUs."""
    return [WorkerInfo.from_identity(a, i) for a, i in worker_identities(client).items()]


def run_on_workers(
    client: Client, question: Callable[..., Any], addresses: Sequence[str]
) -> dict[str, Any]:
    """Run a function on workers, outside their tasks, by `Client.run`.

    Returns, by address, the result, or the exception raised there. Workers that died before they
    answered, and silent ones, are left out.
    """

    async def run() -> dict[str, Any]:
        silent: set[str] = set()
        remaining = list(addresses)
        while remaining:  # an empty list would mean all workers to Client.run
            request = client.run(question, workers=remaining, on_error="return")
            answers = asyncio.ensure_future(request)
            try:
                while silent.isdisjoint(remaining):
                    finished, _ = await asyncio.wait([answers], timeout=_LOOK_S)
                    if finished:
                        return dict(answers.result())
                    present = (await send_request(client, None, "identity", n_workers=-1))[
                        "workers"
                    ]
                    silent = silent_workers({a: w["last_seen"] for a, w in present.items()})
            finally:
                answers.cancel()  # also the answers of the workers that are not silent
            remaining = [address for address in remaining if address not in silent]
        return {}

    answers: dict[str, Any] = client.sync(run)
    if not any(isinstance(answer, OSError) for answer in answers.values()):
        return answers
    present = worker_identities(client)
    # A worker that is still present may have raised an OSError itself.
    lost = {a: CommClosedError if a in present else OSError for a in answers}
    return {a: answer for a, answer in answers.items() if not isinstance(answer, lost[a])}


def silent_workers(last_seen: Mapping[str, float]) -> set[str]:
    """Return the addresses of workers without a recent heartbeat.

    `last_seen` is {address: time of the last heartbeat, seconds}. Times are compared with the
    latest heartbeat: if all workers have been silent, the scheduler itself was stopped or busy.
    """
    latest = max(last_seen.values(), default=0.0)
    # Dask's interval, which is long in large clusters.
    patience_s = max(SILENT_S, MISSED_BEATS * (1 + len(last_seen) / 100))
    return {address for address, heartbeat in last_seen.items() if latest - heartbeat > patience_s}
