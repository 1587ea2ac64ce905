"""Bounded, closable pipes between the tasks of a Dask cluster.

A pipe is a `distributed.Queue` of items and a `distributed.Variable` with its state, both under
the pipe's name. A Queue alone has three problems: a consumer that dies within `Queue.get` leaves
its request on the scheduler, and the next item is lost; a queue cannot be closed, so its consumers
cannot end; and a blocking `put` or `get` does not notice that the other side has failed.

So both are used only by a plugin of the scheduler, which answers requests. A request waits there,
looks at items and state together, and puts or takes items only if its client is still there.
Producers pickle the items, consumers unpickle them.

Pipes end with the client that made them, also if it was killed. Otherwise tasks at both ends would
wait for ever, and keep their slots; Dask does not stop the thread of a task whose client has left.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import Any

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin
from distributed.protocol.pickle import dumps, loads

from .errors import PipeClosed, PipeFailed
from .internals.client import ask
from .internals.scheduler import QueueAndVariable, handlers_of
from .task_context import own_client
from .workers import check_client, on_scheduler

_WAIT_S = 1.0  # in one request; a pipe that is closed or fails ends it
_ENDED = ("memory", "erred", "forgotten")  # states of tasks that nobody need wait for
_LINGER_S = 0.002  # `get` waits so long for more items, which saves requests
_PIPES = "poolpart-pipes"

Reply = dict[str, Any]  # state of a pipe, and the answer to a request
Replies = dict[str, Reply]  # by pipe, of those that exist


class Pipe:
    """A bounded first-in-first-out connection that can be closed and can fail.

    The maker of the pipe calls `create`, passes it to the tasks on both ends (it is small when
    pickled), and finally calls `delete`, as a ``with`` block does; it is also deleted when the
    maker's client closes or dies.
    Any number of producers and consumers may share it, in any process and thread; threads may
    share the object itself.

    After `fail`, every `put` raises `PipeFailed`, and every `get` once the consumer has used up its
    items; waiting calls do so within a second. A pipe that does not exist, or was deleted, raises
    it as well. If the scheduler has died they raise OSError, after Dask's
    ``distributed.comm.timeouts.connect``.

    A consumer takes all that is queued, some `capacity` items, in one request; `get` and
    iteration hand them out one by one. At most ``capacity * (1 + consumers)`` items are
    under way. With slow items and several consumers, choose a small capacity, so that no consumer
    holds items while another idles. Items taken by a consumer that dies are lost with it: for
    exactly-once delivery, record what has arrived, and put missing items again.

    Parameters
    ----------
    name
        Unique on the cluster; put something random in it.
    capacity
        Items that may be queued; `put` waits while there are as many.
    client
        The client to use. By default, on a worker, the worker's own.

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

    def __init__(self, name: str, capacity: int = 16, client: Client | None = None) -> None:
        if capacity < 1:
            raise ValueError(f"The capacity of pipe {name!r} is {capacity}; it must be at least 1.")
        self.name, self.capacity = name, capacity
        self._client = client
        self._taken: deque[Any] = deque()
        self._advice: int | None = None  # as the last request found it

    def __reduce__(self) -> tuple[Any, ...]:
        return Pipe, (self.name, self.capacity)

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
        """
        state = {"owner": self.client.id, "capacity": self.capacity}
        if not on_scheduler(self.client, _open, name=self.name, **state):
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

    def _ask(self, question: str, **arguments: Any) -> Reply:
        """Ask the scheduler; returns the state of the pipe, and the answer."""
        replies = _ask(self.client, question, names=[self.name], **arguments)
        if self.name not in replies:
            raise PipeFailed(f"Pipe {self.name!r} does not exist: never created, or deleted.")
        reply: Reply = replies[self.name]
        self._advice = reply["advice"]
        return reply

    # -- both ends ---------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Items queued now."""
        return int(self._ask(_CHANGE)["answer"])

    def close(self) -> None:
        """End the pipe for producers; consumers take the remaining items, then end."""
        self._ask(_CHANGE, closed=True)

    def fail(self, reason: str) -> None:
        """Make every `put` and `get`, at both ends, raise `PipeFailed` with this reason.

        The first reason stays.
        """
        self._ask(_CHANGE, failure=reason or "no reason was given")

    # -- producers ---------------------------------------------------------------------

    @property
    def advice(self) -> int:
        """Amount that the consumer wants in one item, as of the last `put`.

        A producer may ignore it.
        """
        return int(self._ask(_CHANGE)["advice"] if self._advice is None else self._advice)

    def advise(self, amount: int) -> None:
        """Set the amount that producers should put into one item; for one caller."""
        if amount != self.advice:
            self._ask(_CHANGE, advice=amount)

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

        The items may be endless. After an error, such as that `timeout_s` in all was too short, the
        first of them may be in the pipe.
        """
        deadline = _deadline(timeout_s)
        source, waiting = iter(items), list[bytes]()
        while waiting := waiting or [dumps(item) for item in islice(source, self.capacity)]:
            seconds = _one_wait(deadline)
            reply = self._ask(_PUT, items=waiting, unbounded=unbounded, seconds=seconds)
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
        return self._take(0.0)[0]

    def _take(self, seconds: float, linger_s: float = 0.0) -> tuple[list[Any], bool]:
        reply = self._ask(_TAKE, seconds=seconds, linger_s=min(seconds, linger_s))
        if reply["failure"]:
            raise PipeFailed(reply["failure"])
        taken = []
        with suppress(IndexError):  # threads may share this object
            while True:
                taken.append(self._taken.popleft())
        return [*taken, *map(loads, reply["answer"])], reply["closed"]

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
        deadline = _deadline(timeout_s)
        while True:
            items, closed = self._take(_one_wait(deadline), linger_s)
            if items:
                return items
            if closed:
                raise PipeClosed(f"Pipe {self.name!r} is closed and empty.")
            if time.monotonic() > deadline:
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
    return float("inf") if timeout_s is None else time.monotonic() + timeout_s


def _one_wait(deadline: float) -> float:
    return min(_WAIT_S, max(0.0, deadline - time.monotonic()))


def forget_pipes(client: Client, names: Sequence[str]) -> None:
    """Delete these pipes on the scheduler, with their items; unknown ones are skipped."""
    on_scheduler(client, _forget, names=list(names))


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
    given = {name: [dumps(item) for item in items] for name, items in (puts or {}).items()}
    replies = _ask(
        client,
        _TAKE,
        names=list(pipes),
        keys=list(keys),
        seconds=seconds,
        linger_s=min(linger_s, seconds),
        puts=given,
    )
    return {name: [*map(loads, r["answer"])] for name, r in replies.items() if r["answer"]}


def _ask(client: Client, question: str, **arguments: Any) -> Replies:
    check_client(client)
    replies = client.sync(ask, client, None, question, asker=client.id, **arguments)
    return replies or {}  # a scheduler without pipes has no such handler


# -- on the scheduler ------------------------------------------------------------------

_CHANGE, _PUT, _TAKE = (f"poolpart_pipes_{name}" for name in ("change", "put", "take"))


@dataclass
class PipeState:
    """What the scheduler keeps of a pipe.

    The items, pickled, are in a `distributed.Queue` of the pipe's name; all else is the value of a
    `distributed.Variable`.
    """

    items: QueueAndVariable
    owner: str  # id of the client that made the pipe
    capacity: int
    closed: bool = False
    failure: str = ""  # the reason, empty while there is none
    advice: int = 1

    @property
    def ended(self) -> bool:
        """Whether it was closed or has failed."""
        return self.closed or bool(self.failure)

    @property
    def room(self) -> int:
        """Items that may be put now."""
        return max(0, self.capacity - len(self.items))

    def publish(self) -> None:
        """Let the Variable say what has changed."""
        self.items.set({name: value for name, value in vars(self).items() if name != "items"})


def pipes_of(scheduler: Any) -> dict[str, PipeState]:
    """States of all pipes, by name."""
    return scheduler.plugins[_PIPES].states if _PIPES in scheduler.plugins else {}


def _open(name: str, owner: str, capacity: int, dask_scheduler: Any = None) -> bool:
    # The last request of a killed owner may arrive after its removal: nobody would delete the pipe,
    # or get the answer.
    if QueueAndVariable.exists(dask_scheduler, name) or owner not in dask_scheduler.clients:
        return False
    if _PIPES not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(Pipes(dask_scheduler))
    state = PipeState(QueueAndVariable(dask_scheduler, name), owner, capacity)
    state.publish()
    pipes_of(dask_scheduler)[name] = state
    return True


def _forget(names: Collection[str], dask_scheduler: Any = None) -> None:
    if _PIPES in dask_scheduler.plugins:
        dask_scheduler.plugins[_PIPES].forget(names)


class Pipes(SchedulerPlugin):
    """The pipes of a scheduler; exists, and answers requests, as long as there are any."""

    name = _PIPES

    def __init__(self, scheduler: Any) -> None:
        self.scheduler = scheduler
        self.states: dict[str, PipeState] = {}
        self._changed = asyncio.Event()  # set, and replaced, when a pipe changes
        self._awaited: list[Collection[str]] = []  # keys of the tasks that requests wait for
        answers = {_CHANGE: self.change, _PUT: self.put, _TAKE: self.take}
        handlers_of(scheduler).update(answers)

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Delete the pipes of a client that has left."""
        self.forget([name for name, state in self.states.items() if state.owner == client])

    def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
        """Let requests that wait for a task look again, once it has ended."""
        # A look every 5 ms took the scheduler of a run 2 % of a core.
        if finish in _ENDED and any(key in keys for keys in self._awaited):
            self._wake()

    def forget(self, names: Collection[str]) -> None:
        """Delete pipes, as far as they exist; with the last one, leave the scheduler."""
        for name in self.states.keys() & set(names):
            state = self.states.pop(name)
            state.closed = True  # ends the requests that wait
            state.items.delete()
        self._wake()
        if not self.states:
            self.scheduler.remove_plugin(_PIPES)
            for question in (_CHANGE, _PUT, _TAKE):
                del handlers_of(self.scheduler)[question]

    def change(self, names: Sequence[str], asker: str, **changes: Any) -> Replies:
        """Change the state of pipes; the answer is the number of items."""
        states = self._states(names)
        for state in states.values():
            if state.failure:  # the first reason is the cause, later ones are its consequences
                changes.pop("failure", None)
            vars(state).update(changes)
            state.publish()
        self._wake()
        return self._replies(states, lambda state: len(state.items))

    def put(
        self, names: Sequence[str], asker: str, items: list[bytes], unbounded: bool, seconds: float
    ) -> Replies | Awaitable[Replies]:
        """Put items into a pipe as soon as there is room for any; the answer is their number.

        At once if there is room: for a coroutine Dask makes a task, which takes longer than this.
        """

        def put(state: PipeState) -> int:
            if state.ended or asker not in self.scheduler.clients:
                return 0
            fitting = items if unbounded else items[: state.room]
            was_empty = not state.items
            state.items.put(fitting)
            if was_empty or not state.room:  # else nobody waits for this
                self._wake()
            return len(fitting)

        def ready() -> bool:
            return unbounded or all(state.ended or state.room for state in states.values())

        async def later() -> Replies:
            await self._until(seconds, ready)
            return self._replies(states, put)

        states = self._states(names)
        return self._replies(states, put) if ready() else later()

    async def take(
        self,
        names: Sequence[str],
        asker: str,
        seconds: float,
        linger_s: float = 0.0,
        keys: Sequence[str] = (),
        puts: Mapping[str, list[bytes]] | None = None,
    ) -> Replies:
        """Take the items of pipes, once one has any or has ended, or a task has ended.

        Before that, put items into other pipes.
        """
        for name, items in (puts or {}).items():
            self.put([name], asker, items, unbounded=True, seconds=0.0)

        def news() -> bool:
            tasks = (self.scheduler.tasks.get(key) for key in keys)
            return (
                len(states) < len(names)
                or any(state.items or state.ended for state in states.values())
                or any(task is None or task.state in _ENDED for task in tasks)
            )

        def full() -> bool:
            return any(state.ended or not state.room for state in states.values())

        def take(state: PipeState) -> list[bytes]:
            if asker not in self.scheduler.clients:
                return []
            items = state.items.take()
            if items:
                self._wake()
            return items

        states = self._states(names)
        self._awaited.append(keys)
        try:
            await self._until(seconds, news)
        finally:
            self._awaited.remove(keys)
        await self._until(linger_s, full)
        return self._replies(states, take)

    def _wake(self) -> None:
        """Let requests that wait look again."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def _until(self, seconds: float, condition: Callable[[], bool]) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while not condition():
                    await self._changed.wait()

    def _states(self, names: Sequence[str]) -> dict[str, PipeState]:
        return {name: self.states[name] for name in names if name in self.states}

    def _replies(self, states: dict[str, PipeState], answer: Callable[[PipeState], Any]) -> Replies:
        """Answer for each pipe that was not deleted meanwhile."""
        shown = ("closed", "failure", "advice")
        return {
            name: {"answer": answer(state)} | {part: getattr(state, part) for part in shown}
            for name, state in states.items()
            if self.states.get(name) is state
        }
