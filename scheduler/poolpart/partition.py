"""A partition: the workers that declare one Dask resource, and the tasks for them."""

from __future__ import annotations

import asyncio
import concurrent.futures
import inspect
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from contextvars import ContextVar
from typing import Any, Literal, Self, overload

import dask
from dask.utils import funcname
from distributed import Client, Future

from .adapting import IDLE_S, Bounds, adapt, want
from .division import ask, ask_to_dissolve, grow, resize, shrink
from .errors import PoolError
from .extras.background import in_background
from .extras.cancelling import ask_to_cancel
from .extras.for_each import ItemTasks
from .extras.notebook import table_of_partition
from .internals.names import CANCELLING, MAP, require
from .mapping import Results, Stage
from .membership import MemberName, register
from .partition_stats import PartitionStats
from .pipe import Pipe
from .pipe_states import USES_PIPES
from .rules import check_count
from .stats import size_of, stats_of, tasks_of
from .task_context import own_client
from .task_table import TaskTable, moment
from .worker_wait import WAIT_S
from .workers import WorkerInfo, all_workers, on_scheduler

_REPR_S = 2.0  # longest wait of `repr` for the scheduler, seconds
# Exits of the `with partition:` blocks of this thread or coroutine, innermost last.
_entered: ContextVar[tuple[ExitStack, ...]] = ContextVar("_entered", default=())


class Partition:
    """The workers of a cluster that declare the resource `name`.

    Every task of a partition takes a slot of the resource, and so runs on these workers only. The
    members are the workers that declare the resource now, including restarted workers and workers
    that joined with the resource.

    Parameters
    ----------
    name
        Name of the partition and of the resource.
    client
        Client of the cluster. By default, in a task, the client of its worker.
    note
        A remark for users, such as that there were no GPUs. The division that makes the
        partition logs the note as a warning, once.
    by_rule
        Whether a division of the pool made it, so that it can be dissolved.

    Notes
    -----
    Functions of a script are sent with each task, and global variables of the script are new each
    time: keep a value that is expensive to build in a module, or as an attribute of
    ``distributed.get_worker()``.

    A partition can be an argument of a task, which then submits with the client of its worker.
    Tasks that a task of a partition submits to a `Client` belong to the same partition and take a
    slot each; the submitting task lends its own slot while it waits for results. Release a
    `threading.Lock` before such a wait: a task that borrows the slot may wait for the lock, and
    then neither task goes on. A `distributed.Lock` may be held.
    """

    def __init__(
        self, name: str, client: Client | None = None, note: str = "", by_rule: bool = False
    ) -> None:
        self.name = name
        self.note = note
        self._client = client
        self.by_rule = by_rule

    def __reduce__(self) -> tuple[Any, ...]:
        return Partition, (self.name, None, self.note, self.by_rule)

    @property
    def client(self) -> Client:
        """The client that is used."""
        # Not when unpickled: that happens in the event loops of scheduler and worker.
        if self._client is None:
            self._client = own_client()
        return self._client

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """The members now, by name."""
        members = (w for w in all_workers(self.client) if w.resources.get(self.name))
        return tuple(sorted(members, key=lambda w: (len(w.name), w.name)))  # sorts 10 behind 9

    @property
    def slots(self) -> int:
        """Tasks that the partition runs at a time."""
        return int(sum(worker.resources[self.name] for worker in self.workers))

    def __len__(self) -> int:
        return len(self.workers)

    def __repr__(self) -> str:
        size = self._size_in_words()  # without the note, which is logged when it is made
        return f"<Partition {self.name!r}: {size}>" if size else f"<Partition {self.name!r}>"

    def _size_in_words(self) -> str:
        """Return the number of workers and slots in words, or "" where nobody can be asked."""
        client = self._client  # none in a task that has not used the partition yet
        if client is None or client.asynchronous or client.status != "running":
            return ""
        with suppress(RuntimeError):  # no event loop runs in this thread
            if asyncio.get_running_loop() is client.loop.asyncio_loop:
                return ""
        try:
            return str(on_scheduler(client, size_of, name=self.name, answer_s=_REPR_S))
        except (PoolError, OSError):
            return ""

    def _repr_html_(self) -> str:
        """Return the table that notebooks show."""
        return table_of_partition(lambda: self.client, repr(self), self.name)

    def stats(self) -> PartitionStats:
        """Return the load and the number of finished tasks of the partition, for all clients.

        In a divided pool, tasks are counted since its division. In a partition that the workers
        were started with, they are counted since a client submitted its first task through
        `Partition`, or since this method was first called. `PartitionStats.since` is that time.

        Raises
        ------
        PoolError
            If the scheduler lacks this package.
        """
        stats: list[PartitionStats] = on_scheduler(self.client, stats_of, names=[self.name])
        return stats[0]

    def tasks(self) -> TaskTable:
        """Return the individual tasks of the partition, for all clients.

        The table has all unfinished tasks, and the last 1,000 tasks that have finished since
        counting began (see `stats`).

        Raises
        ------
        PoolError
            If the scheduler lacks this package.
        """
        rows, since = on_scheduler(self.client, tasks_of, name=self.name)
        return TaskTable.from_rows(rows, moment(since))

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
        workers: str | int | Sequence[str | int] | None = None,
        **kwargs: Any,
    ) -> Future:
        """Submit a task to the workers of this partition.

        Parameters
        ----------
        function, args, kwargs
            The call. Give arguments that have the name of an option of `Client.submit`, such as
            `key` or `workers`, by position, or bind them with `functools.partial`.
        key
            The task's key; by default a new one, so that equal calls run each by itself.
        priority
            Of tasks that wait for the same worker, those with higher priority run first.
        retries
            How often the task runs again if it fails.
        slots
            Slots of one worker that it takes while it runs. In a task of a partition they are
            lent to others while it waits for other tasks.
        workers
            Name or address of the member to run on, or a list of them. Names become the addresses
            that the members have when the task arrives: if these workers leave, or are started
            again, the task waits for ever.

        Returns
        -------
        Future
            Its `result` raises PoolError if the partition was dissolved, none of its workers has
            so many slots, or a worker belongs to another partition. Without any workers the task
            waits for one.

        Raises
        ------
        ValueError
            If `slots` is below 1.
        PoolError
            If the function is a coroutine function, or an option cannot be given; also, for the
            first task of a client, what `result` would raise. The first task waits for an answer
            of the scheduler, unless the client is asynchronous; later tasks do not.
        """
        _check_function(self.name, function)
        _refuse_options("submit", kwargs, **_OF_TASKS)
        asks = not self.client.asynchronous  # or it would wait for the answer in its event loop
        resources = self._taking(slots, asks)
        if workers is not None:
            several = [workers] if isinstance(workers, str | int) else workers
            if not isinstance(several, Iterable):
                raise PoolError(
                    f"The workers of a task are {workers!r}: give the name or address of a member "
                    f"of partition {self.name!r}, or a list of these."
                )
            # LocalCluster's are numbers.
            workers = [MemberName(name) if asks else str(name) for name in several]
        pipes = _names_of_pipes([*args, *kwargs.values()])
        with dask.annotate(**{USES_PIPES: pipes}) if pipes else nullcontext():
            return self.client.submit(
                function,
                *args,
                key=key,
                pure=False,
                priority=priority,
                retries=retries or None,
                resources=resources,
                workers=workers,
                **kwargs,
            )

    def _taking(self, slots: int, asks: bool = True) -> dict[str, int]:
        """Check and return the resources of a task.

        `asks` allows a request to the scheduler.
        """
        if not isinstance(slots, int) or slots < 1:
            raise ValueError(f"slots is {slots!r}; give a whole number, 1 or more.")
        if asks:
            self.by_rule = register(self.client, self.name, slots, self.by_rule)
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
        return_exceptions: bool = False,
        empty_s: float = WAIT_S,
        **kwargs: Any,
    ) -> Results:
        """Call a function for each item and return an iterator of the results.

        The number of items may be infinite: items are taken, and results fetched, while
        results are read, and a bounded number is under way. Small items share a task; their
        number is learned from their time and size.

        A map over the results of another map fetches them between workers, past driver and
        scheduler, even if the partitions differ. That holds for one unread map among the iterables.

        Parameters
        ----------
        function, iterables
            The function gets one item of each iterable, until the shortest ends.
        ordered
            Results in the order of the items, or as they complete.
        window
            Maximum number of tasks in flight. By default, enough that workers do not wait for the
            client: two tasks for each slot or, if tasks are short, as many as take one second.
            The number doubles when workers and client have waited for each other, as with a client
            that computes between results, up to 512 tasks and 64 MiB of items and results. It
            follows the number of slots.
        chunk
            Items in a task; by default as many as take a tenth of a second, or longer if there
            are many slots, and have a mebibyte. Give 1 if items differ much, or must not wait for
            others.
        priority
            Higher runs first.
        retries
            How often a failed item is tried again, at least.
        slots
            Slots of one worker that each task takes.
        return_exceptions
            Errors that `function` raises are results, in their places. A map over this map gets
            them as arguments. An item that kills its workers still ends the map.
        empty_s
            Seconds for which the map waits if the partition has no workers and none is starting,
            waiting in a queue, or added by `adapt`; `math.inf` for ever.
        kwargs
            Keyword arguments of each call. Bind those that have the name of an option with
            `functools.partial`; scatter large ones, and give the futures.

        Returns
        -------
        Results
            An iterator. It raises an error of `function` after the results before it; a note
            names the item. It raises PoolError if the partition is dissolved meanwhile or has no
            workers for `empty_s`, and CancelledError after `Client.restart`. To stop early, close
            or delete the iterator: waiting tasks are cancelled. ``len`` is the number of items if
            each iterable has one, so that progress bars such as ``tqdm(partition.map(…))`` work,
            and `Results.done` counts those read. ``client.gather`` of it is an iterator of the
            same results.

        Raises
        ------
        ValueError
            If the window, the chunk or `slots` is below 1, or `retries` or `empty_s` below 0.
        PoolError
            If the partition was dissolved, or the function is a coroutine function.
        """
        require(MAP)
        _check_function(self.name, function)
        self._taking(slots)
        stage = Stage(
            self.client,
            self.name,
            function,
            ordered=ordered,
            window=window,
            chunk=chunk,
            priority=priority,
            retries=retries,
            slots=slots,
            return_exceptions=return_exceptions,
            keywords=kwargs,
            by_rule=self.by_rule,
            empty_s=empty_s,
        )
        return Results(stage, iterables)

    @overload
    def for_each(
        self,
        items: Pipe | Iterable[Any],
        function: Callable[..., Any],
        /,
        *,
        wait: Literal[True] = ...,
        **options: Any,
    ) -> int: ...

    @overload
    def for_each(
        self,
        items: Pipe | Iterable[Any],
        function: Callable[..., Any],
        /,
        *,
        wait: Literal[False],
        **options: Any,
    ) -> concurrent.futures.Future[int]: ...

    def for_each(
        self,
        items: Pipe | Iterable[Any],
        function: Callable[..., Any],
        /,
        *,
        wait: bool = True,
        window: int | None = None,
        priority: int = 0,
        retries: int = 0,
        slots: int = 1,
        empty_s: float = WAIT_S,
        **kwargs: Any,
    ) -> int | concurrent.futures.Future[int]:
        """Call a function for each item of a pipe or an iterable, in a task each.

        It ends once the pipe is closed, or the iterable is at its end, and all tasks are done. A
        bounded number of tasks is under way. Further items wait in the pipe, so that producers wait
        when it is full. An item whose worker dies is run on another; several `for_each` may share a
        pipe.

        Pipes that the function puts into stay open. Close them when this method has returned or,
        without `wait`, when its future has a result.

        Parameters
        ----------
        items, function
            The function gets an item, or the result of a future that a `distributed.Queue` has
            put or an iterable has. Its result is dropped: it may put something into another pipe.
            The next item of an iterable is taken when a slot is free for it; an error of a task is
            noticed after that. ``as_completed(futures)`` is an iterable of futures as they end.
        wait
            False returns a future at once; a thread of this process submits the tasks.
        window
            Maximum number of tasks in flight. By default two for each slot, and more if slots
            become idle before this process can submit the next tasks, up to 16 for each slot. The
            default follows the number of slots.
        priority, retries, slots
            Of each task, as in `submit`.
        empty_s
            Seconds for which tasks wait for a partition without workers, as in `map`.
        kwargs
            Keyword arguments of each call. Bind those that have the name of an option with
            `functools.partial`.

        Returns
        -------
        int or concurrent.futures.Future
            Number of items, or without `wait` a future of this number. ``future.cancel()`` cancels
            the tasks that have not started, and the pipe fails, so that producers end. It returns
            False once all is done. The tasks go on if the future is dropped.

        Raises
        ------
        PipeFailed
            If the pipe was failed or deleted. Tasks that have not started are cancelled.
        PoolError
            If the partition is dissolved meanwhile, or has no workers for `empty_s` while tasks
            wait. The pipe fails with it.
        Exception
            What the function raises first; a note names the item. The pipe fails with it, so that
            producers end, and tasks that have not started are cancelled. Without `wait`, the future
            has these errors.

        Examples
        --------
        >>> gpu.for_each(scans, cast, scene=scene)                       # doctest: +SKIP
        36
        >>> casting = gpu.for_each(scans, cast, wait=False)              # doctest: +SKIP
        >>> casting.result()                                             # doctest: +SKIP
        36
        """
        options = {"priority": priority, "retries": retries, "slots": slots, **kwargs}
        _check_function(self.name, function)
        _refuse_options("for_each", kwargs, **_OF_TASKS)
        self._taking(slots)
        tasks = ItemTasks(self, items, function, window, options, empty_s)
        return tasks.run() if wait else in_background(tasks.run, tasks.stop)

    def cancel(
        self,
        futures: Future | Iterable[Future],
        *,
        running: Literal["continue", "restart"] = "continue",
    ) -> dict[Any, str]:
        """Cancel tasks of this partition and return what happened to each.

        Parameters
        ----------
        futures
            Futures of the tasks. Futures that were cancelled before are accepted.
        running
            What to do with tasks that run. Dask does not stop them: they keep their slot until
            their function returns, which can look whether it was `cancelled`. With "restart", a
            worker that runs nothing but such tasks is restarted by its nanny, and comes back to
            the partition. A worker is never restarted if it has another task, an actor, or a
            result that no other worker has. Neither is a worker that does not answer within 5 s,
            for instance because a function holds the interpreter lock. The call returns after 80 s
            at the latest, even if a restarted worker has not come back.

        Returns
        -------
        dict
            {key: what happened}. Each text begins with one of these words. ``cancelled``: the task
            will not run. ``ended``: it had ended before, and its result is gone. ``running: …``: it
            still runs, or may run on a worker that does not answer; the text names the worker and
            the reason why it was not restarted. ``restarted: …``: its worker was restarted.
            ``kept: …``: another client wants its result.

        Raises
        ------
        PoolError
            If a task is of another partition; then nothing is cancelled.

        Examples
        --------
        >>> future = gpu.submit(time.sleep, 3600)                        # doctest: +SKIP
        >>> gpu.cancel(future, running="restart")                        # doctest: +SKIP
        {'sleep-1f3a': 'restarted: worker GPU-0'}
        """
        require(CANCELLING)
        if running not in ("continue", "restart"):
            raise ValueError(f'running is {running!r}; give "continue" or "restart".')
        tasks = {}
        for task in [futures] if isinstance(futures, Future) else futures:
            if not isinstance(task, Future):
                raise PoolError(f"Partition.cancel takes futures of Dask, not {task!r}.")
            tasks[task.key] = task
        outcomes = {
            key: "ended" if task.status in ("finished", "error") else "cancelled"
            for key, task in tasks.items()
        }
        outcomes |= ask_to_cancel(tasks, self, running == "restart")
        self.client.cancel(
            [task for key, task in tasks.items() if not outcomes[key].startswith("kept")]
        )
        return outcomes

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
            Others of `Client.compute`, such as ``sync=True`` for the result instead of a future.
            To keep results on these workers, use ``with partition:`` and ``persist``.

        Returns
        -------
        Future or list of Future

        Examples
        --------
        >>> total = io.compute(dask.array.ones(10**9).sum())             # doctest: +SKIP
        >>> total.result()                                               # doctest: +SKIP
        1000000000.0
        """
        _refuse_options("compute", options, resources=_SLOTS_INSTEAD)
        return self.client.compute(collections, resources=self._taking(slots), **options)

    def scatter(self, data: Any, **options: Any) -> Any:
        """Put data into the memory of these workers and return futures.

        Scattered data cannot be recomputed when its worker dies.

        Parameters
        ----------
        data
            As `Client.scatter` takes it: a value, a list or a dict of values.
        options
            Others of `Client.scatter`, such as ``broadcast=True`` for a copy on each worker.

        Raises
        ------
        PoolError
            If the partition has no workers, or `workers` is given.
        """
        _refuse_options("scatter", options, workers="the data is put on members of the partition")
        addresses = [worker.address for worker in self.workers]
        if not addresses:  # Dask would take any worker
            raise PoolError(f"Partition {self.name!r} has no workers to keep data.")
        return self.client.scatter(data, workers=addresses, **options)

    def __enter__(self) -> Self:
        """Run everything that is computed or submitted in the block on these workers.

        This covers `compute` and `persist` of Dask collections, including dataframes,
        `dask.compute`, and `Client.submit` and `Client.map` of this partition's client, in this
        thread. Each task takes a slot. A dataframe that is created in the block and computed after
        it runs on any worker.

        Examples
        --------
        >>> with io:                                                     # doctest: +SKIP
        ...     total = dask.array.ones(10**9).sum().compute()
        """
        resources = self._taking(1)
        # Dataframes ignore annotations when they are created, and Dask warns of it once. It does
        # apply annotations to all tasks when they are computed, as in this block.
        annotations = {"resources": resources}
        warnings.filterwarnings("ignore", re.escape(f"Dask annotations {annotations} detected."))
        with ExitStack() as stack:
            stack.enter_context(self.client.as_current())
            stack.enter_context(dask.annotate(resources=resources))
            _entered.set((*_entered.get(), stack.pop_all()))
        return self

    def __exit__(self, *_: object) -> None:
        *outer, stack = _entered.get()
        _entered.set(tuple(outer))
        stack.close()

    # -- moving workers ----------------------------------------------------------------

    def grow(
        self, workers: int = 1, *, source: str | None = None, timeout_s: float = 60.0
    ) -> list[str]:
        """Move workers into this partition while everything runs, and return their names.

        Tasks of the former partition that a worker runs end there first, and its waiting tasks
        go to other members. If this partition's rule is `n_workers`, its number grows too. After
        the loss of a worker, use `resize` to return to the former size.

        Parameters
        ----------
        workers
            How many.
        source
            Name of the partition that they leave; by default they come from workers without a
            partition and from the partition that has the rest.
        timeout_s
            How long to wait until they are free.

        Raises
        ------
        PoolError
            If there are too few, beyond the minimum of `source`; or if tasks do not end in time. In
            the latter case their workers stay.

        Examples
        --------
        >>> gpu.grow(2, source="OTHER")                                # doctest: +SKIP
        ['5', '6']
        """
        arguments = {"count": workers, "source": source, "timeout_s": timeout_s}
        moved: list[str] = ask(self.client, grow, name=self.name, **arguments)
        return moved

    def resize(
        self, workers: int, *, source: str | None = None, timeout_s: float = 60.0
    ) -> list[str]:
        """Give this partition a number of workers, and return the names of the workers that moved.

        Workers move in as with `grow`, or out as with `shrink`.

        Parameters
        ----------
        workers
            Number of workers that the partition should have. If its rule is `n_workers`, the rule
            asks for this number from now on. Other rules stay as they are, and assign workers that
            join later.
        source
            Name of the partition that workers leave, as in `grow`.
        timeout_s
            How long to wait until they are free.

        Raises
        ------
        PoolError
            If the number is below the minimum of the partition, there are too few spare workers, or
            tasks do not end in time. In the last case their workers stay.

        Notes
        -----
        A worker that its nanny restarts keeps its place for half a minute, and counts as a member.
        If a worker is lost for good, the rule `n_workers` still asks for the former number: `stats`
        has it as `target`, and the next worker that joins the cluster fills the place. Present
        workers of other partitions do not fill it by themselves, unless they joined later and went
        to the rest; ``resize(2)`` moves workers in until there are two. `grow` and `shrink` change
        the target by the number of workers that they move: after a loss, they do not fill the place
        either.

        Examples
        --------
        >>> gpu.resize(2)                                              # doctest: +SKIP
        ['5']
        """
        arguments = {"count": workers, "source": source, "timeout_s": timeout_s}
        moved: list[str] = ask(self.client, resize, name=self.name, **arguments)
        return moved

    def shrink(self, workers: int = 1, *, timeout_s: float = 60.0) -> list[str]:
        """Move workers out of this partition while everything runs, and return their names.

        They go to the partition that has the rest, or to none, as described for `grow`. Those
        with the least load go first.

        Raises
        ------
        PoolError
            If fewer than its minimum would be left, or their tasks do not end in time.
        """
        arguments = {"count": workers, "timeout_s": timeout_s}
        moved: list[str] = ask(self.client, shrink, name=self.name, **arguments)
        return moved

    # -- workers that come and go ------------------------------------------------------

    def adapt(self, minimum: int, maximum: int, *, idle_s: float = IDLE_S) -> None:
        """Let the number of jobs follow the work, of `start_partitions` or `scale_groups`.

        Jobs are started for tasks that can run and have no slot, second by second, and for what
        clients `want`. One is returned, or cancelled while it waits in the queue, when it was not
        needed for `idle_s`: a worker with a task, also one that has seceded, with a result that no
        other worker has, or with an actor is kept. A lost worker is replaced while there is work.
        Two equal numbers fix the number of jobs.

        Parameters
        ----------
        minimum, maximum
            Least and greatest number of jobs. With a minimum of 0 the partition may be empty.
        idle_s
            After so many seconds without need a job ends.

        Raises
        ------
        PoolError
            If neither `start_partitions` nor `scale_groups` starts the workers, or the numbers are
            not possible.

        Examples
        --------
        >>> gpu.adapt(0, 8)                                            # doctest: +SKIP
        """
        bounds = Bounds.checked(self.name, minimum, maximum, idle_s)
        if not on_scheduler(self.client, adapt, name=self.name, bounds=bounds):
            raise PoolError(
                f"Partition {self.name!r} has no jobs that can be started: only partitions of "
                "start_partitions and scale_groups adapt. Those of a divided pool grow by "
                "Partition.grow."
            )

    def want(self, slots: int) -> bool:
        """Say how many slots this client wants, and return whether the number of workers adapts.

        For a program that chooses a worker for each task and so has none waiting: as long as it
        wants slots, jobs are started as if tasks waited for them, and kept. 0 ends it, and so does
        the end of the client. Tasks that wait need no such word.

        Raises
        ------
        PoolError
            If the number is below 0.

        Examples
        --------
        >>> gpu.want(4)                                                # doctest: +SKIP
        True
        """
        check_count("The number of slots that are wanted", slots, minimum=0)
        asking = {"slots": slots, "asking": self.client.id}
        return bool(on_scheduler(self.client, want, name=self.name, **asking))

    def dissolve(self, timeout_s: float = 30.0) -> None:
        """Undo this partition, as `Pool.dissolve` does."""
        ask_to_dissolve(self.client, [self.name], timeout_s)


_SLOTS_INSTEAD = "slots=2 takes two slots of the partition"
_BOUND = "; bind an argument of the function that has this name by functools.partial"
# {option of Dask that `submit` sets: what to give instead}
_OF_TASKS = {
    "resources": _SLOTS_INSTEAD + _BOUND,
    "pure": "each call runs by itself, unless calls have the same key" + _BOUND,
}


def _refuse_options(method: str, options: Mapping[str, Any], **instead: str) -> None:
    """Raise PoolError if options of Dask were given that the partition sets itself."""
    for option, advice in instead.items():
        if option in options:
            raise PoolError(f"Partition.{method} sets {option} itself: {advice}.")


def _names_of_pipes(arguments: Iterable[Any]) -> list[str]:
    """Return the names of pipes among arguments, or in lists, that fail with their tasks."""
    members = (a if isinstance(a, list | tuple) else [a] for a in arguments)
    pipes = (pipe for group in members for pipe in group if isinstance(pipe, Pipe))
    return [pipe.name for pipe in pipes if pipe.fails_with_tasks]


def _check_function(name: str, function: Callable[..., Any]) -> None:
    """Raise if a function would run in the event loop of a worker, or cannot be called.

    Nobody knows there which task submits something, so that the tasks which a coroutine submits
    would leave the partition; and a coroutine cannot lend its slot while it waits for them.
    """
    if not callable(function):
        raise PoolError(f"A task of partition {name!r} needs a function, not {function!r}.")
    if inspect.iscoroutinefunction(function):
        raise PoolError(
            f"Partition {name!r} takes plain functions, and {funcname(function)} is a coroutine "
            "function, whose tasks would leave the partition: give a function that calls "
            "asyncio.run."
        )
