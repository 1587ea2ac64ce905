"""Submitting tasks that take one slot of a resource, no more at a time than a quota allows."""

from __future__ import annotations

import inspect
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from distributed import Client, Future


def when_done(future: Future, function: Callable[[Future], Any]) -> None:
    """Call `function(future)` once the task has succeeded, failed or been cancelled.

    It is called in the client's event loop and must not block. `Future.add_done_callback`
    calls in a thread that all callbacks of the process share: a user's callback that waits
    there for this one would wait for ever. It also takes a task for done whose result was lost
    with its worker, while that is computed again.
    """
    future.client.loop.add_callback(_wait, future, function)


async def _wait(future: Future, function: Callable[[Future], Any]) -> None:
    while future.status in ("pending", "lost"):
        await future._state.wait()
    function(future)


class Quota:
    """At most so many tasks under way at a time, counted where they are submitted.

    Dask places tasks by a worker's total resources and knows no users. So whoever submits
    holds back: one place for each task, given back when the task is done.
    """

    def __init__(self, slots: int) -> None:
        if not isinstance(slots, int) or slots < 1:
            raise ValueError(f"A quota of {slots!r} slots; give a whole number, 1 or more.")
        self.slots = slots
        self._free = threading.Semaphore(slots)

    def take(self, most: int, wait: bool) -> int:
        """Take up to so many places.

        Parameters
        ----------
        most
            Places wanted, 1 or more.
        wait
            Whether to wait until there is one; else this may be none.

        Returns
        -------
        int
            Places taken.
        """
        taken = int(self._free.acquire(blocking=wait))
        while 0 < taken < most and self._free.acquire(blocking=False):
            taken += 1
        return taken

    def watch(self, future: Future) -> None:
        """Give the task's place back when it is done, failed or cancelled."""
        when_done(future, self._done)

    def give_back(self, places: int) -> None:
        """Give places back for which no task was submitted after all."""
        self._free.release(places)

    def _done(self, _: Any) -> None:
        self._free.release()


# `Client.submit` keeps these for itself; a function that has one of them would not get it.
_OPTIONS_OF_SUBMIT = frozenset(
    parameter.name
    for parameter in inspect.signature(Client.submit).parameters.values()
    if parameter.kind is inspect.Parameter.KEYWORD_ONLY
    or parameter.default is not inspect.Parameter.empty
)


class Sender:
    """Sends tasks for one resource.

    Parameters
    ----------
    client
        Client of the cluster.
    resource
        Of which each task takes one slot.
    quota
        Limit to the tasks under way; None for no limit.
    """

    def __init__(self, client: Client, resource: str, quota: Quota | None = None) -> None:
        self.client, self.resource, self.quota = client, resource, quota
        self.most = sys.maxsize if quota is None else quota.slots  # tasks under way

    def send(
        self,
        function: Callable[..., Any],
        args: Sequence[Any],
        kwargs: Mapping[str, Any],
        *,
        key: str | None,
        priority: int,
        worker: str | None,
        retries: int,
    ) -> Future:
        """Submit one task; waits until the quota allows it."""
        if taken := sorted(_OPTIONS_OF_SUBMIT & kwargs.keys()):
            raise TypeError(
                f"{', '.join(taken)}: Client.submit has options of this name, so that "
                f"{function} would not get it: bind it with functools.partial. To give Dask the "
                f"option, use Client.submit(…, resources={{{self.resource!r}: 1}})."
            )
        if self.quota is not None:
            self.quota.take(1, wait=True)
        with self._giving_back(1):
            future = self.client.submit(
                function,
                *args,
                key=key,
                pure=False,
                priority=priority,
                retries=retries or None,
                resources={self.resource: 1},
                workers=None if worker is None else [worker],
                **kwargs,
            )
        if self.quota is not None:
            self.quota.watch(future)
        return future

    def send_many(
        self,
        function: Callable[..., Any],
        *columns: Sequence[Any],
        key: str,
        priority: int,
        retries: int,
        wait: bool,
    ) -> list[Future]:
        """Submit a task for each row of arguments, in one message, as far as the quota allows.

        One message for many tasks costs the scheduler less than half of one for each.

        Parameters
        ----------
        function, columns
            The function, and its arguments: columns of equal length, 1 or more.
        key
            What the tasks' keys start with.
        priority
            Higher runs first.
        retries
            How often a task that fails runs again.
        wait
            Whether to wait until the quota allows at least one.

        Returns
        -------
        list of Future
            For the first rows; possibly none.
        """
        count = len(columns[0])
        if self.quota is not None:
            count = self.quota.take(count, wait)
            if not count:
                return []
        with self._giving_back(count):
            futures: list[Future] = self.client.map(
                function,
                *(column[:count] for column in columns),
                key=key,
                pure=False,
                priority=priority,
                retries=retries or None,
                resources={self.resource: 1},
            )
        if self.quota is not None:
            for future in futures:
                self.quota.watch(future)
        return futures

    @contextmanager
    def _giving_back(self, places: int) -> Iterator[None]:
        """Give places of the quota back where nothing comes to be submitted.

        Dask refuses what cannot be called or pickled. Nobody would give those places back, and
        a later `send` would wait for them for ever.
        """
        try:
            yield
        except BaseException:
            if self.quota is not None:
                self.quota.give_back(places)
            raise
