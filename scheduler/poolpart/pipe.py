"""Pipes between tasks, which are bounded and can be closed.

A pipe consists of a `distributed.Queue` with the items and a `distributed.Variable` with the state,
both under the name of the pipe. `pipe_states.py` is the scheduler's side. Any client can inspect
both, put and get items with `Queue(name)`, and close the pipe with `Variable(name)`.

`Pipe.put` and `Pipe.get` send the scheduler special requests. A request waits on the scheduler for
at most one second and is then repeated. Therefore, no item is sent to a process that was killed
while it was waiting. If a process was stopped or disconnected, at most the items of one second are
lost.

A pipe ends with the client that created it, even if the client was killed. Otherwise, tasks at both
ends would wait forever and keep their slots, because Dask does not stop the threads of tasks whose
client has left.
"""

from __future__ import annotations

import asyncio
import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice
from typing import Any
from weakref import WeakKeyDictionary

from distributed import Client, Future
from distributed.protocol.pickle import dumps

from .errors import PipeClosed, PipeFailed
from .extras.listening import PipeListener
from .extras.notebook import table_of_pipe
from .internals.client import send_request
from .internals.names import PIPES, require_feature
from .internals.partition_client import whole_client
from .internals.queues import Packed, unpack_item
from .internals.worker import current_task, start_time_of_task
from .pipe_states import (
    CHANGE,
    PUT,
    TAKE,
    Replies,
    Reply,
    create_pipe,
    delete_existing_pipes,
    describe_pipe,
    install_pipe_handlers,
)
from .task_context import own_client
from .workers import check_client, query_for_repr, run_on_scheduler

WAIT_S = 1.0  # maximum wait of a request, which ends early if the pipe is closed or fails
_AGAIN_S = 0.01  # interval between the requests of one wait
_LINGER_S = 0.002  # time that `get` waits for further items to reduce the number of requests


class Pipe:
    """Bounded first-in, first-out pipe between tasks that can be closed and can fail.

    The creator of the pipe calls `create`, passes the pipe to the tasks at both ends, and finally
    calls `delete`. A ``with`` block calls both methods. The pipe is also deleted when its creator's
    client closes or dies. A pickled pipe is small, because it does not contain the items. Any
    number of producers and consumers can share a pipe across processes and threads, and threads can
    share the same `Pipe` object. With several `producers`, the pipe is closed once each of them has
    called `close`.

    Parameters
    ----------
    name
        Name of the pipe, which must be unique on the cluster. Include a random part.
    capacity
        Maximum number of queued items. While the pipe is full, `put` waits. Each consumer may hold
        as many items again, because it takes all queued items with one request.
    client
        Client to use. By default, a task uses the client of its worker.
    producers
        Number of producers. Each producer calls `close` when it has finished.
    fails_with_tasks
        Whether the pipe fails if a task that received it as an argument is lost. Pass False if the
        program resubmits lost tasks.
    drop_repeats
        Whether to drop the items that a task sends again when Dask runs it again, for example
        because its worker has died. See "Repeated items" below.

    Notes
    -----
    **Failures.** After `fail`, every `put` raises `PipeFailed`. `get` first returns the items that
    this object has already fetched, and then raises the error. Calls that are waiting raise the
    error within a second. If a pipe does not exist or was deleted, all methods raise `PipeFailed`,
    including `close` and `fail`. If the scheduler has died, calls raise `OSError` after the Dask
    timeout ``distributed.comm.timeouts.connect``. If the scheduler does not respond, they raise
    `OSError` after five minutes.

    An open pipe also fails if a task that uses it is lost, because the tasks at the other end would
    otherwise wait forever. This applies to tasks that receive the pipe as an argument of
    `Partition.submit` or `Partition.for_each`, directly or in a list. The pipe fails if such a task
    fails after all retries, or if it is canceled before it has used the pipe, for example because
    its future was not kept. Canceling does not stop a running task, so the task can continue to use
    the pipe. If `Partition.cancel` restarts the task's worker, the pipe fails, unless the task is a
    consumer. A task that Dask runs again because its worker has died does not affect the pipe.
    Neither does a task that returns without calling `close`, because other producers may follow.
    After `Client.restart`, all open pipes of the cluster fail.

    **Items in flight.** A consumer fetches all queued items, up to about `capacity`, in one
    request. `get` and iteration return them one by one. At most ``capacity * (1 + consumers)``
    items are in flight. If items are slow to process and there are several consumers, choose a
    small capacity, so that no consumer holds unprocessed items while another consumer is idle.

    **Lost items.** Items that a `Pipe` object has fetched but not yet returned are lost if its
    process dies or the object is deleted, for example if a task leaves the loop with `break` and
    returns. To process each item exactly once, record which items have arrived, and put missing
    items again. If an item cannot be unpickled, the error is raised in place of the item, which is
    lost. Later items are not affected. If a wait is interrupted, for example by Ctrl-C, no item is
    lost, because an item that arrives within the next second is kept in the object for its next
    `get`. If an event loop stops awaiting a thread (`asyncio.to_thread`), the thread continues to
    wait, and the item that it receives is lost. To limit this wait, pass `timeout_s`.

    **Repeated items.** If Dask runs a producer again, the task sends its items from the beginning.
    The pipe numbers the items of each task, and drops an item if an earlier run of the task has
    sent an item with the same number and the same pickled content. Each item of a producer that
    sends the same items in the same order is therefore accepted once. If a run sends a different
    item, this item and all later items of the run are accepted, and a warning is logged on the
    scheduler. Items are not dropped if the task also takes items from a pipe, or if they are sent
    outside of tasks or from a thread that a task has started. Pass ``drop_repeats=False`` if equal
    items of different runs are distinct, for example measurements of a live sensor.

    **Order.** Each object returns items in the order in which they were put. Threads that share an
    object receive the items in any order.

    **Queue and Variable.** Any client can use Dask's ``Queue(pipe.name)`` and
    ``Variable(pipe.name)``. The queue contains the items of the pipe in the same order and has the
    same capacity. Its `put` and `get` methods also raise `PipeClosed` and `PipeFailed`. Unlike
    `Pipe.get`, `Queue.get` loses an item if its client is killed while it waits, because the
    scheduler cannot determine which client has sent the request. If the pipe ends before
    ``Queue.get(batch=5)`` has received five items, it raises an error, and the items that it has
    received are lost. Use ``batch=True``, which does not wait.

    The variable contains the state, a `poolpart.pipe_states.PipeState`.
    ``variable.set({**variable.get(), "closed": True})`` closes the pipe. Setting a value that is
    not a valid successor of the current state raises `ValueError`, and so does a value that is
    based on an outdated state. In the latter case, read the variable and set it again. Calling
    ``Variable.delete``, or releasing the last reference to the queue, deletes the pipe.

    Examples
    --------
    >>> from distributed import Client
    >>> client = Client(processes=False, dashboard_address=None)
    >>> with Pipe("numbers-1f3a", capacity=3, client=client) as pipe:
    ...     pipe.put((1, 2)); pipe.put("three"); pipe.close()
    ...     list(pipe)
    [(1, 2), 'three']
    >>> client.close()
    """

    def __init__(
        self,
        name: str,
        capacity: int = 16,
        client: Client | None = None,
        producers: int = 1,
        *,
        fails_with_tasks: bool = True,
        drop_repeats: bool = True,
    ) -> None:
        if not isinstance(name, str) or not name:
            raise ValueError(f"Invalid name {name!r} of a pipe. Expected a string.")
        options = {"fails_with_tasks": fails_with_tasks, "drop_repeats": drop_repeats}
        for option, value in options.items():
            if not isinstance(value, bool):
                raise ValueError(
                    f"Invalid value {value!r} for `{option}` of pipe {name!r}. Expected True or "
                    "False."
                )
        for quantity, number in (("capacity", capacity), ("number of producers", producers)):
            if not isinstance(number, int) or number is True or number < 1:
                raise ValueError(
                    f"Invalid value {number!r} for the {quantity} of pipe {name!r}. Expected an "
                    "integer of at least 1."
                )
        self.name = name
        self.capacity = capacity
        self.producers = producers
        self.fails_with_tasks = fails_with_tasks
        self.drop_repeats = drop_repeats
        self._client = None if client is None else whole_client(client)
        # Items that were fetched from the scheduler but not returned yet. The client's event loop
        # appends them, and threads that share this object remove them.
        self._buffer: deque[Packed] = deque()
        self._advice: int | None = None  # advice in the last reply

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = (self.name, self.capacity, None, self.producers)
        make = partial(Pipe, fails_with_tasks=self.fails_with_tasks, drop_repeats=self.drop_repeats)
        return make, arguments

    def __repr__(self) -> str:
        state = self._state_in_words()
        return f"<Pipe {self.name!r}: {state}>" if state else f"<Pipe {self.name!r}>"

    def _state_in_words(self) -> str:
        """Describe the state of the pipe, or return "" if the scheduler is unavailable."""
        return str(query_for_repr(self._client, describe_pipe, name=self.name) or "")

    def _repr_html_(self) -> str:
        """Return an HTML table with the pipe's depth, capacity, and state for notebooks."""
        return table_of_pipe(lambda: self.client, repr(self), self.name)

    @property
    def client(self) -> Client:
        """Client that the pipe uses."""
        # The client is stored, because a seceded thread would get a new client on each access.
        if self._client is None:
            self._client = own_client()
        return self._client

    # -- creating and deleting ---------------------------------------------------------

    def create(self) -> Pipe:
        """Create the pipe on the scheduler, and return this object.

        Raises
        ------
        ValueError
            If the cluster already has a queue or a variable with this name.
        PoolError
            If the installed version of Dask does not support pipes.
        """
        require_feature(PIPES)
        client = self.client
        state = {
            "owner": client.id,
            "capacity": self.capacity,
            "producers": self.producers,
            "drop_repeats": self.drop_repeats,
        }
        if not run_on_scheduler(client, create_pipe, name=self.name, **state):
            raise ValueError(
                f"The cluster already has a queue or variable named {self.name!r}. Choose another "
                "name for the pipe, or delete an earlier pipe of this name."
            )
        return self

    def delete(self) -> None:
        """Delete the pipe and its items from the scheduler, if the pipe exists."""
        delete_pipes(self.client, [self.name])

    def __enter__(self) -> Pipe:
        return self.create()

    def __exit__(self, *_: object) -> None:
        self.delete()

    def _reply(self, replies: Replies) -> Reply:
        """Return the reply for this pipe, and remember the advice in it.

        A reply contains the state of the pipe (`closed`, `failure`, `advice`) and the `answer` to
        the request: the number of queued items (CHANGE), the number of items that were put (PUT),
        or a list of packed items (TAKE).

        Raises
        ------
        PipeFailed
            If the pipe does not exist.
        """
        if self.name not in replies:
            raise PipeFailed(f"Pipe {self.name!r} does not exist. It was deleted or never created.")
        reply = replies[self.name]
        self._advice = reply["advice"]
        return reply

    def _change(self, **changes: Any) -> Reply:
        """Change the pipe's state on the scheduler, and return the reply with the new state.

        The possible changes are `producer` (the ID of a producer that closes the pipe), `failure`
        and `advice`. Without changes, the reply contains the current state.
        """
        return self._reply(_ask(self.client, CHANGE, names=[self.name], **changes))

    def _ask_until(
        self,
        deadline: float,
        is_settled: Callable[[Reply], Any],
        handler: str,
        on_reply: Callable[[Reply], None] = lambda reply: None,
        **arguments: Any,
    ) -> Reply:
        """Repeat a request until the wait is over, and return the last reply.

        Parameters
        ----------
        deadline
            Value of `time.monotonic` at which the wait ends. If it is -inf, the request is sent
            once and does not wait.
        is_settled
            Function that returns whether a reply ends the wait. The wait also ends if the pipe was
            closed, has failed or does not exist.
        handler
            PUT or TAKE. `arguments` are the arguments of this request of
            `pipe_states.PipeRegistry`.
        on_reply
            Function that is called with each reply in the client's event loop, even if this thread
            has been interrupted.
        """

        def has_settled_reply(replies: Replies) -> bool:
            reply = replies.get(self.name)
            return reply is None or bool(reply["failure"] or reply["closed"] or is_settled(reply))

        def pass_on(replies: Replies) -> None:
            if self.name in replies:
                on_reply(replies[self.name])

        options = {"names": [self.name], "task": _key_of_task(), **arguments}
        return self._reply(
            _ask_until(self.client, deadline, has_settled_reply, handler, pass_on, **options)
        )

    # -- both ends ---------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Current number of items in the pipe."""
        return int(self._change()["answer"])

    def close(self) -> None:
        """Close the pipe on behalf of a producer.

        Once all producers have closed the pipe, it accepts no more items, and consumers end after
        they have received the remaining items. With several `producers`, each task counts as one
        producer, even if it runs again. Outside of tasks, each call counts as one producer.
        """
        self._change(producer=_producer())

    def fail(self, reason: str) -> None:
        """Make the pipe fail, so that each `put` or `get` at either end raises `PipeFailed`.

        If the pipe has already failed, the first reason is kept.

        Parameters
        ----------
        reason
            Message of the error.
        """
        self._change(failure=reason or "No reason was given.")

    # -- producers ---------------------------------------------------------------------

    def put(self, item: Any, timeout_s: float | None = None, *, unbounded: bool = False) -> None:
        """Add an item, after waiting for space in the pipe.

        Parameters
        ----------
        item
            Plain data such as numbers, strings, bytes, lists and dicts. Items pass through the
            scheduler, so they should be small. Instead of a future, put the key of its task.
        timeout_s
            Maximum time to wait, in seconds.
        unbounded
            Whether to ignore the capacity. This is intended for producers that limit the number of
            items themselves.

        Raises
        ------
        PipeClosed
            If the pipe is closed.
        PipeFailed
            If the pipe has failed. The message contains the reason.
        TimeoutError
            If the pipe remained full for `timeout_s` seconds.
        """
        self.put_many([item], timeout_s, unbounded=unbounded)

    def put_many(
        self, items: Iterable[Any], timeout_s: float | None = None, *, unbounded: bool = False
    ) -> None:
        """Add several items in order, waiting while the pipe is full.

        The iterable may be infinite. Up to `capacity` items at a time are read and sent in one
        request. This method raises the same errors as `put`. If an error is raised, for example
        because `timeout_s` was too short, some of the items may already be in the pipe.
        """
        deadline = _deadline(timeout_s)
        source = iter(items)
        unsent: list[bytes] = []
        options: dict[str, Any] = {"unbounded": unbounded, "run": start_time_of_task()}
        while unsent := unsent or [dumps(item) for item in islice(source, self.capacity)]:
            reply = self._ask_until(deadline, _is_answered, PUT, items=unsent, **options)
            if reply["failure"]:
                raise PipeFailed(reply["failure"])
            unsent = unsent[reply["answer"] :]
            # A task that runs again after it has closed the pipe only sends repeated items.
            if unsent and reply["closed"]:
                raise PipeClosed(f"Pipe {self.name!r} is closed and accepts no more items.")
            if unsent and time.monotonic() > deadline:
                raise TimeoutError(f"Pipe {self.name!r} remained full for {timeout_s} s.")

    # -- consumers ---------------------------------------------------------------------

    def poll(self, timeout_s: float = 0.0) -> tuple[Any, bool]:
        """Return the next item if it arrives in time, like MATLAB's ``[item, ok] = poll(queue)``.

        Unlike this method, `get` raises `TimeoutError` if there is no item, and `PipeClosed` at the
        end of the pipe.

        Parameters
        ----------
        timeout_s
            Maximum time to wait, in seconds. By default, this method does not wait.

        Returns
        -------
        item
            The item, or None if there is none.
        ok
            Whether there was an item. If the pipe is closed and empty, this method returns False
            without waiting.

        Raises
        ------
        PipeFailed
            If the pipe has failed. The message contains the reason.

        Examples
        --------
        >>> hit, ok = hits.poll(10)                                      # doctest: +SKIP
        """
        with suppress(PipeClosed, TimeoutError):
            return self.get(timeout_s), True
        return None, False

    def drain(self) -> list[Any]:
        """Remove and return all items in the pipe without waiting. There may be none.

        Raises
        ------
        PipeFailed
            If the pipe has failed. The message contains the reason.
        """
        self._fill_buffer(-math.inf)
        return self._unpack(self._remove())

    def get_all(self, timeout_s: float | None = None, *, linger_s: float = 0.0) -> list[Any]:
        """Remove and return all items in the pipe, after waiting for at least one.

        Parameters
        ----------
        timeout_s
            Maximum time to wait, in seconds.
        linger_s
            Maximum time to wait for further items after the first one, in seconds, at most 1. The
            wait ends early if the pipe is full.

        Raises
        ------
        PipeClosed
            If the pipe is closed and empty.
        PipeFailed
            If the pipe has failed. The message contains the reason.
        TimeoutError
            If no item arrived in time.
        """
        deadline = _deadline(timeout_s)
        while True:
            reply = self._fill_buffer(-math.inf if self._buffer else deadline, linger_s=linger_s)
            if packed := self._remove():
                return self._unpack(packed)
            self._raise_at_end(reply, deadline, timeout_s)

    def get(self, timeout_s: float | None = None) -> Any:
        """Remove and return the next item, after waiting for one.

        After the first item has arrived, this method waits up to 2 ms for further items, which the
        next calls return. It raises the same errors as `get_all`.
        """
        deadline = _deadline(timeout_s)
        while True:
            try:
                packed = self._buffer.popleft()  # atomic, since threads may share this object
            except IndexError:
                reply = self._fill_buffer(deadline, linger_s=_LINGER_S)
                if not self._buffer:
                    self._raise_at_end(reply, deadline, timeout_s)
            else:
                return unpack_item(self.client, packed)

    def _fill_buffer(
        self,
        deadline: float,
        is_settled: Callable[[Reply], bool] | None = None,
        **arguments: Any,
    ) -> Reply:
        """Fetch items into the buffer, and return the last reply.

        The items are added in the client's event loop. By default, the wait ends once the buffer
        contains items, even if another thread has fetched them. See `_ask_until` for `deadline` and
        `is_settled`. The `arguments` are those of the request TAKE.

        Raises
        ------
        PipeFailed
            If the pipe has failed or does not exist.
        """

        def append_items(reply: Reply) -> None:
            if not reply["failure"]:
                self._buffer.extend(reply["answer"])

        def has_items(reply: Reply) -> bool:
            return bool(self._buffer)

        reply = self._ask_until(deadline, is_settled or has_items, TAKE, append_items, **arguments)
        if reply["failure"]:
            raise PipeFailed(reply["failure"])
        return reply

    def _remove(self, limit: float = math.inf) -> list[Packed]:
        """Remove at most `limit` items from the buffer, and return them still pickled."""
        packed: list[Packed] = []
        with suppress(IndexError):  # threads may share this object
            while len(packed) < limit:
                packed.append(self._buffer.popleft())
        return packed

    def _unpack(self, packed: Sequence[Packed]) -> list[Any]:
        """Unpickle items until one of them cannot be unpickled.

        If the first item cannot be unpickled, it is lost and its error is raised. Otherwise, the
        item that cannot be unpickled and all later items are returned to the buffer.
        """
        items: list[Any] = []
        for number, packed_item in enumerate(packed):
            try:
                items.append(unpack_item(self.client, packed_item))
            except Exception:
                remaining = packed[number:] if items else packed[1:]
                self._buffer.extendleft(reversed(remaining))
                if not items:
                    raise
                break
        return items

    def _raise_at_end(self, reply: Reply, deadline: float, timeout_s: float | None) -> None:
        """Raise PipeClosed if the pipe is closed, or TimeoutError if the deadline has passed."""
        if reply["closed"]:
            raise PipeClosed(f"Pipe {self.name!r} is closed and empty.")
        if time.monotonic() > deadline:
            raise TimeoutError(f"No item arrived in pipe {self.name!r} within {timeout_s} s.")

    def __iter__(self) -> Iterator[Any]:
        """Yield items until the pipe is closed and empty."""
        with suppress(PipeClosed):
            while True:
                yield self.get()

    def listen(self, function: Callable[[Any], Any]) -> PipeListener:
        """Start calling a function in this process for each item until the pipe ends.

        The function is called in a single background thread, in the order of the items. The
        listener is an ordinary consumer of the pipe, so it does not receive items that other
        consumers take.

        Parameters
        ----------
        function
            Function that is called with each item. If it raises an error, it is not called again,
            and the pipe fails with the error, so that producers end.

        Returns
        -------
        Listener
            Its `join` method waits until the pipe has ended and the last call has returned, and
            raises the function's error, if any. Its `close` method stops listening. At the end of a
            ``with`` block, the listener is joined, or closed if the block raises an error.

        Examples
        --------
        >>> with hits.listen(print):                                     # doctest: +SKIP
        ...     gpu.submit(cast, scans, hits).result()
        """
        _ = self.client  # on a worker, the listener's thread would create another client
        return PipeListener(self, function, partial(put_back, self))


def _deadline(timeout_s: float | None) -> float:
    """Convert a timeout to a `time.monotonic` value. None means no limit."""
    return math.inf if timeout_s is None else time.monotonic() + timeout_s


def _is_answered(reply: Reply) -> bool:
    """Return whether at least one item was put by a PUT request."""
    return bool(reply["answer"])


def _key_of_task() -> Any:
    """Return the key of this thread's task, or None outside tasks."""
    running = current_task()
    return None if running is None else running[1].key


def _producer() -> str:
    """Return an ID for the current producer.

    The ID is the key of the current task, or a random ID outside of tasks.
    """
    key = _key_of_task()
    return uuid.uuid4().hex if key is None else str(key)


def delete_pipes(client: Client, names: Sequence[str]) -> None:
    """Delete pipes and their items from the scheduler, ignoring pipes that do not exist."""
    run_on_scheduler(client, delete_existing_pipes, names=list(names))


def get_advice(pipe: Pipe) -> int:
    """Return the number of records per item that the consumer recommends.

    The value is from the last request of this `Pipe` object. If there was none, the scheduler is
    asked. Producers may ignore it.
    """
    return int(pipe._change()["advice"] if pipe._advice is None else pipe._advice)


def set_advice(pipe: Pipe, amount: int) -> None:
    """Recommend the number of records per item to producers. It must be at least 1.

    Only one consumer of a pipe may call this function.
    """
    if amount < 1:
        raise ValueError(
            f"Invalid advice {amount} for pipe {pipe.name!r}. Expected an integer of at least 1."
        )
    if amount != get_advice(pipe):
        pipe._change(advice=amount)


def put_back(pipe: Pipe, item: Any) -> None:
    """Put an item back into this `Pipe` object, so that its next `get` returns the item."""
    pipe._buffer.appendleft(dumps(item))


def take_items(
    pipe: Pipe, futures: Sequence[Future], limit: int, seconds: float, partition: str = ""
) -> tuple[list[Any], bool, bool]:
    """Fetch up to `limit` items, after waiting for an item or the end of a task.

    `Partition.for_each` uses this function to wait for items and running tasks at the same time.

    Parameters
    ----------
    pipe
        Pipe to fetch items from.
    futures
        Futures of tasks, of which the first that ends also ends the wait.
    limit
        Maximum number of items. If it is 0, the function only waits for the end of the pipe or a
        task.
    seconds
        Maximum time to wait.
    partition
        Partition whose tasks will process the items, which balanced groups consider.

    Returns
    -------
    items
        Items, possibly none.
    closed
        True if the scheduler has reported that the pipe is closed. False if the items came from the
        buffer, in which case the scheduler was not asked.
    drained
        True if the pipe is closed and all of its items have been fetched.

    Raises
    ------
    PipeFailed
        If the pipe has failed or does not exist.
    """

    def is_settled(reply: Reply) -> bool:
        return bool(limit and pipe._buffer) or any(future.done() for future in futures)

    closed = False
    if not (limit and pipe._buffer):
        keys = [future.key for future in futures]
        deadline = time.monotonic() + seconds
        reply = pipe._fill_buffer(deadline, is_settled, keys=keys, limit=limit, partition=partition)
        closed = reply["closed"]
    items = pipe._unpack(pipe._remove(limit))
    return items, closed, closed and not pipe._buffer and len(items) < limit


def exchange_items(
    client: Client,
    seconds: float,
    pipes: Collection[str],
    keys: Collection[str] = (),
    *,
    puts: Mapping[str, Sequence[Any]] | None = None,
    linger_s: float = 0.0,
) -> dict[str, list[Any]]:
    """Put items into pipes, wait for items or the end of a task, and fetch the items.

    All of this is done in one request, because most of the cost of an item is the cost of its
    request.

    Parameters
    ----------
    client
        Client of the cluster.
    seconds
        Maximum time to wait.
    pipes
        Names of the pipes to fetch items from, at least one. A pipe that was closed, has failed or
        does not exist also ends the wait.
    keys
        Keys of tasks whose end also ends the wait. Unknown tasks count as ended.
    puts
        Items to put, by pipe, regardless of the capacity of the pipe. Items for a pipe that has
        ended or does not exist are lost.
    linger_s
        Maximum time to wait for further items after the first one, within `seconds`.

    Returns
    -------
    dict
        Items by pipe. Pipes without items are omitted. If an item cannot be unpickled, the error is
        raised, and all items of the request are lost.
    """
    pickled = {name: [dumps(item) for item in items] for name, items in (puts or {}).items()}
    replies = _ask(
        client,
        TAKE,
        names=list(pipes),
        keys=list(keys),
        seconds=seconds,
        linger_s=linger_s,
        puts=pickled,
    )
    answers = {name: reply["answer"] for name, reply in replies.items() if reply["answer"]}
    return {name: [unpack_item(client, item) for item in items] for name, items in answers.items()}


# {client: connection on which the client has installed the request handlers}
_connections: WeakKeyDictionary[Client, Any] = WeakKeyDictionary()


def _install_handlers(client: Client) -> None:
    """Install the scheduler's handlers for pipe requests, once per client connection.

    The handlers are installed even if the scheduler has no pipes yet.
    """
    connection = client.scheduler_comm
    if connection is None or _connections.get(client) is not connection:
        run_on_scheduler(client, install_pipe_handlers)
        _connections[client] = connection
    else:
        check_client(client)


def _ask(client: Client, handler: str, **arguments: Any) -> Replies:
    """Send a single request to the scheduler, and return the reply for each pipe.

    `handler` is CHANGE, PUT or TAKE. These are the names of the handlers that
    `pipe_states.PipeRegistry` adds to the scheduler. The handler receives `arguments`. Pipes that
    do not exist are omitted from the replies.
    """
    _install_handlers(client)
    replies: Replies = client.sync(
        send_request, client, None, handler, client_id=client.id, **arguments
    )
    return replies


def _ask_until(
    client: Client,
    deadline: float,
    is_settled: Callable[[Replies], bool],
    handler: str,
    on_replies: Callable[[Replies], None],
    **arguments: Any,
) -> Replies:
    """Repeat a request until a condition or a deadline is met, and return the last replies.

    All requests belong to a single wait of this thread, so that the waiting task of a partition
    lends its slot only once.

    Parameters
    ----------
    client
        Client that sends the requests.
    deadline
        Value of `time.monotonic` at which the wait ends. The first request is always sent.
    is_settled
        Function that returns whether the replies, by pipe, end the wait.
    handler
        PUT or TAKE, with `arguments` for the handler as in `_ask`.
    on_replies
        Function that is called with the replies to each request, in the client's event loop.
    """
    interrupted = threading.Event()

    async def request() -> Replies:
        seconds = min(WAIT_S, max(0.0, deadline - time.monotonic()))
        options = {"client_id": client.id, "seconds": seconds, **arguments}
        replies: Replies = await send_request(client, None, handler, **options)
        on_replies(replies)
        return replies

    async def repeat_request() -> Replies:
        while True:
            # Dask cancels this wait if its thread is interrupted. The request is shielded, because
            # the scheduler has already removed the items of its reply from the queue.
            replies = await asyncio.shield(request())
            expired = time.monotonic() > deadline or interrupted.is_set()
            if expired or is_settled(replies):
                return replies
            # Without a pause, the loop would be busy if replies arrive immediately but do not end
            # the wait, for example while the client reconnects or has not yet been notified that a
            # task has ended.
            await asyncio.sleep(_AGAIN_S)

    _install_handlers(client)
    try:
        return client.sync(repeat_request)
    except BaseException:
        interrupted.set()
        raise
