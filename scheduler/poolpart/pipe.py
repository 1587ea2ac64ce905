"""Bounded, closable pipes between the tasks of a Dask cluster.

A pipe is a `distributed.Queue` of items and a `distributed.Variable` with its state, both under
the pipe's name; `pipe_states.py` is their side on the scheduler. Any client can look at them, put
and take by `Queue(name)`, and close the pipe by `Variable(name)`.

`Pipe.put` and `Pipe.get` ask the scheduler by requests of their own. A request waits there for a
second at most, and is then asked again. So no item goes to a process that was killed while it
waited, and to a process that was stopped, or a machine that was cut off, at most the items of one
second.

Pipes end with the client that made them, also if it was killed. Otherwise tasks at both ends would
wait for ever, and keep their slots; Dask does not stop the thread of a task whose client has left.
"""

from __future__ import annotations

import asyncio
import math
import time
import uuid
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any

from distributed import Client, Future
from distributed.protocol.pickle import dumps

from .errors import PipeClosed, PipeFailed
from .internals.client import ask
from .internals.names import PIPES, require
from .internals.queues import unpack
from .internals.worker import task_of_thread
from .pipe_states import CHANGE, PUT, TAKE, Replies, Reply, delete_pipes, open_pipe
from .task_context import own_client
from .workers import check_client, on_scheduler

_WAIT_S = 1.0  # in one request; a pipe that is closed or fails ends it
_AGAIN_S = 0.01  # between two requests of one wait
_LINGER_S = 0.002  # `get` waits so long for more items, which saves requests


class Pipe:
    """A bounded first-in-first-out connection that can be closed and can fail.

    The maker of the pipe calls `create`, passes it to the tasks on both ends (it is small when
    pickled), and finally calls `delete`, as a ``with`` block does; it is also deleted when the
    maker's client closes or dies.
    Any number of producers and consumers may share it, in any process and thread; threads may
    share the object itself.

    With several `producers`, the pipe is closed once each of them has called `close`.

    After `fail`, every `put` raises `PipeFailed`. A `get` first hands out what this object has
    already taken, and then raises; waiting calls raise within a second. A pipe that does not exist,
    or was deleted, raises the same error, also in `close` and `fail`. If the scheduler has died,
    calls raise OSError, after Dask's ``distributed.comm.timeouts.connect``.

    A consumer takes all that is queued, some `capacity` items, in one request; `get` and
    iteration hand them out one by one. At most ``capacity * (1 + consumers)`` items are
    under way. With slow items and several consumers, choose a small capacity, so that no consumer
    holds items while another idles. Items that an object has taken are lost if its process dies, or
    if the object is dropped, such as by a `break` and the end of the task: for exactly-once
    delivery, record what has arrived, and put missing items again.

    Parameters
    ----------
    name
        Unique on the cluster; put something random in it.
    capacity
        Items that may be queued; `put` waits while there are as many.
    client
        The client to use. By default, on a worker, the worker's own.
    producers
        Number of producers, each of which calls `close` when it is done.

    Notes
    -----
    Any client can use ``Queue(pipe.name)`` and ``Variable(pipe.name)`` of Dask. The items of the
    queue are those of the pipe, in the same order and within the same capacity; its `put` and `get`
    raise `PipeClosed` and `PipeFailed`, too. Unlike `Pipe.get`, `Queue.get` loses an item if its
    client is killed while it waits: the scheduler does not know whose request it is. The variable
    is the state, see `poolpart.pipe_states.PipeState`. ``variable.set({**variable.get(), "closed":
    True})`` closes the pipe; what does not follow from the state is a ValueError, also if the state
    has changed since it was read: read and set it again. ``Variable.delete``, or releasing the last
    reference to the queue, deletes the pipe.

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
        self, name: str, capacity: int = 16, client: Client | None = None, producers: int = 1
    ) -> None:
        for quantity, number in (("capacity", capacity), ("number of producers", producers)):
            if not isinstance(number, int) or number < 1:
                wrong = f"The {quantity} of pipe {name!r} is {number!r}"
                raise ValueError(f"{wrong}; give a whole number, 1 or more.")
        self.name = name
        self.capacity = capacity
        self.producers = producers
        self._client = client
        self._taken: deque[Any] = deque()
        self._advice: int | None = None  # as the last request found it

    def __reduce__(self) -> tuple[Any, ...]:
        return Pipe, (self.name, self.capacity, None, self.producers)

    def __repr__(self) -> str:
        return f"<Pipe {self.name!r} capacity {self.capacity}>"

    @property
    def client(self) -> Client:
        """The client that is used."""
        # Kept: a seceded thread of a worker would get another one each time.
        if self._client is None:
            self._client = own_client()
        return self._client

    # -- creating and deleting ---------------------------------------------------------

    def create(self) -> Pipe:
        """Open the pipe on the scheduler; returns itself.

        Raises
        ------
        ValueError
            If the cluster has a queue or a variable of that name.
        PoolError
            If this version of Dask lacks what pipes need.
        """
        require(PIPES)
        client = self.client
        state = {"owner": client.id, "capacity": self.capacity, "producers": self.producers}
        if not on_scheduler(client, open_pipe, name=self.name, **state):
            raise ValueError(
                f"The cluster has a queue or variable {self.name!r}: give the pipe another "
                "name, or delete what is left of an earlier one."
            )
        return self

    def delete(self) -> None:
        """Delete the pipe on the scheduler, with its items; no error if it is gone."""
        forget_pipes(self.client, [self.name])

    def __enter__(self) -> Pipe:
        return self.create()

    def __exit__(self, *_: object) -> None:
        self.delete()

    def _reply(self, replies: Replies) -> Reply:
        """Return the reply for this pipe: its state, and the answer to the request."""
        if self.name not in replies:
            raise PipeFailed(f"Pipe {self.name!r} does not exist: never created, or deleted.")
        reply = replies[self.name]
        self._advice = reply["advice"]
        return reply

    def _change(self, **changes: Any) -> Reply:
        """Change the state of the pipe, or only look at it."""
        return self._reply(_ask(self.client, CHANGE, names=[self.name], **changes))

    def _ask_until(
        self, deadline: float, settled: Callable[[Reply], Any], question: str, **arguments: Any
    ) -> Reply:
        """Ask the scheduler again and again until a reply is settled, or a deadline has passed."""

        def is_settled(replies: Replies) -> bool:
            reply = replies.get(self.name)
            return reply is None or bool(reply["failure"] or reply["closed"] or settled(reply))

        return self._reply(
            _ask_until(self.client, deadline, is_settled, question, names=[self.name], **arguments)
        )

    # -- both ends ---------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Items queued now."""
        return int(self._change()["answer"])

    def close(self) -> None:
        """End the pipe for one producer, and with the last one for all.

        Then nothing can be put, and consumers take the remaining items and end. With several
        `producers`, each task counts once, also if it is run again; elsewhere each call counts.
        """
        self._change(producer=_producer())

    def fail(self, reason: str) -> None:
        """Make every `put` and `get`, at both ends, raise `PipeFailed` with this reason.

        The first reason stays.
        """
        self._change(failure=reason or "no reason was given")

    # -- producers ---------------------------------------------------------------------

    @property
    def advice(self) -> int:
        """Number of records that the consumer wants bundled in one item, as of the last `put`.

        A producer may ignore it.
        """
        return int(self._change()["advice"] if self._advice is None else self._advice)

    def advise(self, amount: int) -> None:
        """Set the number of records that producers should bundle in one item, 1 or more.

        Only one consumer may call this.
        """
        if amount < 1:
            raise ValueError(f"The advice for pipe {self.name!r} is {amount}; give 1 or more.")
        if amount != self.advice:
            self._change(advice=amount)

    def put(self, item: Any, timeout_s: float | None = None, *, unbounded: bool = False) -> None:
        """Add an item; waits while the pipe is full.

        Parameters
        ----------
        item
            Plain data: numbers, strings, bytes, lists, dicts; the key of a task rather than its
            Future. It travels through the scheduler: keep it small.
        timeout_s
            Longest wait in seconds.
        unbounded
            Ignore the capacity: for producers that limit their items themselves.

        Raises
        ------
        PipeClosed
            If the pipe was closed.
        PipeFailed
            If it was failed, with the reason.
        TimeoutError
            If it stayed full for so long.
        """
        self.put_many([item], timeout_s, unbounded=unbounded)

    def put_many(
        self, items: Iterable[Any], timeout_s: float | None = None, *, unbounded: bool = False
    ) -> None:
        """Add items in order, up to `capacity` of them in one request; waits like `put`.

        The items may be endless; `capacity` of them are read before they are sent. After an error,
        such as that `timeout_s` was too short for all, the first of them may be in the pipe.
        """
        deadline = _deadline(timeout_s)
        source, waiting = iter(items), list[bytes]()
        while waiting := waiting or [dumps(item) for item in islice(source, self.capacity)]:
            options = {"items": waiting, "unbounded": unbounded}
            reply = self._ask_until(deadline, _has_answer, PUT, **options)
            if reply["failure"]:
                raise PipeFailed(reply["failure"])
            if reply["closed"]:
                raise PipeClosed(f"Pipe {self.name!r} is closed; nothing can be put into it.")
            waiting = waiting[reply["answer"] :]
            if waiting and time.monotonic() > deadline:
                raise TimeoutError(f"Pipe {self.name!r} stayed full for {timeout_s} s.")

    # -- consumers ---------------------------------------------------------------------

    def poll(self) -> list[Any]:
        """Take all queued items, possibly none; never waits, and raises `PipeFailed`."""
        return self._take(-math.inf)[0]

    def _take(self, deadline: float, linger_s: float = 0.0) -> tuple[list[Any], bool]:
        """Return items, none if the deadline has passed, and whether the pipe is closed."""
        buffered = []
        with suppress(IndexError):  # threads may share this object
            while True:
                buffered.append(self._taken.popleft())
        if buffered:
            deadline = -math.inf
        try:
            reply = self._ask_until(deadline, _has_answer, TAKE, linger_s=linger_s)
            if reply["failure"]:
                raise PipeFailed(reply["failure"])
        except BaseException:  # such as of a pipe that was deleted
            self._taken.extendleft(reversed(buffered))
            raise
        return [*buffered, *self._unpacked(reply)], reply["closed"]

    def _unpacked(self, reply: Reply) -> list[Any]:
        return [unpack(self.client, packed) for packed in reply["answer"]]

    def take_beside(self, futures: Sequence[Future], limit: int) -> tuple[list[Any], bool]:
        """Take up to `limit` queued items, as soon as there are any or a task has ended.

        For `Partition.for_each`. Returns the items, and whether the pipe is closed; raises
        `PipeFailed`.
        """
        if taken := [self._taken.popleft() for _ in range(min(limit, len(self._taken)))]:
            return taken, False
        reply = self._ask_until(
            math.inf,
            lambda reply: reply["answer"] or any(future.done() for future in futures),
            TAKE,
            keys=[future.key for future in futures],
            limit=limit,
        )
        if reply["failure"]:
            raise PipeFailed(reply["failure"])
        return self._unpacked(reply), reply["closed"]

    def get_all(self, timeout_s: float | None = None, *, linger_s: float = 0.0) -> list[Any]:
        """Take all queued items, as soon as there are any.

        Parameters
        ----------
        timeout_s
            Longest wait in seconds.
        linger_s
            Wait so long for more once there are some.

        Raises
        ------
        PipeClosed
            If the pipe was closed and is empty.
        PipeFailed
            If it was failed, with the reason.
        TimeoutError
            If nothing came for so long.
        """
        items, closed = self._take(_deadline(timeout_s), linger_s)
        if items:
            return items
        if closed:
            raise PipeClosed(f"Pipe {self.name!r} is closed and empty.")
        raise TimeoutError(f"Nothing came through pipe {self.name!r} for {timeout_s} s.")

    def get(self, timeout_s: float | None = None) -> Any:
        """Take the next item; waits for one and 2 ms for others, and raises like `get_all`."""
        try:
            # One atomic operation: threads may share this object.
            return self._taken.popleft()
        except IndexError:
            item, *more = self.get_all(timeout_s, linger_s=_LINGER_S)
            self._taken.extend(more)
            return item

    def __iter__(self) -> Iterator[Any]:
        """Yield items until the pipe is closed and empty."""
        with suppress(PipeClosed):
            while True:
                yield self.get()


def _deadline(timeout_s: float | None) -> float:
    return math.inf if timeout_s is None else time.monotonic() + timeout_s


def _has_answer(reply: Reply) -> Any:
    return reply["answer"]


def _producer() -> str:
    """Return the key of the task that runs in this thread, or a random id in any other thread."""
    running = task_of_thread()
    return uuid.uuid4().hex if running is None else str(running[1].key)


def forget_pipes(client: Client, names: Sequence[str]) -> None:
    """Delete these pipes on the scheduler, with their items; unknown ones are skipped."""
    on_scheduler(client, delete_pipes, names=list(names))


def take_news(
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
        Items by pipe, whatever its capacity. Those for a pipe that has ended or is gone are lost.
    linger_s
        Wait so long for more once there is something, within `seconds`.

    Returns
    -------
    The items by pipe, of those that had some.
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
    return {name: [unpack(client, item) for item in items] for name, items in answers.items()}


def _ask(client: Client, question: str, **arguments: Any) -> Replies:
    """Ask the scheduler once."""
    check_client(client)
    replies = client.sync(ask, client, None, question, asker=client.id, **arguments)
    return replies or {}  # a scheduler without pipes has no such handler


def _ask_until(
    client: Client,
    deadline: float,
    is_settled: Callable[[Replies], bool],
    question: str,
    **arguments: Any,
) -> Replies:
    """Ask the scheduler again until the replies are settled, or a deadline has passed.

    All of it is one wait of this thread: a task of a partition that waits lends its slot once.
    """

    async def ask_until() -> Replies:
        while True:
            seconds = min(_WAIT_S, max(0.0, deadline - time.monotonic()))
            options = {"asker": client.id, "seconds": seconds, **arguments}
            replies: Replies = await ask(client, None, question, **options) or {}
            if is_settled(replies) or time.monotonic() > deadline:
                return replies
            # A reply may come at once, though not settled: while this client reconnects, or until
            # it hears that a task has ended.
            await asyncio.sleep(_AGAIN_S)

    check_client(client)
    return client.sync(ask_until)
