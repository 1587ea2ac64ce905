"""Submitting work to the workers that declare one Dask resource."""

from __future__ import annotations

import abc
import copy
from collections.abc import Callable, Iterable, Sized
from typing import Any, Self

from dask.utils import funcname
from distributed import Client, Future

from .current_client import own_client
from .mapping import MapOptions, Results
from .quota import Quota
from .sender import Sender


class Submitter(abc.ABC):
    """Submits tasks that take one slot of a resource each; what a partition does for its users.

    Parameters
    ----------
    name
        Name of the resource.
    client
        Client of the cluster. By default, in a task, that of its worker.
    priority
        Priority of tasks where none is given.
    """

    def __init__(self, name: str, client: Client | None = None, priority: int = 0) -> None:
        self.name, self.priority = name, priority
        self._client = client
        self._quota: Quota | None = None

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
    @abc.abstractmethod
    def slots(self) -> int:
        """Tasks that run at a time."""

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
