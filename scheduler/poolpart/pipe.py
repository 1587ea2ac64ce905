"""Bounded, closable pipes between the tasks of a Dask cluster.

Why not a bare `distributed.Queue`: a consumer that dies while it blocks in `Queue.get`
leaves its request on the scheduler, and the next item goes to nobody; a queue cannot be
closed, so its consumers cannot end; and a blocking `put` or `get` does not notice that the
other side has failed. A `Pipe` therefore never blocks inside the scheduler. Consumers take
what is there with ``get(batch=True)``, which returns at once, and between empty answers let
the scheduler look out for items, which takes none. (`get(timeout=…)` is no way out: each
time-out is logged as an error on the scheduler, and a request that waits for an item is the
very thing that loses it.)

A pipe has two parts on the scheduler: a Queue of items and a Variable with its state. Changes
of the state run in the scheduler's event loop, one at a time. If each side read the Variable,
changed it and wrote it back, a `close` could undo a `fail` of the same moment; and a write after
the pipe was deleted would bring half of it back.

Pipes end with the client that made them, also where it was killed. Otherwise tasks at both ends
would wait for ever, and keep their slots from whoever comes after; Dask does not stop the thread
of a task whose client has left.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

from distributed import Client, Queue, Variable
from distributed.diagnostics.plugin import SchedulerPlugin

from .errors import PipeClosed, PipeFailed
from .internals import (
    AttachedQueue,
    depth_of,
    forget_queue,
    make_queue,
    set_state,
    state_of,
    take_all,
)
from .remote import on_scheduler
from .task_context import own_client

T = TypeVar("T")

_NOTHING = object()  # where None is an item

_STATE_MAX_AGE_S = 0.05  # how long a pipe may go on before it sees that it was closed or failed
_WAIT_S = 1.0  # in one request; a pipe that is closed or fails ends it
_NO_SUCH_PIPE_S = 0.05  # how long the scheduler may look for a Variable; it is there or it is not
_UNKNOWN_FUTURE_S = 10.0  # how long the scheduler may wait to hear of a future that is put
_SOON_S = 0.02  # something that comes will come soon, mostly
_LOOK_EVERY_S = (0.002, 0.005)  # on the scheduler, first and then; some microseconds each time
_OWNERS = "poolpart-pipe-owners"


@dataclass(frozen=True)
class PipeState:
    """What a pipe's Variable holds."""

    closed: bool = False
    failure: str = ""  # the reason, empty while there is none
    advice: int = 1


class Pipe:
    """A bounded first-in-first-out connection that can be closed and can fail.

    One `distributed.Queue` carries the items and one `distributed.Variable` the state, both
    under the pipe's name. Whoever makes the pipe calls `create`, hands it (it is small when
    pickled) to the tasks on both ends, and calls `delete` in the end; it is deleted as well
    when the client that made it closes or dies. Any number of
    producers and consumers may share it, in any process and thread; threads may share the
    object itself.

    Once `fail` was called, every `put` and `get` raises `PipeFailed`, within a second also
    those that wait. A pipe that does not exist, or was deleted, raises it as well. When the
    scheduler has died they raise OSError, after Dask's ``distributed.comm.timeouts.connect``.

    A consumer takes all that is queued, some `capacity` items, in one request; `get` and
    iteration hand them out one by one. At most ``capacity * (1 + consumers)`` items are
    under way. Where items are slow and consumers several, choose a small capacity, so that
    none sits on work while another idles. Items taken by a consumer that dies are lost with
    it: whoever needs each item exactly once notes what has arrived, and puts what is missing again.

    Parameters
    ----------
    name
        Unique on the cluster; put something random in it.
    capacity
        Items that may be queued; `put` waits while there are as many. Of several producers
        that see the last free place at the same moment each puts its item, so that ``p`` of
        them can queue ``capacity + p - 1``.
    client
        The client to use. By default, on a worker, the worker's own.

    Examples
    --------
    >>> from distributed import Client
    >>> client = Client(processes=False, dashboard_address="127.0.0.1:0")
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
        self._state = PipeState()
        self._state_read_at = float("-inf")

    def __reduce__(self) -> tuple[Any, ...]:
        return Pipe, (self.name, self.capacity)

    def __repr__(self) -> str:
        state = self._state.failure or ("closed" if self._state.closed else "open")
        return f"<Pipe {self.name!r} capacity {self.capacity}, {state}>"

    # -- coming and going --------------------------------------------------------------

    @property
    def client(self) -> Client:
        """The client that is used."""
        # Kept: a worker's thread that has seceded would find another one each time.
        if self._client is None:
            self._client = own_client()
        return self._client

    @property
    def _queue(self) -> Queue:
        return AttachedQueue(self.name, client=self.client)

    def create(self) -> Pipe:
        """Open the pipe on the scheduler; returns itself.

        Raises
        ------
        ValueError
            If the cluster has a queue or a variable of that name.
        """
        if not open_pipe(self.client, self.name):
            raise ValueError(
                f"The cluster has a queue or variable {self.name!r}: give the pipe another "
                "name, or delete what is left of an earlier one."
            )
        return self

    def delete(self) -> None:
        """Forget the pipe on the scheduler, with what is still in it; no error if it is gone."""
        forget_pipes(self.client, [self.name])

    def __enter__(self) -> Pipe:
        return self

    def __exit__(self, *_: object) -> None:
        self.delete()

    def _missing(self) -> PipeFailed:
        return PipeFailed(f"Pipe {self.name!r} does not exist: never created, or deleted.")

    def _ask(self, question: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        try:
            return question(*args, **kwargs)
        except KeyError:  # the scheduler looked for the queue
            raise self._missing() from None

    def _change_state(self, **changes: Any) -> None:
        state = change_pipe(self.client, self.name, **changes)
        if state is None:
            raise self._missing()
        self._state, self._state_read_at = state, time.monotonic()

    def _read_state(self) -> PipeState:
        if time.monotonic() - self._state_read_at >= _STATE_MAX_AGE_S:
            variable = Variable(self.name, client=self.client)
            try:
                self._state = PipeState(**variable.get(timeout=_NO_SUCH_PIPE_S))
            except TimeoutError:
                raise self._missing() from None
            self._state_read_at = time.monotonic()
        if self._state.failure:
            raise PipeFailed(self._state.failure)
        return self._state

    # -- both ends ---------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Items queued now."""
        return int(self._ask(self._queue.qsize))

    def close(self) -> None:
        """No more items will be put; consumers take what is left, then end.

        Call it when all producers have done: a `put` of another one at the same moment may
        still succeed, with nobody left to take the item.
        """
        self._change_state(closed=True)

    def fail(self, reason: str) -> None:
        """Make every `put` and `get`, at both ends, raise `PipeFailed` with this reason.

        The first reason stays.
        """
        self._change_state(failure=reason or "no reason was given")

    # -- producers ---------------------------------------------------------------------

    @property
    def advice(self) -> int:
        """How much the consuming side would like in one item; a producer is free to ignore it."""
        return self._read_state().advice

    def advise(self, amount: int) -> None:
        """Tell producers how much to put into one item."""
        if amount != self._read_state().advice:
            self._change_state(advice=amount)

    def put(self, item: Any, timeout_s: float | None = None, *, unbounded: bool = False) -> None:
        """Add an item; waits while the pipe is full.

        Parameters
        ----------
        item
            What msgpack can carry (numbers, strings, bytes, lists, dicts), or a Future.
            It travels through the scheduler: keep it small. Between processes lists turn
            into tuples.
        timeout_s
            Longest wait in seconds.
        unbounded
            Put it whatever is queued, which saves a question: for producers that bound what is
            under way themselves.

        Raises
        ------
        PipeClosed
            If the pipe was closed.
        PipeFailed
            If it was failed, with the reason.
        TimeoutError
            If it stayed full for so long.
        ValueError
            If the item is a future of which the scheduler knows nothing.
        """
        deadline = _deadline(timeout_s)
        while True:
            if self._read_state().closed:
                raise PipeClosed(f"Pipe {self.name!r} is closed; nothing can be put into it.")
            # The queue itself has no limit. In one that has, the second of two producers that
            # see room for one would wait inside the scheduler: deaf to `fail`, for ever if
            # the pipe is deleted, and putting its item after its own death if it is killed.
            if unbounded or self.depth < self.capacity:
                self._put_now(item)
                return
            if time.monotonic() > deadline:
                raise TimeoutError(f"Pipe {self.name!r} stayed full for {timeout_s} s.")
            wait_s = min(_WAIT_S, max(0.0, deadline - time.monotonic()))
            await_room(self.client, wait_s, self.name, self.capacity)

    def _put_now(self, item: Any) -> None:
        try:
            # The time-out is for a future's task to become known; nothing else waits here.
            self._ask(self._queue.put, item, timeout=_UNKNOWN_FUTURE_S)
        except TimeoutError:
            raise ValueError(
                f"{item!r} cannot be put into pipe {self.name!r}: the scheduler does not know "
                "its task, because it was cancelled or belongs to another cluster."
            ) from None

    # -- consumers ---------------------------------------------------------------------

    def poll(self) -> list[Any]:
        """Everything that is queued now, possibly nothing; never waits, ignores `fail`."""
        queued = self._ask(self._queue.get, batch=True)
        taken = []
        while (item := self._next_taken(_NOTHING)) is not _NOTHING:
            taken.append(item)
        return [*taken, *queued]

    def _next_taken(self, default: Any) -> Any:
        # One operation, not a look and then a step: threads may share this object.
        try:
            return self._taken.popleft()
        except IndexError:
            return default

    def get_all(self, timeout_s: float | None = None, *, alone: bool = False) -> list[Any]:
        """Everything that is queued, as soon as there is anything.

        Parameters
        ----------
        timeout_s
            Longest wait in seconds.
        alone
            For a pipe that has one reader in all: waiting and taking are one request then, see
            `take_news`, and what is taken for a reader that dies meanwhile is lost. Items must be
            plain data.

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
            wait_s = min(_WAIT_S, max(0.0, deadline - time.monotonic()))
            if alone and (news := take_news(self.client, wait_s, [self.name])):
                return news[self.name]
            # The state is read before the queue: items put before the closing are seen.
            closed = self._read_state().closed
            if items := self.poll():
                return items
            if closed:
                raise PipeClosed(f"Pipe {self.name!r} is closed and empty.")
            if time.monotonic() > deadline:
                raise TimeoutError(f"Nothing came through pipe {self.name!r} for {timeout_s} s.")
            if not alone:
                await_news(self.client, wait_s, [self.name])

    def get(self, timeout_s: float | None = None) -> Any:
        """Take the next item; waits for one, and raises as `get_all` does."""
        self._read_state()
        item = self._next_taken(_NOTHING)
        if item is _NOTHING:
            item, *more = self.get_all(timeout_s)
            self._taken.extend(more)
        return item

    def __iter__(self) -> Iterator[Any]:
        """Items until the pipe is closed and empty."""
        while True:
            try:
                item = self.get()
            except PipeClosed:
                return
            yield item


def _deadline(timeout_s: float | None) -> float:
    return float("inf") if timeout_s is None else time.monotonic() + timeout_s


# -- the two parts on the scheduler -----------------------------------------------------


def open_pipe(client: Client, name: str) -> bool:
    """Make both parts; False if there is a pipe of that name."""
    state = asdict(PipeState())
    return bool(on_scheduler(client, _open, name=name, owner=client.id, state=state))


def change_pipe(client: Client, name: str, **changes: Any) -> PipeState | None:
    """Change fields of the state; returns what it is now, or None if there is no such pipe."""
    state = on_scheduler(client, _change, name=name, changes=changes)
    return None if state is None else PipeState(**state)


def forget_pipes(client: Client, names: Sequence[str]) -> None:
    """Remove these pipes from the scheduler, with what is in them; those unknown are skipped."""
    on_scheduler(client, _forget, names=list(names))


async def _open(name: str, owner: str, state: dict[str, Any], dask_scheduler: Any = None) -> bool:
    taken = depth_of(dask_scheduler, name) is not None or state_of(dask_scheduler, name) is not None
    # An owner that was killed, and whose last question is read after that was seen: nobody would
    # take the pipe away, nor hear the answer.
    if taken or owner not in dask_scheduler.clients:
        return False
    make_queue(dask_scheduler, name)  # without a limit: see `Pipe.put`
    _note_owner(dask_scheduler, name, owner)
    await set_state(dask_scheduler, name, state)
    return True


async def _change(
    name: str, changes: dict[str, Any], dask_scheduler: Any = None
) -> dict[str, Any] | None:
    state: dict[str, Any] | None = state_of(dask_scheduler, name)
    if state is None:
        return None
    if state["failure"]:  # the first reason is the cause, later ones are its consequences
        changes = {key: value for key, value in changes.items() if key != "failure"}
    state = {**state, **changes}
    await set_state(dask_scheduler, name, state)
    return state


async def _forget(names: list[str], dask_scheduler: Any = None) -> None:
    _drop_owners(dask_scheduler, names)
    for name in names:
        await forget_queue(dask_scheduler, name)


class PipeOwners(SchedulerPlugin):
    """Forgets the pipes of clients that leave; there as long as there are pipes."""

    def __init__(self) -> None:
        self.owners: dict[str, str] = {}  # {pipe: id of the client that made it}
        self._under_way: set[asyncio.Future[None]] = set()  # else they might be collected

    def remove_client(self, scheduler: Any, client: str) -> None:
        """Forget the pipes of a client that has left."""
        names = [name for name, owner in self.owners.items() if owner == client]
        if names:
            work = asyncio.ensure_future(_forget(names, dask_scheduler=scheduler))
            self._under_way.add(work)
            work.add_done_callback(self._under_way.discard)


def _note_owner(scheduler: Any, name: str, client: str) -> None:
    """Note that a client has made a pipe."""
    if _OWNERS not in scheduler.plugins:
        scheduler.add_plugin(PipeOwners(), name=_OWNERS)
    scheduler.plugins[_OWNERS].owners[name] = client


def _drop_owners(scheduler: Any, names: Sequence[str]) -> None:
    """Note that pipes are gone; the plugin goes with the last."""
    if _OWNERS in scheduler.plugins:
        owners = scheduler.plugins[_OWNERS].owners
        for name in names:
            owners.pop(name, None)
        if not owners:
            scheduler.remove_plugin(_OWNERS)


# -- waiting until something happens ----------------------------------------------------
#
# Polling over the network costs a request each time, and finds news late. A request that takes an
# item as soon as one comes loses the item if the client that asked has died. So these ask the
# scheduler to wait and, but for `take_news`, take nothing: their answer, early or not, says only
# that it is worth looking now. An answer that nobody reads does no harm.


def await_news(
    client: Client, seconds: float, pipes: Collection[str] = (), keys: Collection[str] = ()
) -> bool:
    """Wait until there is something in a pipe, or a task has ended, but no longer than so.

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
    bool
        Whether something happened.
    """
    return bool(on_scheduler(client, _wait, seconds=seconds, pipes=list(pipes), keys=list(keys)))


def await_room(client: Client, seconds: float, pipe: str, capacity: int) -> bool:
    """Wait until a pipe holds fewer items than so, or is closed, has failed or is gone.

    Returns
    -------
    bool
        Whether that is so; False where the wait was over before.
    """
    return bool(on_scheduler(client, _wait_for_room, seconds=seconds, pipe=pipe, most=capacity))


def take_news(
    client: Client, seconds: float, pipes: Collection[str], keys: Collection[str] = ()
) -> dict[str, list[Any]]:
    """Wait as `await_news` does, and take what is in the pipes, all in one request.

    What is taken is lost if the client that asked dies meanwhile. So it is for one whose death
    ends what it asks for anyway. Items must be plain data, not futures.

    Returns
    -------
    dict
        Items by pipe, of those that had some.
    """
    found: dict[str, list[Any]] = on_scheduler(
        client, _take, seconds=seconds, pipes=list(pipes), keys=list(keys)
    )
    return found


async def _take(
    seconds: float, pipes: list[str], keys: list[str], dask_scheduler: Any = None
) -> dict[str, list[Any]]:
    await _wait(seconds, pipes, keys, dask_scheduler)
    found = {name: await take_all(dask_scheduler, name) for name in pipes}
    return {name: items for name, items in found.items() if items}


async def _wait_for_room(seconds: float, pipe: str, most: int, dask_scheduler: Any = None) -> bool:
    return await _until(
        seconds,
        lambda: _has_ended(dask_scheduler, pipe) or (depth_of(dask_scheduler, pipe) or 0) < most,
    )


async def _wait(
    seconds: float, pipes: list[str], keys: list[str], dask_scheduler: Any = None
) -> bool:
    return await _until(
        seconds,
        lambda: (
            any(depth_of(dask_scheduler, p) or _has_ended(dask_scheduler, p) for p in pipes)
            or _any_ended(dask_scheduler, keys)
        ),
    )


async def _until(seconds: float, condition: Callable[[], bool]) -> bool:
    start = time.monotonic()
    while not condition():
        waited = time.monotonic() - start
        if waited >= seconds:
            return False
        await asyncio.sleep(min(_LOOK_EVERY_S[waited > _SOON_S], seconds - waited))
    return True


def _has_ended(scheduler: Any, name: str) -> bool:
    """Whether a pipe was closed, has failed or is gone."""
    state = state_of(scheduler, name)
    if state is None or depth_of(scheduler, name) is None:
        return True
    return bool(state["closed"] or state["failure"])


def _any_ended(scheduler: Any, keys: list[str]) -> bool:
    tasks = (scheduler.tasks.get(key) for key in keys)
    return any(task is None or task.state in ("memory", "erred") for task in tasks)
