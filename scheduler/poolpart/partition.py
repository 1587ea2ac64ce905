"""Partitions, which run tasks on workers that declare a Dask resource."""

from __future__ import annotations

import concurrent.futures
import inspect
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from contextvars import ContextVar
from functools import partial
from typing import Any, Literal, Self, overload

import dask
from dask.utils import funcname
from distributed import Client, Future

from .adapting import IDLE_S, JobBounds, request_slots
from .balancing import set_job_bounds
from .division import (
    call_steward,
    grow_partition,
    request_dissolution,
    resize_partition,
    shrink_partition,
)
from .errors import PoolError
from .extras.background import run_in_background
from .extras.cancelling import cancel_tasks
from .extras.dashboard_page import open_page
from .extras.notebook import table_of_partition
from .for_each import ItemTasks
from .internals.names import CANCELLING, CLIENTS, MAP, require_feature
from .internals.partition_client import PartitionClient, entered_partitions, whole_client
from .limits import limit_annotations
from .mapping import Results, Stage
from .membership import MemberName, register
from .partition_stats import PartitionStats
from .pipe import Pipe
from .pipe_states import USES_PIPES
from .rules import check_count, check_name
from .setups import StageSetup
from .stats import size_of, stats_of, tasks_of
from .task_context import own_client
from .task_table import TaskTable, to_datetime
from .worker_wait import WAIT_S
from .workers import WorkerInfo, all_workers, query_for_repr, run_on_scheduler

# Cleanup of the active `with partition:` blocks in this thread or coroutine, innermost last.
_entered: ContextVar[tuple[ExitStack, ...]] = ContextVar("_entered", default=())


class Partition:
    """Group of workers that declare the resource `name`. Its methods run tasks on these workers.

    Each task of a partition occupies a slot of the resource, and therefore runs only on these
    workers. The members are the workers that currently declare the resource, including restarted
    workers and workers that joined later.

    Parameters
    ----------
    name
        Name of the partition and of the resource.
    client
        Client of the cluster. By default, a task uses the client of its worker.
    note
        Note about the partition, for example that the pool has no GPUs. It is logged as a warning
        when a division creates the partition.
    by_rule
        ID of the scheduler on which a division of the pool has created the partition, or "". Such a
        partition can be dissolved, and is lost if the scheduler restarts.

    Notes
    -----
    If no worker declares the resource and none is expected, the first task logs a warning that
    lists the existing partitions. The task waits until a worker with the resource joins.

    Dask pickles the functions of a script with each task, and creates the global variables that
    they use anew each time. Pass a function that creates an expensive value as `setup` of `map` or
    `for_each`, or store the value in a module or as an attribute of ``distributed.get_worker()``.

    A partition can be passed to a task as an argument. In the task, it uses the client of the
    worker.

    If a task of a partition submits tasks with a `Client`, these tasks belong to the same
    partition, and each of them occupies a slot. The submitting task lends its own slot to other
    tasks while it waits for results. Release a `threading.Lock` before such a wait. Otherwise, a
    task that borrows the slot may wait for the lock, which causes a deadlock. A `distributed.Lock`
    can be held during the wait.

    Examples
    --------
    >>> gpu = Partition("GPU", client)                               # doctest: +SKIP
    >>> gpu.submit(pow, 2, 10).result()                              # doctest: +SKIP
    1024
    """

    def __init__(
        self, name: str, client: Client | None = None, note: str = "", by_rule: str = ""
    ) -> None:
        if name != "":  # only for the statistics of tasks without a partition
            check_name(name)
        self.name = name
        self.note = note
        self._client = None if client is None else whole_client(client)
        self.by_rule = by_rule

    def __reduce__(self) -> tuple[Any, ...]:
        return Partition, (self.name, None, self.note, self.by_rule)

    @property
    def client(self) -> Client:
        """Client that the partition uses."""
        # The client is not created during unpickling, which may happen in an event loop.
        if self._client is None:
            self._client = own_client()
        return self._client

    @property
    def workers(self) -> tuple[WorkerInfo, ...]:
        """Current members of the partition, sorted by name."""
        members = (w for w in all_workers(self.client) if w.resources.get(self.name))
        return tuple(sorted(members, key=lambda w: (len(w.name), w.name)))  # sorts 9 before 10

    @property
    def slots(self) -> int:
        """Maximum number of tasks that the partition can run at the same time."""
        return int(sum(worker.resources[self.name] for worker in self.workers))

    def __len__(self) -> int:
        return len(self.workers)

    def __repr__(self) -> str:
        size = self._size_in_words()
        return f"<Partition {self.name!r}: {size}>" if size else f"<Partition {self.name!r}>"

    def _size_in_words(self) -> str:
        """Describe the size of the partition, or return "" if the scheduler is unavailable."""
        return str(query_for_repr(self._client, size_of, name=self.name) or "")

    def _repr_html_(self) -> str:
        """Return the partition's statistics as an HTML table for notebooks."""
        return table_of_partition(lambda: self.client, repr(self), self.name)

    def stats(self) -> PartitionStats:
        """Return the partition's current load and its counts of finished tasks, for all clients.

        In a divided pool, counting begins with the division. In a partition whose workers were
        started with its resource, counting begins when a client submits its first task through
        `Partition`, or when this method is first called. `PartitionStats.since` contains the time
        when counting began.

        Raises
        ------
        PoolError
            If poolpart is not installed in the scheduler's environment.

        Examples
        --------
        >>> gpu.stats().running                                          # doctest: +SKIP
        4
        """
        stats: list[PartitionStats] = run_on_scheduler(self.client, stats_of, names=[self.name])
        return stats[0]

    def page(self) -> str:
        """Add a page to Dask's dashboard that shows this partition, and return its URL.

        The page shows the load, stages and workers of the partition, and the workers that
        `Pool.balance` has moved. See `Pool.page` for its visibility and lifetime.

        Raises
        ------
        PoolError
            If poolpart is not installed in the scheduler's environment, or if the scheduler has no
            HTTP server.

        Examples
        --------
        >>> gpu.page()                                                   # doctest: +SKIP
        'http://127.0.0.1:8787/partitions?partition=GPU'
        """
        return open_page(self.client, self.name)

    def tasks(self) -> TaskTable:
        """Return a table of the partition's tasks, for all clients.

        The table contains all unfinished tasks, and the last 1,000 tasks that have finished since
        counting began. See `stats` for the time when counting begins.

        Raises
        ------
        PoolError
            If poolpart is not installed in the scheduler's environment.

        Examples
        --------
        >>> [task.function for task in gpu.tasks() if task.state == "failed"]  # doctest: +SKIP
        ['cast']
        """
        rows, since = run_on_scheduler(self.client, tasks_of, name=self.name)
        return TaskTable.from_rows(rows, to_datetime(since))

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
        timeout_s: float | None = None,
        memory: str | float | None = None,
        **kwargs: Any,
    ) -> Future:
        """Submit a task to this partition's workers.

        Parameters
        ----------
        function, args, kwargs
            The function and its arguments. If an argument has the same name as an option of
            `Client.submit`, such as `key` or `workers`, pass it by position or use
            `functools.partial`.
        key
            Key of the task. By default, a new key is generated for each call, so identical calls
            run separately.
        priority
            Priority of the task among the tasks of the same client. Tasks with a higher priority
            run first. Clients take turns regardless of priorities.
        retries
            Maximum number of times that the task runs again after an error.
        slots
            Number of slots that the task occupies on a worker while it runs. The task lends its
            slots to other tasks of the partition while it waits for results.
        workers
            Name or address of the member that runs the task, or a list of them. Names are resolved
            to addresses when the task reaches the scheduler. If these workers leave or restart, the
            task waits forever.
        timeout_s
            Maximum running time in seconds, measured from the start of the task. A task that
            runs longer fails with `TaskTimeoutError`, or runs again on another worker if it has
            `retries` left. It is checked about twice a second. If the function does not return
            within 5 s, for example because it does not check `cancelled`, its worker is restarted
            under the conditions of ``cancel(running="restart")``. The first attempt waits up to a
            minute for other tasks on the worker to finish, and further attempts follow every 15 s.
            If the worker does not respond, its results may be computed again.
        memory
            Memory that the task holds on its worker while it runs, as a string such as "2 GiB" or
            as a number of bytes. The tasks on a worker hold at most its memory limit in total, so
            the task waits until a worker has enough. Workers without a memory limit do not run
            the task. While the task waits for nested tasks, they can use its memory. The memory
            that the task really uses is not limited.

        Returns
        -------
        Future
            Its `result` method raises `PoolError` if the partition was dissolved, if none of its
            workers has enough slots and memory, or if a worker in `workers` belongs to another
            partition. If the partition has no workers, the task waits for one.

        Raises
        ------
        ValueError
            If `slots` is below 1, if `timeout_s` or `memory` is not positive, or if `memory` has
            no valid unit.
        PoolError
            If the function is a coroutine function, or if a Dask option is passed that the
            partition sets itself. The client's first call waits for a
            response from the scheduler, and also raises the errors described for `result`. Later
            calls do not wait.

        Examples
        --------
        >>> gpu.submit(pow, 2, 10).result()                              # doctest: +SKIP
        1024
        """
        _check_function(self.name, function)
        _refuse_options("submit", kwargs, **_OF_TASKS)
        resources = self._resources_for(slots)
        if workers is not None:
            several = [workers] if isinstance(workers, str | int) else workers
            if not isinstance(several, Iterable):
                raise PoolError(
                    f"Invalid value {workers!r} for `workers`. Expected the name or address of a "
                    f"member of partition {self.name!r}, or a list of names and addresses."
                )
            # Names are converted to strings, because LocalCluster uses integers.
            workers = [MemberName(name) for name in several]
        annotations = limit_annotations(timeout_s, memory)
        if memory is not None and (kwargs.get("actor") or kwargs.get("actors")):
            raise PoolError("An actor cannot hold memory. Remove `memory`, or submit a task.")
        if pipes := _names_of_pipes([*args, *kwargs.values()]):
            annotations[USES_PIPES] = pipes
        with dask.annotate(**annotations) if annotations else nullcontext():
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

    def _resources_for(self, slots: int) -> dict[str, int]:
        """Validate the number of slots, and return the resources of a task.

        The client is registered for the partition, which may send a request to the scheduler.

        Raises
        ------
        PoolError
            If the client is asynchronous, because the request would block its event loop.
        """
        if not isinstance(slots, int) or slots is True or slots < 1:
            raise ValueError(
                f"Invalid value {slots!r} for `slots`. Expected an integer of at least 1."
            )
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
        timeout_s: float | None = None,
        memory: str | float | None = None,
        setup: Callable[[], Any] | None = None,
        **kwargs: Any,
    ) -> Results:
        """Call a function for each item, and return an iterator over the results.

        The iterables may be infinite, because items are submitted only while results are read, and
        the number of tasks in flight is limited. Small items are grouped into tasks according to
        their duration and size.

        If an iterable is the result of another map, workers fetch its results directly from each
        other, even if the partitions differ. The data does not pass through the client or the
        scheduler. Only one of the iterables can be chained in this way: the first map whose results
        have not been read yet.

        Parameters
        ----------
        function, iterables
            Function that is called with one item of each iterable, until the shortest iterable
            ends.
        ordered
            Whether to return results in the order of the items (True) or of completion (False).
        window
            Maximum number of tasks in flight. By default, the number is chosen so that workers do
            not have to wait for the client: two tasks for each slot or, if tasks are short, one
            second of work for each slot. Slots in the share of other clients do not count.
            The number doubles if workers and client have waited for each other, for example because
            the client computes between results. It is limited to 512 tasks and 64 MiB of items and
            results, and adapts to the number of slots.
        chunk
            Number of items per task. By default, a task contains as many items as take about a
            tenth of a second (longer if there are many slots), but at most 1 MiB of items and
            results. Pass 1 if processing times vary considerably, or if items must not wait for
            others.
        priority
            Priority of the tasks among the tasks of the same client, as in `submit`.
        retries
            Minimum number of times that a failed item is retried.
        slots
            Number of slots that each task occupies on a worker.
        return_exceptions
            Whether to return the errors of `function` in place of its results. A map over this map
            receives the errors as arguments. The result of an item that kills its workers is
            Dask's `KilledWorker`.
        empty_s
            Maximum time in seconds to wait while the partition has no workers, and no worker is
            starting, queued or requested by `adapt`. Pass `math.inf` to wait forever.
        timeout_s
            Maximum running time of each item in seconds, as in `submit`. Each task then has one
            item, as with ``chunk=1``.
        memory
            Memory that each task holds on its worker, as in `submit`. The items of a task are
            processed one after another, so it is the memory for one item, plus the results.
        setup
            Function without arguments, such as a function that loads a model. It is called once in
            each worker process, when the process runs the first task of the map, and `function`
            receives its result as the first argument, before the items. If a worker has several
            slots, its tasks use the same object at the same time. The process keeps the object
            until the map ends or is closed, or until the client disconnects. If Dask pauses the
            worker because of its memory usage, the object is released while no task uses it, and
            created again for the next task. An error of `setup` ends the map, unless `retries` are
            left.
        kwargs
            Keyword arguments that are passed to each call. Use `functools.partial` for arguments
            that have the name of an option. Scatter large arguments and pass the futures.

        Returns
        -------
        Results
            Iterator over the results. If `function` raises an error, the iterator first returns the
            earlier results, and then raises the error with a note that names the item. It raises
            `PoolError` if the partition is dissolved or has no workers for `empty_s` seconds, and
            `CancelledError` after `Client.restart`. To stop early, close or delete the iterator,
            which cancels waiting tasks. If all iterables have a length, so does the iterator, and
            progress bars such as ``tqdm(partition.map(…))`` work. `Results.done` is the number of
            results that have been read. Passing the iterator to ``client.gather`` returns an
            iterator over the same results.

        Raises
        ------
        ValueError
            If `window`, `chunk` or `slots` is below 1, if `retries` or `empty_s` is below 0, if
            `timeout_s` or `memory` is not positive, or if `timeout_s` is combined with a `chunk`
            above 1.
        PoolError
            If the partition was dissolved, if `function` or `setup` is a coroutine function, or if
            `pure` or `resources` is passed.

        Examples
        --------
        >>> sum(io.map(abs, range(-9, 0)))                               # doctest: +SKIP
        45
        >>> def detect(model, image):                                    # doctest: +SKIP
        ...     return model(image)
        >>> boxes = list(gpu.map(detect, images, setup=load_model))      # doctest: +SKIP
        """
        require_feature(MAP)
        _check_function(self.name, function)
        _refuse_options("map", kwargs, **_OF_MAPS)
        self._resources_for(slots)
        if timeout_s is not None and chunk not in (None, 1):
            raise ValueError(
                f"`chunk={chunk!r}` cannot be combined with `timeout_s`, which limits the running "
                "time of each item. Remove `chunk`."
            )
        stage = Stage(
            self.client,
            self.name,
            function,
            ordered=ordered,
            window=window,
            chunk=chunk if timeout_s is None else 1,
            priority=priority,
            retries=retries,
            slots=slots,
            return_exceptions=return_exceptions,
            keywords=kwargs,
            by_rule=self.by_rule,
            empty_s=empty_s,
            annotations=limit_annotations(timeout_s, memory),
            setup=StageSetup.from_user_value(setup),
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
        timeout_s: float | None = None,
        memory: str | float | None = None,
        setup: Callable[[], Any] | None = None,
        **kwargs: Any,
    ) -> int | concurrent.futures.Future[int]:
        """Run a task for each item of a pipe or iterable.

        This method returns when the pipe has been closed or the iterable is exhausted, and all
        tasks have finished. The number of tasks in flight is limited. Further items remain in the
        pipe, so producers wait if it is full. If a worker dies while it processes an item, the item
        is processed again on another worker. Several calls to `for_each` can share a pipe.

        This method does not close the pipes that the function puts items into. Close them after
        this method has returned or, with ``wait=False``, after its future has finished.

        Parameters
        ----------
        items, function
            Pipe or iterable, and the function that is called with each item. If an item is a
            future, the function receives its result. The return value of the function is discarded,
            but the function may put items into another pipe. The next item of an iterable is read
            only when a slot is free for it, and task errors are not raised before that. To process
            futures in order of completion, pass ``as_completed(futures)``.
        wait
            If False, return a future immediately. A thread of this process submits the tasks.
        window
            Maximum number of tasks in flight. By default, it is two for each slot outside the
            share of other clients, and increases to up to 16 for each slot if slots become idle
            before this process can submit further tasks. It adapts to the number of slots.
        priority, retries, slots, timeout_s, memory
            Options of each task, as in `submit`.
        empty_s
            Maximum time in seconds that tasks wait while the partition has no workers, as in `map`.
        setup
            Function without arguments that is called once in each worker process. The function
            receives its result as the first argument, before the item, as in `map`.
        kwargs
            Keyword arguments that are passed to each call. Use `functools.partial` for arguments
            that have the name of an option.

        Returns
        -------
        int or concurrent.futures.Future
            Number of items or, with ``wait=False``, a future for this number. ``future.cancel()``
            cancels the tasks that have not started and makes the pipe fail, so that its producers
            end. It returns False if all tasks have finished. The tasks continue if the future is
            deleted.

        Raises
        ------
        PipeFailed
            If the pipe fails or is deleted. Tasks that have not started are canceled.
        PoolError
            If the partition is dissolved, or has no workers for `empty_s` seconds while tasks wait.
            The pipe fails with this error.
        Exception
            The first error of the function, with a note that names the item. The pipe fails with
            the same error, so that its producers end, and tasks that have not started are canceled.
            With ``wait=False``, the future raises these errors.

        Examples
        --------
        >>> gpu.for_each(scans, cast, scene=scene)                       # doctest: +SKIP
        36
        >>> casting = gpu.for_each(scans, cast, wait=False)              # doctest: +SKIP
        >>> casting.result()                                             # doctest: +SKIP
        36
        """
        limit_annotations(timeout_s, memory)  # raises an error here rather than in a thread
        options = {
            "priority": priority,
            "retries": retries,
            "slots": slots,
            **kwargs,
            "timeout_s": timeout_s,
            "memory": memory,
        }
        _check_function(self.name, function)
        _refuse_options("for_each", kwargs, **_OF_MAPS)
        self._resources_for(slots)
        tasks = ItemTasks(
            self, items, function, window, options, empty_s, StageSetup.from_user_value(setup)
        )
        return tasks.run() if wait else run_in_background(tasks.run, tasks.stop)

    def cancel(
        self,
        futures: Future | Iterable[Future],
        *,
        running: Literal["continue", "restart"] = "continue",
        recompute: bool = False,
    ) -> dict[Any, str]:
        """Cancel tasks of this partition, and return the outcome for each task.

        Parameters
        ----------
        futures
            Future of a task, or several futures. Futures that have already been canceled are
            accepted.
        running
            How to handle tasks that are already running. With "continue", they keep their slots
            until their functions return, because Dask does not stop running functions. The
            functions can check `cancelled` to return early. With "restart", the nanny restarts each
            worker that runs only these tasks, and the worker returns to the partition. Its waiting
            tasks and its results move to other workers of the partition. A worker is not restarted
            if it runs another task, if it holds an actor or a result that cannot be copied, or if a
            waiting task may only run there. This also applies to a worker that does not respond
            within 5 s, for example because a function holds the global interpreter lock. If it is
            not restarted, it receives no tasks until it responds. The call returns after at most
            100 s, even if a restarted worker has not rejoined.
        recompute
            Whether workers may also be restarted if they run other tasks, or hold results that
            cannot be copied. These tasks run again. A worker that holds scattered data is
            not restarted, because the data cannot be computed again.

        Returns
        -------
        dict
            Mapping of task keys to strings that begin with one of the following words.
            ``cancelled``: the task will not run. ``ended``: the task had already finished, and its
            result was released, or its function has returned since it was canceled. ``running:
            …``: the task is still running, or may be running on a worker that does not respond. The
            string names the worker and the reason why it was not restarted. ``restarted: …``: the
            task's worker was restarted. ``kept: …``: another client needs the task's result.

        Raises
        ------
        ValueError
            If `running` is neither "continue" nor "restart", or if `recompute` is used without
            "restart".
        PoolError
            If a task belongs to another partition. In this case, no task is canceled.

        Examples
        --------
        >>> future = gpu.submit(time.sleep, 3600)                        # doctest: +SKIP
        >>> gpu.cancel(future, running="restart")                        # doctest: +SKIP
        {'sleep-1f3a': 'restarted: worker GPU-0'}
        """
        require_feature(CANCELLING)
        if running not in ("continue", "restart"):
            raise ValueError(
                f'Invalid value {running!r} for `running`. Expected "continue" or "restart".'
            )
        if recompute and running != "restart":
            raise ValueError('`recompute` requires `running="restart"`.')
        tasks = {}
        for task in [futures] if isinstance(futures, Future) else futures:
            if not isinstance(task, Future):
                raise PoolError(f"`Partition.cancel` expects Dask futures, but got {task!r}.")
            tasks[task.key] = task
        outcomes = {
            key: "ended" if task.status in ("finished", "error") else "cancelled"
            for key, task in tasks.items()
        }
        outcomes |= cancel_tasks(tasks, self.client, self.name, running == "restart", recompute)
        self.client.cancel(
            [task for key, task in tasks.items() if not outcomes[key].startswith("kept")]
        )
        return outcomes

    # -- collections and data ----------------------------------------------------------

    def compute(
        self,
        collections: Any,
        *,
        slots: int = 1,
        memory: str | float | None = None,
        **options: Any,
    ) -> Any:
        """Compute Dask collections, such as arrays, dataframes, bags, or delayed values.

        Each task of a collection occupies a slot. Rechunking and shuffling also stay on these
        workers. If a client still holds the result of a collection, Dask returns that result and
        does not compute it again.

        Parameters
        ----------
        collections
            Collection, or a list of collections.
        slots
            Number of slots that each task occupies.
        memory
            Memory that each task holds on its worker, as in `submit`.
        options
            Further options of `Client.compute`, such as ``sync=True`` to return the result instead
            of a future. To keep results on these workers, use ``with partition:`` and ``persist``.

        Returns
        -------
        Future or list of Future
            A future for each collection.

        Examples
        --------
        >>> total = io.compute(dask.array.ones(10**9).sum())             # doctest: +SKIP
        >>> total.result()                                               # doctest: +SKIP
        1000000000.0
        """
        _refuse_options("compute", options, resources=_SLOTS_INSTEAD)
        annotations = limit_annotations(None, memory)
        resources = self._resources_for(slots)
        with dask.annotate(**annotations) if annotations else nullcontext():
            return self.client.compute(collections, resources=resources, **options)

    def as_client(self) -> Client:
        """Return a client that only uses and shows the workers of this partition.

        Pass it to libraries that list workers or submit tasks themselves, such as ``xgboost.dask``,
        or call them in a ``with`` block. In the block, it is the current client of this thread,
        which libraries find with `get_client` and Dask collections use by default.

        All tasks that the client submits or computes take a slot of the partition. The methods
        `scheduler_info`, `nthreads`, `has_what`, `run`, `scatter`, `wait_for_workers` and others
        refer to the workers of the partition, and so do requests such as
        ``client.scheduler.identity()``. In the tasks, `get_client` and `worker_client` return such
        a client as well.

        Returns
        -------
        Client
            It shares the connection of this partition's client, and closing it has no effect. Both
            clients can use the same futures. It cannot restart or shut down the cluster, and its
            `cluster` is None.

        Raises
        ------
        PoolError
            If the tasks could never run, as described for `submit`, or if the installed version of
            Dask does not support such clients.

        Examples
        --------
        >>> with gpu.as_client() as client:                              # doctest: +SKIP
        ...     model = xgboost.dask.train(client, {"device": "cuda"}, data)
        """
        require_feature(CLIENTS)
        self._resources_for(1)
        return PartitionClient(self.client, self.name, partial(self._resources_for, 1))

    def scatter(self, data: Any, **options: Any) -> Any:
        """Scatter data into the memory of these workers, and return futures.

        Scattered data cannot be recomputed if its worker dies.

        Parameters
        ----------
        data
            Value, or a list or dict of values, as in `Client.scatter`.
        options
            Further options of `Client.scatter`, such as ``broadcast=True`` for a copy on each
            worker.

        Raises
        ------
        PoolError
            If the partition has no workers, or if `workers` is passed.

        Examples
        --------
        >>> [scene] = gpu.scatter([scene], broadcast=True)               # doctest: +SKIP
        """
        _refuse_options(
            "scatter", options, workers="The data is stored on the members of the partition."
        )
        addresses = [worker.address for worker in self.workers]
        if not addresses:  # Dask would interpret an empty list as any worker
            raise PoolError(f"Partition {self.name!r} has no workers to store the data.")
        return self.client.scatter(data, workers=addresses, **options)

    def __enter__(self) -> Self:
        """Within the block, run everything that is computed or submitted on these workers.

        In the current thread, this applies to `compute` and `persist` of Dask collections,
        including dataframes, to `dask.compute`, and to `Client.submit` and `Client.map` of this
        partition's client. Each task takes a slot.

        Only the place where a collection is computed matters. A dataframe that is created in the
        block and computed after it runs on any worker. If a client still holds a result of the
        collection, for example because it was persisted, Dask returns this result and runs nothing
        in the partition.

        Examples
        --------
        >>> with io:                                                     # doctest: +SKIP
        ...     total = dask.array.ones(10**9).sum().compute()
        """
        resources = self._resources_for(1)
        # Dask warns that dataframes ignore annotations when they are created. The warning is
        # suppressed, because annotations are applied when a dataframe is computed in this block.
        annotations = {"resources": resources}
        warnings.filterwarnings("ignore", re.escape(f"Dask annotations {annotations} detected."))
        with ExitStack() as stack:
            stack.enter_context(self.client.as_current())
            stack.enter_context(dask.annotate(resources=resources))
            outer = entered_partitions.get()
            entered_partitions.set((*outer, self.name))
            stack.callback(entered_partitions.set, outer)
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
        """Move workers into this partition while tasks are running, and return their names.

        A worker first finishes the tasks of its former partition that are already running. Its
        waiting tasks are moved to other members of that partition. If the rule of this partition is
        `n_workers`, the number in the rule increases accordingly. To restore the former size after
        a worker was lost, use `resize`.

        Workers that were started in this partition, or that its rule has selected, are moved first.
        They are followed by workers that the source has borrowed from other partitions, and then by
        the workers with the lowest load.

        Parameters
        ----------
        workers
            Number of workers to move.
        source
            Name of the partition to move workers from. By default, workers without a partition and
            workers of the partition with the rule `rest` are used.
        timeout_s
            Maximum time in seconds to wait until the workers are free.

        Raises
        ------
        PoolError
            If the source cannot provide enough workers without falling below its minimum, or if
            tasks do not finish in time. In the latter case, the workers stay in their partition.

        Examples
        --------
        >>> gpu.grow(2, source="OTHER")                                  # doctest: +SKIP
        ['5', '6']
        """
        arguments = {"count": workers, "source": source, "timeout_s": timeout_s}
        moved: list[str] = call_steward(self.client, grow_partition, name=self.name, **arguments)
        return moved

    def resize(
        self, workers: int, *, source: str | None = None, timeout_s: float = 60.0
    ) -> list[str]:
        """Set the number of workers in this partition, and return the names of those moved.

        Workers are moved into the partition as by `grow`, or out of it as by `shrink`.

        Parameters
        ----------
        workers
            New number of workers. If the rule of the partition is `n_workers`, it requests this
            number from now on. Other rules do not change, and continue to assign workers that join
            later.
        source
            Name of the partition to move workers from, as in `grow`.
        timeout_s
            Maximum time in seconds to wait until the workers are free.

        Raises
        ------
        PoolError
            If the number is below the minimum of the partition, if there are too few workers to
            spare, or if tasks do not finish in time. In the last case, the workers stay in their
            partition.

        Notes
        -----
        While its nanny restarts a worker, the worker's place in the partition is reserved for half
        a minute, and the worker counts as a member. If a worker is lost permanently, the rule
        `n_workers` still requests the original number, which `stats` reports as `target`. The
        vacant place is filled by the next worker that joins the cluster, or by a worker of the
        remainder that joined after the division. Other existing workers do not fill it
        automatically. ``resize(2)`` moves workers in until the partition has two. `grow` and
        `shrink` change the target by the number of workers that they move, so they do not fill the
        place either.

        Examples
        --------
        >>> gpu.resize(2)                                                # doctest: +SKIP
        ['5']
        """
        arguments = {"count": workers, "source": source, "timeout_s": timeout_s}
        moved: list[str] = call_steward(self.client, resize_partition, name=self.name, **arguments)
        return moved

    def shrink(self, workers: int = 1, *, timeout_s: float = 60.0) -> list[str]:
        """Move workers out of this partition while tasks are running, and return their names.

        Workers that this partition has borrowed leave first, and return to the partition in which
        they were started or for which a rule has selected them. Further workers, those with the
        lowest load first, are moved to the partition with the rule `rest`. If no other partition
        has this rule, they no longer belong to any partition. All workers first finish their tasks,
        as described for `grow`.

        Raises
        ------
        PoolError
            If fewer workers than the minimum would remain, or if tasks do not finish in time. The
            minimum is 0 for a partition that workers were started with.

        Examples
        --------
        >>> gpu.shrink()                                                 # doctest: +SKIP
        ['6']
        """
        arguments = {"count": workers, "timeout_s": timeout_s}
        moved: list[str] = call_steward(self.client, shrink_partition, name=self.name, **arguments)
        return moved

    # -- adaptive size -----------------------------------------------------------------

    def adapt(self, minimum: int, maximum: int, *, idle_s: float = IDLE_S) -> None:
        """Set the minimum and maximum number of jobs in an adaptive partition.

        Once per second, jobs are started for tasks that are ready to run but have no slot, and for
        slots that clients request with `request_slots`. A job that has not been needed for `idle_s`
        seconds is ended or, if it is still queued, canceled. A worker is kept as long as it has a
        task (even if the task has seceded), an actor, or the only copy of a result. A lost worker
        is replaced as long as there is work. For a fixed number of jobs, pass the same number as
        `minimum` and `maximum`.

        Parameters
        ----------
        minimum, maximum
            Minimum and maximum number of jobs. With a minimum of 0, the partition may be empty.
        idle_s
            Time in seconds after which a job that is not needed ends.

        Raises
        ------
        PoolError
            If the workers are not started by `start_partitions` or `scale_groups`, if the partition
            belongs to a balanced group, or if a number is invalid.

        Examples
        --------
        >>> gpu.adapt(0, 8)                                              # doctest: +SKIP
        """
        bounds = JobBounds.from_user_values(self.name, minimum, maximum, idle_s)
        if problem := run_on_scheduler(self.client, set_job_bounds, name=self.name, bounds=bounds):
            raise PoolError(problem)

    def request_slots(self, slots: int) -> bool:
        """Request slots on behalf of this client, and return whether the partition is adaptive.

        This method is intended for programs that assign each task to a specific worker, so that
        their tasks never wait for a slot. While slots are requested, jobs are started and kept as
        if tasks were waiting for the slots. The request ends with ``request_slots(0)`` or when the
        client closes. Tasks that wait for a slot do not need a request.

        Raises
        ------
        PoolError
            If the number is below 0.

        Examples
        --------
        >>> gpu.request_slots(4)                                                  # doctest: +SKIP
        True
        """
        check_count("the number of requested slots", slots, minimum=0)
        arguments = {"slots": slots, "client_id": self.client.id}
        return bool(run_on_scheduler(self.client, request_slots, name=self.name, **arguments))

    def dissolve(self, timeout_s: float = 30.0) -> None:
        """Dissolve this partition, as `Pool.dissolve` does for all partitions.

        Workers that this partition has borrowed return to the partition in which they were started
        or for which a rule has selected them. Other workers declare their original resources again.
        """
        request_dissolution(self.client, [self.name], timeout_s)


_SLOTS_INSTEAD = "To request several slots of the partition, pass `slots`."
_BOUND = " To pass an argument of this name to the function, use `functools.partial`."
# {Dask option that the partition sets itself: advice what to use instead}
_OF_TASKS = {
    "resources": _SLOTS_INSTEAD + _BOUND,
    "pure": "Each call runs separately, unless calls have the same `key`." + _BOUND,
    "setup": "Use `map` or `for_each`, which call `setup` once in each worker process." + _BOUND,
}
_OF_MAPS = {
    "resources": _SLOTS_INSTEAD + _BOUND,
    "pure": "The function is called for each item, even if items are equal." + _BOUND,
}


def _refuse_options(method: str, options: Mapping[str, Any], **instead: str) -> None:
    """Raise PoolError for Dask options that the partition itself sets."""
    for option, advice in instead.items():
        if option in options:
            raise PoolError(f"`Partition.{method}` does not accept `{option}`. {advice}")


def _names_of_pipes(arguments: Iterable[Any]) -> list[str]:
    """Return the names of the pipes among the arguments that fail if their task fails.

    Pipes in lists and tuples are included.
    """
    members = (a if isinstance(a, list | tuple) else [a] for a in arguments)
    pipes = (pipe for group in members for pipe in group if isinstance(pipe, Pipe))
    return [pipe.name for pipe in pipes if pipe.fails_with_tasks]


def _check_function(name: str, function: Callable[..., Any]) -> None:
    """Raise PoolError if a function is not callable, or is a coroutine function.

    A coroutine function runs in the worker's event loop, where it is unknown which task submits
    further tasks. Therefore, these tasks would not stay in the partition, and the coroutine could
    not lend its slot while it waits for them.
    """
    if not callable(function):
        raise PoolError(f"Partition {name!r} expects a callable, but got {function!r}.")
    if inspect.iscoroutinefunction(function):
        raise PoolError(
            f"Partition {name!r} only accepts plain functions, but {funcname(function)!r} is a "
            "coroutine function, whose nested tasks would leave the partition. Pass a function "
            "that calls `asyncio.run`."
        )
