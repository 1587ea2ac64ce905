"""A partition: the workers that declare one Dask resource, and work for them alone."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable, Sized
from typing import Any, Self

from dask.utils import funcname
from distributed import Client, Future

from . import moves
from .awaiting import Backoff
from .declare import dissolve
from .errors import PoolError
from .mapping import MapOptions, Results
from .remote import worker_identities
from .sender import Quota, Sender
from .stats import PartitionStats, partition_stats
from .task_context import own_client
from .wording import counted
from .worker_info import WorkerInfo


class Partition:
    """The workers of a cluster that declare the resource `name`.

    Whatever it submits takes one slot of that resource, so that it runs on these workers and
    on no others. Membership is what the workers declare now: a worker that its nanny
    restarted, or one that joined with the resource, belongs.

    Parameters
    ----------
    name
        Name of the partition and of the resource.
    client
        Client of the cluster. By default, in a task, that of its worker.
    note
        Something a user should know of it, such as that it had to do without GPUs.
    priority
        Priority of its tasks where none is given: of tasks that wait for the same worker,
        those of a higher one run first. It can be changed.

    Notes
    -----
    It can be given to a task, which submits with the client of its worker then.
    """

    def __init__(
        self, name: str, client: Client | None = None, note: str = "", priority: int = 0
    ) -> None:
        self.name, self.note, self.priority = name, note, priority
        self._client = client
        self._quota: Quota | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        if self._quota is not None:
            raise TypeError(
                f"A handle on {self.name!r} with a quota cannot be sent to a task, since it counts "
                "what is submitted where it was made: send the partition, and limit it there."
            )
        return Partition, (self.name, None, self.note, self.priority)

    @property
    def client(self) -> Client:
        """The client that is used."""
        # Not where it is unpickled: that happens in the event loops of scheduler and worker.
        if self._client is None:
            self._client = own_client()
        return self._client

    @property
    def _sender(self) -> Sender:
        return Sender(self.client, self.name, self._quota)

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """The members now, by name."""
        identities = worker_identities(self.client)
        members = (WorkerInfo.from_identity(a, i) for a, i in identities.items())
        return tuple(sorted((w for w in members if w.resources.get(self.name)), key=_by_name))

    @property
    def slots(self) -> int:
        """Tasks that the partition runs at a time."""
        return _slots(self.workers, self.name)

    def __len__(self) -> int:
        return len(self.workers)

    def __repr__(self) -> str:
        if self.client.status != "running":
            return f"<Partition {self.name!r}: its client is {self.client.status}>"
        workers = self.workers
        names = [worker.name for worker in workers]
        shown = ", ".join(names[:4]) + (", …" if len(names) > 4 else "")
        note = f"; {self.note}" if self.note else ""
        return (
            f"<Partition {self.name!r}: {counted(len(names), 'worker')} "
            f"({shown}), {counted(_slots(workers, self.name), 'slot')}{note}>"
        )

    def stats(self) -> PartitionStats:
        """How busy it is and what it has done, whoever submitted the tasks."""
        return partition_stats(self.client, self.name)

    def wait(self, n_workers: int = 1, timeout_s: float | None = None) -> None:
        """Wait until the partition has so many workers.

        Dask itself waits silently, and for ever, with a task that no worker may take.

        Raises
        ------
        PoolError
            If it has fewer after so many seconds.
        """
        deadline = time.monotonic() + (float("inf") if timeout_s is None else timeout_s)
        pause = Backoff(0.01, 0.2)
        while (there := len(self)) < n_workers:
            if time.monotonic() >= deadline:
                raise PoolError(
                    f"Partition {self.name!r} has {there} of {counted(n_workers, 'worker')} after "
                    f'{timeout_s} s: start some with dask worker … --resources "{self.name}=1"'
                )
            pause.sleep()

    # -- tasks -------------------------------------------------------------------------

    def submit(
        self,
        function: Callable[..., Any],
        /,
        *args: Any,
        key: str | None = None,
        priority: int | None = None,
        retries: int = 0,
        worker: str | None = None,
        **kwargs: Any,
    ) -> Future:
        """Submit one task to these workers.

        Parameters
        ----------
        function, args, kwargs
            What to call. Arguments named like an option of `Client.submit`, such as `key` or
            `workers`, are not passed on by name: give them by position, or bind them with
            `functools.partial`.
        key
            The task's key; by default a new one, so that equal calls run each by itself.
        priority
            Higher runs first; the partition's by default.
        retries
            How often the task runs again if it fails.
        worker
            Address of the one member to run on; if it leaves, the task waits for ever.

        Returns
        -------
        Future

        Raises
        ------
        TypeError
            If a keyword is another option of `Client.submit`.
        """
        return self._sender.send(
            function,
            args,
            kwargs,
            key=key,
            priority=self._default(priority),
            worker=worker,
            retries=retries,
        )

    def submit_many(
        self,
        function: Callable[..., Any],
        /,
        *iterables: Iterable[Any],
        priority: int | None = None,
        retries: int = 0,
    ) -> list[Future]:
        """Submit one task for each item, in one message; see `map` for many or endless items.

        Dask does not hold back tasks that need a resource: what has run stays in the workers'
        memory as long as its future is held.

        Returns
        -------
        list of Future
            In the order of the items, as many as the shortest iterable has.
        """
        columns = list(zip(*zip(*iterables, strict=False), strict=True))
        count = len(columns[0]) if columns else 0
        sender = self._sender
        futures: list[Future] = []
        while (start := len(futures)) < count:
            futures += sender.send_many(
                function,
                *(column[start : start + sender.most] for column in columns),
                key=funcname(function),
                priority=self._default(priority),
                retries=retries,
                wait=True,
            )
        return futures

    def map(
        self,
        function: Callable[..., Any],
        /,
        *iterables: Iterable[Any],
        ordered: bool = True,
        window: int | None = None,
        chunk: int | None = None,
        priority: int | None = None,
        retries: int = 0,
    ) -> Results:
        """Call a function for each item; an iterator gives the results.

        For any number of items, also without end: they are taken, and results are fetched,
        while results are asked for, and a bounded number is under way. Small items travel
        several in a task; how many, is learned from how long they take and how large they
        are.

        Parameters
        ----------
        function, iterables
            Called with one item of each, until the shortest has no more.
        ordered
            Results in the order of the items, or else as they come.
        window
            Tasks under way at most; by default twice the slots, of which there may be more
            or fewer later.
        chunk
            Items in a task; by default as many as take a tenth of a second, or longer where
            there are many slots. Give 1 where items differ much, or must not wait for others.
        priority
            Higher runs first; the partition's by default.
        retries
            How often an item that fails is tried again, at least.

        Returns
        -------
        Results
            An iterator. It raises what `function` raises, after the results before; a note
            names the item. To go on after such an item, have `function` catch and return the
            error. To stop early, close it or let go of it: tasks that have not started never do.

        Raises
        ------
        ValueError
            If the window or the chunk is below 1, or retries below 0.
        """
        options = MapOptions(ordered, window, chunk, self._default(priority), retries)
        sized = [len(iterable) for iterable in iterables if isinstance(iterable, Sized)]
        calls = zip(*iterables, strict=False)
        total = min(sized, default=None)
        return Results(self._sender, lambda: self.slots, function, calls, total, options)

    def limited(self, slots: int, priority: int | None = None) -> Self:
        """Give a handle on the same workers that has at most so many tasks under way.

        With one for each, users of a partition share it. Beyond the limit its `submit` waits
        until one of its tasks is done; so each of its tasks is wanted until then, also when
        its future is dropped, unless it is cancelled. It limits what is submitted through
        this handle: Dask itself knows no users.

        Parameters
        ----------
        slots
            Tasks under way at a time, 1 or more.
        priority
            Priority of its tasks; by default that of this handle.

        Raises
        ------
        ValueError
            If `slots` is below 1.
        """
        handle = copy.copy(self)
        handle._quota = Quota(slots)
        if priority is not None:
            handle.priority = priority
        return handle

    def __copy__(self) -> Self:
        # By itself `copy` would do what pickle does.
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__)
        return twin

    def _default(self, priority: int | None) -> int:
        return self.priority if priority is None else priority

    # -- workers that come and go ------------------------------------------------------

    @property
    def minimum(self) -> int:
        """Workers that it keeps whatever is moved, as said when it was made."""
        return moves.minimum(self.client, self.name)

    def grow(
        self, workers: int = 1, *, source: str | None = None, timeout_s: float = 60.0
    ) -> list[str]:
        """Move workers into this partition while everything runs; returns their names.

        What a worker has begun for the partition that it leaves ends there first, and what it
        has not begun goes to others. Where the partition was made of a number of workers, that
        number grows too.

        Parameters
        ----------
        workers
            How many.
        source
            Name of the partition that they leave; by default they are taken of workers that
            belong to none and of the partition that has the rest.
        timeout_s
            How long to wait for them to come free.

        Raises
        ------
        PoolError
            If there are too few, counting those that `source` needs; or if tasks do not end
            in time, in which case their workers stay where they are.

        Examples
        --------
        >>> gpu.grow(2, source="OTHER")                                # doctest: +SKIP
        ['5', '6']
        """
        return moves.grow(self.client, self.name, workers, source, timeout_s)

    def shrink(self, workers: int = 1, *, timeout_s: float = 60.0) -> list[str]:
        """Move workers out of this partition while everything runs; returns their names.

        They go to the partition that has the rest, if there is one, or to none; those with
        the least to do go first, in the way that `grow` describes.

        Raises
        ------
        PoolError
            If fewer than its minimum would be left, or their tasks do not end in time.
        """
        return moves.shrink(self.client, self.name, workers, timeout_s)

    def dissolve(self, timeout_s: float = 30.0) -> None:
        """Undo this partition; see `Pool.dissolve`."""
        dissolve(self.client, [self.name], timeout_s)


def _slots(workers: Iterable[WorkerInfo], name: str) -> int:
    return int(sum(worker.resources[name] for worker in workers))


def _by_name(worker: WorkerInfo) -> tuple[int, str]:
    """Sort key that puts worker 10 behind worker 9."""
    return len(worker.name), worker.name
