"""A partition: the workers that declare one Dask resource, and work for them alone."""

from __future__ import annotations

import inspect
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from distributed import Client, Future, wait

from .backoff import Backoff
from .errors import PoolError
from .worker_info import WorkerInfo

# `Client.submit` keeps these for itself; a function that has one of them would not get it.
_OPTIONS_OF_SUBMIT = frozenset(
    parameter.name
    for parameter in inspect.signature(Client.submit).parameters.values()
    if parameter.kind is inspect.Parameter.KEYWORD_ONLY
    or parameter.default is not inspect.Parameter.empty
)


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
        Client of the cluster.
    note
        Something a user should know of it, such as that it had to do without GPUs.
    """

    def __init__(self, name: str, client: Client, note: str = "") -> None:
        self.name, self.client, self.note = name, client, note

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """The members now, by name."""
        identities = self.client.scheduler_info(n_workers=-1)["workers"]
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
            f"<Partition {self.name!r}: {len(names)} worker{'s' * (len(names) != 1)} "
            f"({shown}), {_slots(workers, self.name)} slots{note}>"
        )

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
                    f"Partition {self.name!r} has {there} of {n_workers} workers after "
                    f'{timeout_s} s: start some with dask worker … --resources "{self.name}=1"'
                )
            pause.sleep()

    def submit(
        self,
        function: Callable[..., Any],
        /,
        *args: Any,
        key: str | None = None,
        priority: int = 0,
        worker: str | None = None,
        **kwargs: Any,
    ) -> Future:
        """Submit one task to these workers.

        Parameters
        ----------
        function, args, kwargs
            What to call. Arguments named `key`, `priority` or like another option of
            `Client.submit` are not passed on by name: give them by position, or bind them
            with `functools.partial`.
        key
            The task's key; by default a new one, so that equal calls run each by itself.
        priority
            Higher runs first.
        worker
            Address of the one member to run on; if it leaves, the task waits for ever.

        Returns
        -------
        Future

        Raises
        ------
        TypeError
            If a keyword is an option of `Client.submit`.
        """
        if taken := sorted(_OPTIONS_OF_SUBMIT & kwargs.keys()):
            raise TypeError(
                f"{', '.join(taken)}: Client.submit has options of this name, so that "
                f"{function} would not get it; bind it with functools.partial."
            )
        return self.client.submit(
            function,
            *args,
            key=key,
            pure=False,
            priority=priority,
            resources={self.name: 1},
            workers=None if worker is None else [worker],
            **kwargs,
        )

    def map(
        self, function: Callable[..., Any], /, *iterables: Iterable[Any], priority: int = 0
    ) -> list[Future]:
        """Submit one task for each item, all at once; see `imap` for many items."""
        return [
            self.submit(function, *args, priority=priority)
            for args in zip(*iterables, strict=False)
        ]

    def imap(
        self,
        function: Callable[..., Any],
        items: Iterable[Any],
        window: int | None = None,
        ordered: bool = True,
    ) -> Iterator[Any]:
        """Results of `function` for each item, with a bounded number of tasks under way.

        Dask does not hold back tasks that need a resource, so mapping a long iterable at once
        would fill the workers with results that nobody has taken yet.

        Parameters
        ----------
        function
            Called with one item.
        items
            The items; taken as they are needed.
        window
            Tasks under way at most; twice the slots by default.
        ordered
            Results in the order of the items, or else as they come.

        Returns
        -------
        iterator
            Results. An error of a task is raised by it. Whoever stops early lets go of the
            tasks under way: those that have not started never do.

        Raises
        ------
        ValueError
            If the window is below 1.
        """
        if window is None:
            window = max(2, 2 * self.slots)
        if window < 1:
            raise ValueError(f"A window of {window} tasks is too small; give 1 or more.")
        futures = (self.submit(function, item) for item in items)
        return _in_order(futures, window) if ordered else _as_they_come(futures, window)


def _in_order(futures: Iterator[Future], window: int) -> Iterator[Any]:
    waiting: deque[Future] = deque()
    try:
        for future in futures:
            waiting.append(future)
            if len(waiting) >= window:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        waiting.clear()  # whoever keeps an error keeps this frame: do not keep tasks with it


def _as_they_come(futures: Iterator[Future], window: int) -> Iterator[Any]:
    # Not with `as_completed`: what it watches stays wanted when its user has stopped.
    running: set[Future] = set()
    try:
        for future in futures:
            running.add(future)
            if len(running) >= window:
                yield _pop_finished(running).result()
        while running:
            yield _pop_finished(running).result()
    finally:
        running.clear()


def _pop_finished(running: set[Future]) -> Future:
    done = next((future for future in running if future.done()), None)
    if done is None:
        done = next(iter(wait(running, return_when="FIRST_COMPLETED").done))
    running.remove(done)
    return done


def _slots(workers: Iterable[WorkerInfo], name: str) -> int:
    return int(sum(worker.resources[name] for worker in workers))


def _by_name(worker: WorkerInfo) -> tuple[int, str]:
    """Sort key that puts worker 10 behind worker 9."""
    return len(worker.name), worker.name
