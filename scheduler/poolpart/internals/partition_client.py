"""A client that only shows the workers of a partition, for libraries that choose workers.

Libraries find their client with `get_client`, `worker_client`, `Client.current` or
`default_client`, all of which return the client of the innermost ``with client.as_current()`` block
of the thread. They then list workers, submit tasks to some of them, or compute collections.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from contextvars import ContextVar
from functools import cache, wraps
from typing import Any

import dask
from distributed import Client
from distributed.objects import SchedulerInfo

from ..errors import PoolError
from .worker import current_task

# Private names of Dask that this module uses, in the form "module:object.attribute(parameters)".
PRIVATE_NAMES = (
    "distributed.client:Client.scheduler",
    "distributed.client:Client._scheduler_identity",
    "distributed.worker:Worker._get_client(timeout)",
    "distributed.worker:Worker._client",
    "distributed.scheduler:Scheduler.identity(n_workers)",
)

CLIENT_OF = "poolpart-client"  # annotation of a task whose `get_client` shows only this partition
# Requests with a parameter `workers` whose default is all workers.
_OF_WORKERS = frozenset(
    {
        "broadcast",
        "has_what",
        "ncores",
        "ncores_running",
        "processing",
        "profile",
        "rebalance",
        "replicate",
        "worker_logs",
    }
)
_SUMS = {"n_workers": None, "total_threads": "nthreads", "total_memory": "memory_limit"}

_entered: ContextVar[tuple[ExitStack, ...]] = ContextVar("_entered", default=())
# Names of the partitions with a `with partition:` block around the current code.
entered_partitions: ContextVar[tuple[str, ...]] = ContextVar("entered_partitions", default=())


class _PartitionScheduler:
    """Connection to the scheduler whose requests default to the workers of a partition."""

    def __init__(self, scheduler: Any, name: str) -> None:
        self._scheduler = scheduler
        self._name = name

    def __getattr__(self, request: str) -> Any:
        send = getattr(self._scheduler, request)
        if request not in _OF_WORKERS:
            return send

        async def send_to_members(workers: Any = None, **arguments: Any) -> Any:
            if workers is None:
                workers = await self.addresses()
            return await send(workers=workers, **arguments)

        return send_to_members

    async def addresses(self) -> list[str]:
        """Return the addresses of the partition's workers."""
        return list((await self.identity())["workers"])

    async def identity(self, n_workers: int = -1, **arguments: Any) -> dict[str, Any]:
        """Return the scheduler's description of itself and of the partition's workers."""
        identity = await self._scheduler.identity(n_workers=-1, **arguments)
        members = {
            address: worker
            for address, worker in identity["workers"].items()
            if worker["resources"].get(self._name)
        }
        for total, quantity in _SUMS.items():
            if total in identity:  # depends on the version of Dask
                identity[total] = sum(w[quantity] if quantity else 1 for w in members.values())
        shown = list(members)[: None if n_workers < 0 else n_workers]
        return {**identity, "workers": {address: members[address] for address in shown}}


class PartitionClient(Client):
    """Client whose methods only use and show the workers of a partition.

    It shares the connection and all other state of the client that it was created from, and ends
    with it. Its futures belong to that client, so both clients can use them.

    ``with`` makes it the current client in the block. The connection remains open at the end.
    """

    # All other attributes are those of the client, because both objects have the same `__dict__`.
    __slots__ = ("_identity", "_partition", "_register", "_whole")

    def __init__(
        self, client: Client, partition: str, register: Callable[[], object] = lambda: None
    ) -> None:
        self._whole = client
        self._partition = partition
        # Registers the client for the partition if necessary, or raises PoolError if the partition
        # was dissolved.
        self._register = register
        self._identity = SchedulerInfo({})
        object.__setattr__(self, "__dict__", client.__dict__)
        # The annotations are applied when a dataframe is computed, although Dask warns that
        # dataframes ignore annotations when they are created.
        warnings.filterwarnings("ignore", f"Dask annotations .*{CLIENT_OF}.* detected")

    def __del__(self) -> None:
        """Leave the connection open."""

    def __repr__(self) -> str:
        scheduler = self.__dict__["scheduler"]
        address = repr(scheduler.address) if scheduler is not None else "closed"
        return f"<PartitionClient {self._partition!r}: scheduler={address}>"

    def __reduce__(self) -> Any:
        """Raise PoolError, because a connection cannot be pickled."""
        raise PoolError(
            "A client cannot be sent to a task. Pass the partition instead, and call its "
            "`as_client` method in the task."
        )

    def _repr_html_(self) -> None:
        """Let notebooks show the plain representation."""

    def __enter__(self) -> PartitionClient:
        with ExitStack() as stack:
            stack.enter_context(self.as_current())
            _entered.set((*_entered.get(), stack.pop_all()))
        return self

    def __exit__(self, *_: object) -> None:
        *outer, stack = _entered.get()
        _entered.set(tuple(outer))
        stack.close()

    # -- the connection ----------------------------------------------------------------

    @property
    def scheduler(self) -> Any:
        """Connection to the scheduler that shows the partition's workers."""
        scheduler = self.__dict__["scheduler"]
        return None if scheduler is None else _PartitionScheduler(scheduler, self._partition)

    @property
    def cluster(self) -> None:
        """None, because the cluster manages all workers."""
        return None

    @property
    def _scheduler_identity(self) -> SchedulerInfo:
        return self._identity

    @_scheduler_identity.setter
    def _scheduler_identity(self, identity: SchedulerInfo) -> None:
        self._identity = identity

    def close(self, *_: Any, **__: Any) -> Any:
        """Do nothing. The connection remains open until the original client closes."""
        return self.sync(_do_nothing)

    def restart(self, *_: Any, **__: Any) -> Any:
        """Raise PoolError, because this would restart all workers of the cluster."""
        raise PoolError(
            f"The client of partition {self._partition!r} cannot restart the cluster. Use the "
            "client of the pool, or restart single workers with `restart_workers`."
        )

    def shutdown(self) -> Any:
        """Raise PoolError, because this would shut down the cluster."""
        raise PoolError(
            f"The client of partition {self._partition!r} cannot shut down the cluster. Use the "
            "client of the pool."
        )

    def retire_workers(self, workers: Any = None, *args: Any, **kw: Any) -> Any:
        """Retire the given workers. Raise PoolError if the scheduler would choose them."""
        if not workers:
            raise PoolError(
                f"The client of partition {self._partition!r} cannot let the scheduler choose the "
                "workers to retire, because it could choose workers of other partitions. Pass the "
                "addresses of the workers."
            )
        return self._whole.retire_workers(workers, *args, **kw)

    # -- tasks and data ----------------------------------------------------------------

    def submit(self, *args: Any, resources: Mapping[str, float] | None = None, **kw: Any) -> Any:
        """Submit a task to the partition. See `Client.submit`."""
        with self._annotate(resources):
            return self._whole.submit(*args, **kw)

    def map(self, *args: Any, resources: Mapping[str, float] | None = None, **kw: Any) -> Any:
        """Submit a task for each item to the partition. See `Client.map`."""
        with self._annotate(resources):
            return self._whole.map(*args, **kw)

    def get(self, *args: Any, resources: Mapping[str, float] | None = None, **kw: Any) -> Any:
        """Compute a graph in the partition. See `Client.get`."""
        with self._annotate(resources):
            return self._whole.get(*args, **kw)

    def compute(self, *args: Any, resources: Mapping[str, float] | None = None, **kw: Any) -> Any:
        """Compute collections in the partition. See `Client.compute`."""
        with self._annotate(resources):
            return self._whole.compute(*args, **kw)

    def persist(self, *args: Any, resources: Mapping[str, float] | None = None, **kw: Any) -> Any:
        """Persist collections in the partition. See `Client.persist`."""
        with self._annotate(resources):
            return self._whole.persist(*args, **kw)

    def gather(self, *args: Any, **kw: Any) -> Any:
        """Return the results of futures. See `Client.gather`."""
        return self._whole.gather(*args, **kw)

    def scatter(self, data: Any, workers: Any = None, **kw: Any) -> Any:
        """Scatter data into the memory of the partition's workers. See `Client.scatter`."""
        if not self.asynchronous:
            addresses = self._require(self.sync(self.scheduler.addresses))
            return self._whole.scatter(data, workers=workers or addresses, **kw)

        async def scatter() -> Any:
            addresses = self._require(await self.scheduler.addresses())
            return await self._whole.scatter(data, workers=workers or addresses, **kw)

        return scatter()

    def _require(self, addresses: list[str]) -> list[str]:
        if not addresses:  # Dask would interpret an empty list as any worker
            raise PoolError(f"Partition {self._partition!r} has no workers to store the data.")
        return addresses

    def _annotate(self, resources: Mapping[str, float] | None) -> AbstractContextManager[None]:
        """Return a block in which tasks take a slot of the partition.

        Raises
        ------
        PoolError
            If the partition was dissolved, or if `resources` is invalid.
        """
        if not self.asynchronous:  # a request would block the client's event loop
            self._register()
        others = resources
        if others is None and isinstance(others := dask.get_annotations().get("resources"), dict):
            # This client takes precedence over the `with partition:` blocks around the call.
            others = {n: slots for n, slots in others.items() if n not in entered_partitions.get()}
        if others is not None and not isinstance(others, Mapping):
            raise PoolError(
                f"Invalid value {others!r} for `resources`. Expected a mapping of names to numbers."
            )
        slots = {self._partition: 1, **(others or {})}
        taken = slots[self._partition]
        if not isinstance(taken, int) or taken is True or taken < 1:
            raise PoolError(
                f"Invalid value {taken!r} for the slots of a task in partition "
                f"{self._partition!r}. Expected an integer of at least 1."
            )
        annotations = {"resources": slots, CLIENT_OF: self._partition}
        block: AbstractContextManager[None] = dask.annotate(**annotations)
        return block

    # -- workers -----------------------------------------------------------------------

    def scheduler_info(self, n_workers: int = -1, **kwargs: Any) -> SchedulerInfo:
        """Return information about the scheduler and the partition's workers."""
        if self.status == "closed":
            raise PoolError("The client is closed. Create a new client and a new pool.")
        if not self.asynchronous:
            identity = self.sync(self.scheduler.identity, n_workers=n_workers, **kwargs)
            self._identity = SchedulerInfo(identity)
        return self._identity


async def _do_nothing() -> None:
    pass


def whole_client(client: Client) -> Client:
    """Return the client that shows all workers."""
    return client._whole if isinstance(client, PartitionClient) else client


@cache  # only once per process
def show_partitions_to_tasks() -> None:
    """Make `get_client` show only the partition in tasks that a `PartitionClient` has submitted."""
    from distributed import Worker

    get_client = Worker._get_client

    @wraps(get_client)
    def get_partition_client(worker: Any, *args: Any, **kwargs: Any) -> Client:
        client = get_client(worker, *args, **kwargs)
        worker._client = whole_client(client)  # which the worker closes at its end
        running = current_task()
        name = (running[1].annotations or {}).get(CLIENT_OF) if running is not None else None
        if name is None or isinstance(client, PartitionClient):
            return client
        return PartitionClient(client, name)

    Worker._get_client = get_partition_client
