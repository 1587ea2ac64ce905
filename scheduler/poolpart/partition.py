"""A partition: the workers that declare one Dask resource, and work for them alone."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import ExitStack
from contextvars import ContextVar
from typing import Any, Self

import dask
from distributed import Client, Future

from .division import ask, dissolve, grow, shrink
from .errors import PoolError
from .inherit import keep_shuffles_in
from .mapping import Results, Stage
from .stats import PartitionStats, partition_stats
from .task_context import own_client
from .workers import WorkerInfo, all_workers

# What `with partition:` has to undo, innermost last; of this thread or coroutine.
_entered: ContextVar[tuple[ExitStack, ...]] = ContextVar("_entered", default=())


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

    Notes
    -----
    It can be given to a task, which submits with the client of its worker then.
    """

    def __init__(self, name: str, client: Client | None = None, note: str = "") -> None:
        self.name, self.note = name, note
        self._client = client

    def __reduce__(self) -> tuple[Any, ...]:
        return Partition, (self.name, None, self.note)

    @property
    def client(self) -> Client:
        """The client that is used."""
        # Not where it is unpickled: that happens in the event loops of scheduler and worker.
        if self._client is None:
            self._client = own_client()
        return self._client

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """The members now, by name."""
        members = (w for w in all_workers(self.client) if w.resources.get(self.name))
        return tuple(sorted(members, key=lambda w: (len(w.name), w.name)))  # 10 behind 9

    @property
    def slots(self) -> int:
        """Tasks that the partition runs at a time."""
        return int(sum(worker.resources[self.name] for worker in self.workers))

    def __len__(self) -> int:
        return len(self.workers)

    def __repr__(self) -> str:
        return f"<Partition {self.name!r}{'; ' + self.note if self.note else ''}>"

    def stats(self) -> PartitionStats:
        """How busy it is and what it has done, whoever submitted the tasks."""
        return partition_stats(self.client, self.name)

    # -- tasks -------------------------------------------------------------------------

    def submit(
        self,
        function: Callable[..., Any],
        /,
        *args: Any,
        key: str | None = None,
        priority: int = 0,
        retries: int = 0,
        slots: int = 1,
        worker: str | None = None,
        **kwargs: Any,
    ) -> Future:
        """Submit one task to these workers.

        Parameters
        ----------
        function, args, kwargs
            What to call. Give arguments that are named like an option of `Client.submit`, such
            as `key` or `workers`, by position, or bind them with `functools.partial`.
        key
            The task's key; by default a new one, so that equal calls run each by itself.
        priority
            Of tasks that wait for the same worker, those of a higher one run first.
        retries
            How often the task runs again if it fails.
        slots
            Slots of one worker that it takes while it runs; it waits for ever where no member
            has so many.
        worker
            Address of the one member to run on; if it leaves, the task waits for ever.

        Returns
        -------
        Future

        Raises
        ------
        ValueError
            If `slots` is below 1.
        """
        return self.client.submit(
            function,
            *args,
            key=key,
            pure=False,
            priority=priority,
            retries=retries or None,
            resources=self._taking(slots),
            workers=None if worker is None else [worker],
            **kwargs,
        )

    def _taking(self, slots: int) -> dict[str, int]:
        if not isinstance(slots, int) or slots < 1:
            raise ValueError(f"slots is {slots!r}; give a whole number, 1 or more.")
        return {self.name: slots}

    def map(
        self,
        function: Callable[..., Any],
        /,
        *iterables: Iterable[Any],
        ordered: bool = True,
        window: int | None = None,
        chunk: int | None = None,
        priority: int = 0,
        retries: int = 0,
        slots: int = 1,
    ) -> Results:
        """Call a function for each item; an iterator gives the results.

        For any number of items, also without end: they are taken, and results are fetched,
        while results are asked for, and a bounded number is under way. Small items travel
        several in a task; how many, is learned from how long they take and how large they
        are.

        A map that is given the results of another as items takes them on the workers, also
        of another partition: nothing of them passes driver and scheduler. That holds for one
        map among the iterables, of which nothing was taken before.

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
            Higher runs first.
        retries
            How often an item that fails is tried again, at least.
        slots
            Slots of one worker that each task takes.

        Returns
        -------
        Results
            An iterator. It raises what `function` raises, after the results before; a note
            names the item. To go on after such an item, have `function` catch and return the
            error. To stop early, close it or let go of it: tasks that have not started never do.

        Raises
        ------
        ValueError
            If the window, the chunk or `slots` is below 1, or `retries` below 0.
        """
        self._taking(slots)
        options = (ordered, window, chunk, priority, retries, slots)
        return Results(Stage(self.client, self.name, function, *options), iterables)

    # -- collections and data ----------------------------------------------------------

    def compute(self, collections: Any, *, slots: int = 1, **options: Any) -> Any:
        """Compute Dask collections on these workers: arrays, dataframes, bags, delayed values.

        Each of their tasks takes a slot. Rechunking and shuffling stay on these workers too.

        Parameters
        ----------
        collections
            One, or a list of them.
        slots
            Slots that each task takes.
        options
            Others of `Client.compute`, such as ``sync=True`` for the result in place of a future.

        Returns
        -------
        Future or list of Future

        Examples
        --------
        >>> total = io.compute(dask.array.ones(10**9).sum())             # doctest: +SKIP
        >>> total.result()                                               # doctest: +SKIP
        1000000000.0
        """
        keep_shuffles_in(self.client)
        return self.client.compute(collections, resources=self._taking(slots), **options)

    def persist(self, collections: Any, *, slots: int = 1, **options: Any) -> Any:
        """Compute Dask collections and keep the results on these workers; see `compute`.

        Returns
        -------
        collection or list of collections
            With the same meaning, backed by futures.
        """
        keep_shuffles_in(self.client)
        return self.client.persist(collections, resources=self._taking(slots), **options)

    def gather(self, futures: Any, **options: Any) -> Any:
        """Results of futures, in the same nesting; `options` are those of `Client.gather`."""
        return self.client.gather(futures, **options)

    def scatter(self, data: Any, **options: Any) -> Any:
        """Put data into the memory of these workers; returns futures.

        Scattered data cannot be computed again when its worker dies.

        Parameters
        ----------
        data
            As `Client.scatter` takes it: a value, a list or a dict of values.
        options
            Others of `Client.scatter`, such as ``broadcast=True`` for a copy on each worker.

        Raises
        ------
        PoolError
            If the partition has no workers.
        """
        addresses = [worker.address for worker in self.workers]
        if not addresses:  # to Dask that would be any worker
            raise PoolError(f"Partition {self.name!r} has no workers to keep data.")
        return self.client.scatter(data, workers=addresses, **options)

    def __enter__(self) -> Self:
        """Have what is computed or submitted in the block run on these workers.

        That is `compute` and `persist` of Dask collections, `dask.compute`, and `Client.submit`
        and `Client.map` of this partition's client, in this thread. Each task takes a slot.

        Examples
        --------
        >>> with io:                                                     # doctest: +SKIP
        ...     total = dask.array.ones(10**9).sum().compute()
        """
        keep_shuffles_in(self.client)
        with ExitStack() as stack:
            stack.enter_context(self.client.as_current())
            stack.enter_context(dask.annotate(resources={self.name: 1}))
            _entered.set((*_entered.get(), stack.pop_all()))
        return self

    def __exit__(self, *_: object) -> None:
        *outer, stack = _entered.get()
        _entered.set(tuple(outer))
        stack.close()

    # -- workers that come and go ------------------------------------------------------

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
        arguments = {"count": workers, "source": source, "timeout_s": timeout_s}
        moved: list[str] = ask(self.client, grow, name=self.name, **arguments)
        return moved

    def shrink(self, workers: int = 1, *, timeout_s: float = 60.0) -> list[str]:
        """Move workers out of this partition while everything runs; returns their names.

        They go to the partition that has the rest, if there is one, or to none; those with
        the least to do go first, in the way that `grow` describes.

        Raises
        ------
        PoolError
            If fewer than its minimum would be left, or their tasks do not end in time.
        """
        arguments = {"count": workers, "timeout_s": timeout_s}
        moved: list[str] = ask(self.client, shrink, name=self.name, **arguments)
        return moved

    def dissolve(self, timeout_s: float = 30.0) -> None:
        """Undo this partition; see `Pool.dissolve`."""
        ask(self.client, dissolve, names=[self.name], timeout_s=timeout_s)
