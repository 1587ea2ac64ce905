"""Bounded, closable pipes between the tasks of a Dask cluster.

A pipe is a `distributed.Queue` of items and a `distributed.Variable` with its state, both under
the pipe's name. A Queue alone has three problems: a consumer that dies within `Queue.get` leaves
its request on the scheduler, and the next item is lost; a queue cannot be closed, so its consumers
cannot end; and a blocking `put` or `get` does not notice that the other side has failed.

So both are used only by functions that run on the scheduler, one request each: it waits there,
looks at items and state together, and puts or takes an item only if its client is still there.
Polling over the network would cost a request each time, and be late.

Pipes end with the client that made them, also if it was killed. Otherwise tasks at both ends would
wait for ever, and keep their slots; Dask does not stop the thread of a task whose client has left.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any

from distributed import Client
from distributed.diagnostics.plugin import SchedulerPlugin

from .errors import PipeClosed, PipeFailed
from .internals import (
    depth_of,
    forget_queue,
    make_queue,
    put_into,
    queues_of,
    set_state,
    state_of,
    take_all,
)
from .task_context import own_client
from .workers import on_scheduler

_WAIT_S = 1.0  # in one request; a pipe that is closed or fails ends it
_SOON_S = 0.02  # most items come soon
_LOOK_EVERY_S = (
    0.002,
    0.005,
)  # between looks on the scheduler, first and later; some microseconds each
_OWNERS = "poolpart-pipe-owners"


@dataclass(frozen=True)
class PipeState:
    """Content of a pipe's Variable, as a dictionary."""

    owner: str  # id of the client that made the pipe
    closed: bool = False
    failure: str = ""  # the reason, empty while there is none
    advice: int = 1


class Pipe:
    """A bounded first-in-first-out connection that can be closed and can fail.

    The maker of the pipe calls `create`, passes it to the tasks on both ends (it is small when
    pickled), and finally calls `delete`; it is also deleted when the maker's client closes or dies.
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
    >>> pipe = Pipe("numbers-1f3a", capacity=3, client=client).create()
    >>> pipe.put((1, 2)); pipe.put("three"); pipe.close()
    >>> list(pipe)
    [(1, 2), 'three']
    >>> pipe.delete(); client.close()
    """

    def __init__(self, name: str, capacity: int, client: Client | None = None) -> None:
        if capacity < 1:
            raise ValueError(f"The capacity of pipe {name!r} is {capacity}; it must be at least 1.")
        self.name, self.capacity = name, capacity
        self._client = client
        self._taken: deque[Any] = deque()
        self._state: PipeState | None = None  # as the last request found it

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
        state = PipeState(self.client.id)
        if not on_scheduler(self.client, _open, name=self.name, state=asdict(state)):
            raise ValueError(
                f"The cluster has a queue or variable {self.name!r}: give the pipe another "
                "name, or delete what is left of an earlier one."
            )
        return self

    def delete(self) -> None:
        """Delete the pipe on the scheduler, with its items; no error if it is gone."""
        forget_pipes(self.client, [self.name])

    def __enter__(self) -> Pipe:
        return self

    def __exit__(self, *_: object) -> None:
        self.delete()

    def _ask(self, question: Callable[..., Any], **arguments: Any) -> tuple[PipeState, Any]:
        """Ask the scheduler; returns the state of the pipe, and the answer."""
        asker = self.client.id
        state, answer = on_scheduler(
            self.client, question, name=self.name, asker=asker, **arguments
        )
        if state is None:
            raise PipeFailed(f"Pipe {self.name!r} does not exist: never created, or deleted.")
        self._state = PipeState(**state)
        return self._state, answer

    # -- both ends ---------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Items queued now."""
        return int(self._ask(_look)[1])

    def close(self) -> None:
        """End the pipe for producers; consumers take the remaining items, then end."""
        self._ask(_change, closed=True)

    def fail(self, reason: str) -> None:
        """Make every `put` and `get`, at both ends, raise `PipeFailed` with this reason.

        The first reason stays.
        """
        self._ask(_change, failure=reason or "no reason was given")

    # -- producers ---------------------------------------------------------------------

    @property
    def advice(self) -> int:
        """Amount that the consumer wants in one item, as of the last `put`.

        A producer may ignore it.
        """
        return (self._state or self._ask(_look)[0]).advice

    def advise(self, amount: int) -> None:
        """Set the amount that producers should put into one item; for one caller."""
        if amount != self.advice:
            self._ask(_change, advice=amount)

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
        deadline = _deadline(timeout_s)
        most = None if unbounded else self.capacity
        while True:
            seconds = _one_wait(deadline)
            state, done = self._ask(_put, item=item, most=most, seconds=seconds)
            if done:
                return
            if state.failure:
                raise PipeFailed(state.failure)
            if state.closed:
                raise PipeClosed(f"Pipe {self.name!r} is closed; nothing can be put into it.")
            if time.monotonic() > deadline:
                raise TimeoutError(f"Pipe {self.name!r} stayed full for {timeout_s} s.")

    # -- consumers ---------------------------------------------------------------------

    def poll(self) -> list[Any]:
        """Take all queued items, possibly none; never waits, and raises `PipeFailed`."""
        return self._take(0.0)[1]

    def _take(self, seconds: float) -> tuple[PipeState, list[Any]]:
        state, items = self._ask(_take, seconds=seconds)
        if state.failure:
            raise PipeFailed(state.failure)
        taken = []
        with suppress(IndexError):  # threads may share this object
            while True:
                taken.append(self._taken.popleft())
        return state, [*taken, *items]

    def get_all(self, timeout_s: float | None = None) -> list[Any]:
        """Take all queued items, as soon as there are any.

        Parameters
        ----------
        timeout_s
            Longest wait in seconds.

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
            state, items = self._take(_one_wait(deadline))
            if items:
                return items
            if state.closed:
                raise PipeClosed(f"Pipe {self.name!r} is closed and empty.")
            if time.monotonic() > deadline:
                raise TimeoutError(f"Nothing came through pipe {self.name!r} for {timeout_s} s.")

    def get(self, timeout_s: float | None = None) -> Any:
        """Take the next item; waits for one, and raises like `get_all`."""
        try:
            # One atomic operation: threads may share this object.
            return self._taken.popleft()
        except IndexError:
            item, *more = self.get_all(timeout_s)
            self._taken.extend(more)
            return item

    def __iter__(self) -> Iterator[Any]:
        """Yield items until the pipe is closed and empty."""
        while True:
            try:
                item = self.get()
            except PipeClosed:
                return
            yield item


def _deadline(timeout_s: float | None) -> float:
    return float("inf") if timeout_s is None else time.monotonic() + timeout_s


def _one_wait(deadline: float) -> float:
    return min(_WAIT_S, max(0.0, deadline - time.monotonic()))


def forget_pipes(client: Client, names: Sequence[str]) -> None:
    """Delete these pipes on the scheduler, with their items; unknown ones are skipped."""
    on_scheduler(client, _forget, names=list(names))


def take_news(
    client: Client, seconds: float, pipes: Collection[str], keys: Collection[str] = ()
) -> dict[str, list[Any]]:
    """Wait until a pipe has an item or a task has ended, and take the items of the pipes.

    Parameters
    ----------
    client
        A client of the cluster.
    seconds
        The longest wait.
    pipes
        Names of pipes; one that was closed, has failed or is gone ends the wait as well.
    keys
        Keys of tasks; one that the scheduler does not know ends the wait as well.

    Returns
    -------
    dict
        Items by pipe, of those that had some.
    """
    arguments = {"pipes": list(pipes), "keys": list(keys), "asker": client.id}
    found: dict[str, list[Any]] = on_scheduler(client, _take_news, seconds=seconds, **arguments)
    return found


# -- on the scheduler ------------------------------------------------------------------

State = dict[str, Any]  # a PipeState


def pipe_of(scheduler: Any, name: str) -> State | None:
    """State of a pipe; None if there is no such pipe."""
    state = state_of(scheduler, name)
    is_pipe = isinstance(state, dict) and "owner" in state and depth_of(scheduler, name) is not None
    return state if is_pipe else None


def pipes_of(scheduler: Any) -> dict[str, State]:
    """States of all pipes, by name."""
    return {name: state for name in queues_of(scheduler) if (state := pipe_of(scheduler, name))}


async def _open(name: str, state: State, dask_scheduler: Any = None) -> bool:
    taken = depth_of(dask_scheduler, name) is not None or state_of(dask_scheduler, name) is not None
    # The last request of a killed owner may arrive after its removal: nobody would delete the pipe,
    # or get the answer.
    if taken or state["owner"] not in dask_scheduler.clients:
        return False
    # Without a limit: if two producers see room for one, the second would wait inside the queue.
    await make_queue(dask_scheduler, name, state)
    if _OWNERS not in dask_scheduler.plugins:
        dask_scheduler.add_plugin(PipeOwners(), name=_OWNERS)
    return True


async def _look(
    name: str, asker: str, dask_scheduler: Any = None
) -> tuple[State | None, int | None]:
    return pipe_of(dask_scheduler, name), depth_of(dask_scheduler, name)


async def _change(
    name: str, asker: str, dask_scheduler: Any = None, **changes: Any
) -> tuple[State | None, None]:
    state = pipe_of(dask_scheduler, name)
    if state is not None:
        if state["failure"]:  # the first reason is the cause, later ones are its consequences
            changes.pop("failure", None)
        state = asdict(replace(PipeState(**state), **changes))
        await set_state(dask_scheduler, name, state)
    return state, None


async def _put(
    name: str, item: Any, most: int | None, seconds: float, asker: str, dask_scheduler: Any = None
) -> tuple[State | None, bool]:
    def room() -> bool:
        return most is None or (depth_of(dask_scheduler, name) or 0) < most

    await _until(seconds, lambda: room() or _has_ended(dask_scheduler, name))
    state, done = pipe_of(dask_scheduler, name), False
    if not _has_ended(dask_scheduler, name) and room() and asker in dask_scheduler.clients:
        await put_into(dask_scheduler, name, item)
        done = True
    return state, done


async def _take(
    name: str, seconds: float, asker: str, dask_scheduler: Any = None
) -> tuple[State | None, list[Any]]:
    await _wait(seconds, [name], [], dask_scheduler)
    state = pipe_of(dask_scheduler, name)
    if state is None or state["failure"] or asker not in dask_scheduler.clients:
        return state, []
    return state, await take_all(dask_scheduler, name)


async def _forget(names: list[str], dask_scheduler: Any = None) -> None:
    for name in names:
        await forget_queue(dask_scheduler, name)
    if _OWNERS in dask_scheduler.plugins and not pipes_of(dask_scheduler):
        dask_scheduler.remove_plugin(_OWNERS)


class PipeOwners(SchedulerPlugin):
    """Deletes the pipes of clients that leave; exists as long as there are pipes."""

    def __init__(self) -> None:
        self._under_way: set[asyncio.Future[None]] = set()  # else they might be collected

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Delete the pipes of a client that has left."""
        names = [name for name, state in pipes_of(scheduler).items() if state["owner"] == client]
        if names:
            work = asyncio.ensure_future(_forget(names, dask_scheduler=scheduler))
            self._under_way.add(work)
            work.add_done_callback(self._under_way.discard)


async def _take_news(
    seconds: float, pipes: list[str], keys: list[str], asker: str, dask_scheduler: Any = None
) -> dict[str, list[Any]]:
    await _wait(seconds, pipes, keys, dask_scheduler)
    if asker not in dask_scheduler.clients:
        return {}
    found = {name: await take_all(dask_scheduler, name) for name in pipes}
    return {name: items for name, items in found.items() if items}


async def _wait(seconds: float, pipes: list[str], keys: list[str], scheduler: Any) -> None:
    """Wait until a pipe has an item, or a pipe or task has ended."""

    def news() -> bool:
        tasks = (scheduler.tasks.get(key) for key in keys)
        return any(depth_of(scheduler, p) or _has_ended(scheduler, p) for p in pipes) or any(
            task is None or task.state in ("memory", "erred") for task in tasks
        )

    await _until(seconds, news)


async def _until(seconds: float, condition: Callable[[], bool]) -> None:
    start = time.monotonic()
    while not condition() and (waited := time.monotonic() - start) < seconds:
        await asyncio.sleep(min(_LOOK_EVERY_S[waited > _SOON_S], seconds - waited))


def _has_ended(scheduler: Any, name: str) -> bool:
    """Whether a pipe was closed, has failed or is gone."""
    state = pipe_of(scheduler, name)
    return state is None or bool(state["closed"] or state["failure"])
