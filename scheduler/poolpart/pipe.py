"""Bounded, closable pipes between the tasks of a Dask cluster.

A pipe is a `distributed.Queue` of items and a `distributed.Variable` with its state, both under
the pipe's name; `pipe_states.py` is their side on the scheduler. Any client can look at them, put
and take by `Queue(name)`, and close the pipe by `Variable(name)`.

`Pipe.put` and `Pipe.get` send the scheduler special requests. A request waits there for a second at
most, and is then asked again. So no item goes to a process that was killed while it waited, and to
a process that was stopped, or a machine that was cut off, at most the items of one second.

Pipes end with the client that made them, even if it was killed. Otherwise tasks at both ends would
wait for ever, and keep their slots; Dask does not stop the thread of a task whose client has left.
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
from .internals.names import PIPES, require
from .internals.queues import Packed, unpack_item
from .internals.worker import current_task
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

WAIT_S = 1.0  # longest wait of a request, seconds; a pipe that is closed or fails ends it
_AGAIN_S = 0.01  # between two requests of one wait
_LINGER_S = 0.002  # `get` waits so long for more items, which saves requests


class Pipe:
    """Bounded first-in, first-out pipe between tasks, which can be closed and can fail.

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
    lost: an item that arrives within the next second is kept in the object for its next `get`. If
    an event loop stops awaiting a thread (`asyncio.to_thread`), the thread continues to wait, and
    the item that it receives is lost. To limit this wait, pass `timeout_s`.

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
    ) -> None:
        for quantity, number in (("capacity", capacity), ("number of producers", producers)):
            if not isinstance(number, int) or number < 1:
                raise ValueError(
                    f"Invalid value {number!r} for the {quantity} of pipe {name!r}. Expected an "
                    "integer of at least 1."
                )
        self.name = name
        self.capacity = capacity
        self.producers = producers
        self.fails_with_tasks = fails_with_tasks
        self._client = client
        # Items that the scheduler has handed over and no call has returned yet. The event loop of
        # the client appends them, threads that share this object remove them.
        self._buffer: deque[Packed] = deque()
        self._advice: int | None = None  # advice of the last reply

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = (self.name, self.capacity, None, self.producers)
        return partial(Pipe, fails_with_tasks=self.fails_with_tasks), arguments

    def __repr__(self) -> str:
        state = self._state_in_words()
        return f"<Pipe {self.name!r}: {state}>" if state else f"<Pipe {self.name!r}>"

    def _state_in_words(self) -> str:
        """Return the number of items and the state, or "" where the scheduler cannot be asked."""
        return str(query_for_repr(self._client, describe_pipe, name=self.name) or "")

    def _repr_html_(self) -> str:
        """Return the table that notebooks show: depth, capacity and state."""
        return table_of_pipe(lambda: self.client, repr(self), self.name)

    @property
    def client(self) -> Client:
        """The client that the pipe uses."""
        # Kept: a seceded thread of a worker would get another one each time.
        if self._client is None:
            self._client = own_client()
        return self._client

    # -- creating and deleting ---------------------------------------------------------

    def create(self) -> Pipe:
        """Create the pipe on the scheduler and return it.

        Raises
        ------
        ValueError
            If the cluster already has a queue or a variable with this name.
        PoolError
            If the installed version of Dask does not support pipes.
        """
        require(PIPES)
        client = self.client
        state = {"owner": client.id, "capacity": self.capacity, "producers": self.producers}
        if not run_on_scheduler(client, create_pipe, name=self.name, **state):
            raise ValueError(
                f"The cluster already has a queue or variable named {self.name!r}. Choose another "
                "name for the pipe, or delete an earlier pipe of this name."
            )
        return self

    def delete(self) -> None:
        """Delete the pipe and its queued items from the scheduler, if the pipe exists."""
        delete_pipes(self.client, [self.name])

    def __enter__(self) -> Pipe:
        return self.create()

    def __exit__(self, *_: object) -> None:
        self.delete()

    def _reply(self, replies: Replies) -> Reply:
        """Return the reply for this pipe, and remember the advice in the reply.

        A reply has the state of the pipe (`closed`, `failure`, `advice`) and the `answer` to the
        request: the number of queued items (CHANGE), the number of items that fitted (PUT), or the
        list of packed items that were taken (TAKE). `PipeFailed` if the pipe does not exist.
        """
        if self.name not in replies:
            raise PipeFailed(f"Pipe {self.name!r} does not exist. It was deleted or never created.")
        reply = replies[self.name]
        self._advice = reply["advice"]
        return reply

    def _change(self, **changes: Any) -> Reply:
        """Change the state of the pipe on the scheduler, and return the reply with the new state.

        `changes` are `producer`, the id of a producer that closes the pipe, `failure` and `advice`.
        Without changes, the reply has the current state. The answer is the number of queued items.
        """
        return self._reply(_ask(self.client, CHANGE, names=[self.name], **changes))

    def _ask_until(
        self,
        deadline: float,
        is_settled: Callable[[Reply], Any],
        question: str,
        on_reply: Callable[[Reply], None] = lambda reply: None,
        **arguments: Any,
    ) -> Reply:
        """Repeat a request to the scheduler until a reply ends the wait, and return the last reply.

        Parameters
        ----------
        deadline
            Time of `time.monotonic` at which the wait ends; with -inf the request is made once, and
            does not wait.
        is_settled
            Returns True for a reply that ends the wait. A reply of a pipe that was closed, has
            failed or is gone always ends the wait.
        question
            PUT or TAKE, with the `arguments` of this request of `pipe_states.Pipes`.
        on_reply
            Called with each reply in the event loop of the client, even if this thread has been
            interrupted.
        """

        def has_settled_reply(replies: Replies) -> bool:
            reply = replies.get(self.name)
            return reply is None or bool(reply["failure"] or reply["closed"] or is_settled(reply))

        def pass_on(replies: Replies) -> None:
            if self.name in replies:
                on_reply(replies[self.name])

        options = {"names": [self.name], "task": _key_of_task(), **arguments}
        return self._reply(
            _ask_until(self.client, deadline, has_settled_reply, question, pass_on, **options)
        )

    # -- both ends ---------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Current number of queued items."""
        return int(self._change()["answer"])

    def close(self) -> None:
        """Close the pipe on behalf of a producer.

        Once all producers have closed the pipe, it accepts no more items, and consumers end after
        they have received the remaining items. With several `producers`, each task counts as one
        producer, even if it runs again. Outside of tasks, each call counts as one producer.
        """
        self._change(producer=_producer())

    def fail(self, reason: str) -> None:
        """Make the pipe fail, so that every `put` and `get` at both ends raises `PipeFailed`.

        If the pipe has already failed, the first reason is kept.

        Parameters
        ----------
        reason
            Message of the error.
        """
        self._change(failure=reason or "No reason was given.")

    # -- producers ---------------------------------------------------------------------

    def put(self, item: Any, timeout_s: float | None = None, *, unbounded: bool = False) -> None:
        """Add an item, and wait while the pipe is full.

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
        """Add several items in order, and wait while the pipe is full.

        The iterable may be infinite. Up to `capacity` items at a time are read and sent in one
        request. This method raises the same errors as `put`. If an error is raised, for example
        because `timeout_s` was too short, some of the items may already be in the pipe.
        """
        deadline = _deadline(timeout_s)
        source = iter(items)
        unsent: list[bytes] = []
        while unsent := unsent or [dumps(item) for item in islice(source, self.capacity)]:
            reply = self._ask_until(deadline, _is_answered, PUT, items=unsent, unbounded=unbounded)
            if reply["failure"]:
                raise PipeFailed(reply["failure"])
            if reply["closed"]:
                raise PipeClosed(f"Pipe {self.name!r} is closed and accepts no more items.")
            unsent = unsent[reply["answer"] :]
            if unsent and time.monotonic() > deadline:
                raise TimeoutError(f"Pipe {self.name!r} remained full for {timeout_s} s.")

    # -- consumers ---------------------------------------------------------------------

    def poll(self, timeout_s: float = 0.0) -> tuple[Any, bool]:
        """Return the next item if one arrives in time, like MATLAB's ``[item, ok] = poll(queue)``.

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
        """Remove and return all queued items, possibly none, without waiting.

        Raises
        ------
        PipeFailed
            If the pipe has failed. The message contains the reason.
        """
        self._fill_buffer(-math.inf)
        return self._unpack(self._remove())

    def get_all(self, timeout_s: float | None = None, *, linger_s: float = 0.0) -> list[Any]:
        """Remove and return all queued items, after waiting until there is at least one.

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
        """Remove and return the next item, after waiting until there is one.

        After the first item has arrived, this method waits up to 2 ms for further items, which the
        next calls return. It raises the same errors as `get_all`.
        """
        deadline = _deadline(timeout_s)
        while True:
            try:
                packed = self._buffer.popleft()  # one atomic operation: threads may share this
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
        """Take queued items into the buffer, in the event loop of the client.

        Without `is_settled`, the wait ends once the buffer has items, even if another thread has
        taken them. `_ask_until` describes `deadline` and `is_settled`; `arguments` belong to the
        request TAKE. Returns the last reply. Raises `PipeFailed`.
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
        """Remove and return the first items of the buffer, at most `limit`, still pickled."""
        packed: list[Packed] = []
        with suppress(IndexError):  # threads may share this object
            while len(packed) < limit:
                packed.append(self._buffer.popleft())
        return packed

    def _unpack(self, packed: Sequence[Packed]) -> list[Any]:
        """Unpickle items of the buffer, up to the first item that cannot be unpickled.

        If that item is the first of all, its error is raised, and the item is lost. Otherwise the
        item and the items after it go back to the buffer.
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
        """Raise PipeClosed if no item can come any more, TimeoutError after the deadline."""
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
        """Start calling a function in this process for each item, until the pipe ends.

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
        _ = self.client  # the thread of the listener would get another client on a worker
        return PipeListener(self, function, partial(put_back, self))


def _deadline(timeout_s: float | None) -> float:
    """Return the time of `time.monotonic` after a time-out in seconds, inf without a time-out."""
    return math.inf if timeout_s is None else time.monotonic() + timeout_s


def _is_answered(reply: Reply) -> bool:
    """Return whether items of a PUT, at least 1, fitted into the pipe."""
    return bool(reply["answer"])


def _key_of_task() -> str:
    """Return the key of this thread's task, or "" elsewhere."""
    running = current_task()
    return "" if running is None else str(running[1].key)


def _producer() -> str:
    """Return an id of the producer: the key of this thread's task, or a random id elsewhere."""
    return _key_of_task() or uuid.uuid4().hex


def delete_pipes(client: Client, names: Sequence[str]) -> None:
    """Delete pipes on the scheduler, with their items, if they exist."""
    run_on_scheduler(client, delete_existing_pipes, names=list(names))


def get_advice(pipe: Pipe) -> int:
    """Return the number of records that the consumer of a pipe wants bundled in an item.

    The number is as old as the last request of the object; before the first request, the scheduler
    is asked. A producer may ignore the number.
    """
    return int(pipe._change()["advice"] if pipe._advice is None else pipe._advice)


def set_advice(pipe: Pipe, amount: int) -> None:
    """Set the number of records that producers should bundle in an item, 1 or more.

    Only one consumer may call this.
    """
    if amount < 1:
        raise ValueError(
            f"Invalid advice {amount} for pipe {pipe.name!r}. Expected an integer of at least 1."
        )
    if amount != get_advice(pipe):
        pipe._change(advice=amount)


def put_back(pipe: Pipe, item: Any) -> None:
    """Make an item that a pipe object has returned the next item that it returns."""
    pipe._buffer.appendleft(dumps(item))


def take_items(
    pipe: Pipe, futures: Sequence[Future], limit: int, seconds: float
) -> tuple[list[Any], bool, bool]:
    """Take up to `limit` items, as soon as there are any or a task of `futures` has ended.

    For `Partition.for_each`, which waits beside its running tasks, for `seconds` at most. With a
    limit of 0, the call waits for the end of the pipe or of a task. Raises `PipeFailed`.

    Returns
    -------
    items
        The items, possibly none.
    closed
        True if the scheduler has replied that the pipe is closed; False if this call took items
        from the buffer, and did not ask.
    drained
        True if the pipe is closed and all its items were taken.
    """

    def is_settled(reply: Reply) -> bool:
        return bool(limit and pipe._buffer) or any(future.done() for future in futures)

    closed = False
    if not (limit and pipe._buffer):
        keys = [future.key for future in futures]
        deadline = time.monotonic() + seconds
        reply = pipe._fill_buffer(deadline, is_settled, keys=keys, limit=limit)
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
    """Wait until a pipe has an item or a task has ended, and take the items of the pipes.

    Before, put items into other pipes; all in one request, which is most of what an item costs.

    Parameters
    ----------
    seconds
        Longest wait.
    pipes, keys
        Names of pipes, one at least, and keys of tasks. A pipe that was closed, has failed or is
        gone ends the wait as well, as does a task that the scheduler does not know.
    puts
        {pipe: items to put}, beyond the capacity if necessary. Items for a pipe that has ended or
        is gone are lost.
    linger_s
        Longest wait in seconds for more items after the first, `seconds` at most.

    Returns
    -------
    {pipe: its items}, without pipes that had no items. An item that cannot be unpickled raises, and
    all items of the request are lost.
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


# {client: connection on which the client has asked its scheduler to answer requests}
_connections: WeakKeyDictionary[Client, Any] = WeakKeyDictionary()


def _let_answer(client: Client) -> None:
    """Have the scheduler answer requests, whether it has pipes or not, once a connection."""
    connection = client.scheduler_comm
    if connection is None or _connections.get(client) is not connection:
        run_on_scheduler(client, install_pipe_handlers)
        _connections[client] = connection
    else:
        check_client(client)


def _ask(client: Client, question: str, **arguments: Any) -> Replies:
    """Send a single request to the scheduler.

    Returns {pipe: reply} of the pipes that exist.

    `question` is CHANGE, PUT or TAKE: the name of a handler that `pipe_states.Pipes` adds to the
    scheduler. The handler takes `arguments`.
    """
    _let_answer(client)
    replies: Replies = client.sync(
        send_request, client, None, question, asker=client.id, **arguments
    )
    return replies


def _ask_until(
    client: Client,
    deadline: float,
    is_settled: Callable[[Replies], bool],
    question: str,
    on_replies: Callable[[Replies], None],
    **arguments: Any,
) -> Replies:
    """Repeat a request to the scheduler until its replies end the wait; return the last replies.

    All requests are one wait of this thread: a task of a partition that waits lends its slot once.

    Parameters
    ----------
    client
        The client that asks.
    deadline
        Time of `time.monotonic` at which the wait ends. The first request is made in any case.
    is_settled
        Returns True for replies, {pipe: reply}, that end the wait.
    question
        PUT or TAKE, with `arguments` for the handler, as in `_ask`.
    on_replies
        Called with the replies to each request, in the event loop of the client.
    """
    interrupted = threading.Event()

    async def request() -> Replies:
        seconds = min(WAIT_S, max(0.0, deadline - time.monotonic()))
        options = {"asker": client.id, "seconds": seconds, **arguments}
        replies: Replies = await send_request(client, None, question, **options)
        on_replies(replies)
        return replies

    async def repeat_request() -> Replies:
        while True:
            # Dask cancels this wait if its thread is interrupted. The scheduler answers all the
            # same, and has then removed the items from its queue.
            replies = await asyncio.shield(request())
            expired = time.monotonic() > deadline or interrupted.is_set()
            if expired or is_settled(replies):
                return replies
            # A reply may come at once, though not settled: while this client reconnects, or until
            # it hears that a task has ended.
            await asyncio.sleep(_AGAIN_S)

    _let_answer(client)
    try:
        return client.sync(repeat_request)
    except BaseException:
        interrupted.set()
        raise
