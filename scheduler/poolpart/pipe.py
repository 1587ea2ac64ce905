"""Bounded, closable pipes between the tasks of a Dask cluster.

Why not a bare `distributed.Queue`: a consumer that dies while it blocks in `Queue.get`
leaves its request on the scheduler, and the next item goes to nobody; a queue cannot be
closed, so its consumers cannot end; and a blocking `put` or `get` does not notice that the
other side has failed. A `Pipe` therefore never blocks inside the scheduler. Consumers take
what is there with ``get(batch=True)``, which returns at once, and pause between empty
answers. (`get(timeout=…)` is no way out: each time-out is logged as an error on the
scheduler, and a request that waits is the very thing that loses items.)
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from distributed import Client, Queue, Variable, get_client

from .backoff import Backoff
from .errors import PipeClosed, PipeFailed

_STATE_MAX_AGE_S = 0.05  # how long a pipe may go on before it sees that it was closed or failed


@dataclass(frozen=True)
class _State:
    """What a pipe's Variable holds."""

    closed: bool = False
    failure: str = ""
    advice: int = 1

    def wire(self) -> dict[str, Any]:
        return {"closed": self.closed, "failure": self.failure, "advice": self.advice}


class Pipe:
    """A bounded first-in-first-out connection that can be closed and can fail.

    One `distributed.Queue` carries the items and one `distributed.Variable` the state, both
    under the pipe's name. Whoever makes the pipe calls `create`, hands it (it is small when
    pickled) to the tasks on both ends, and calls `delete` in the end. Any number of
    producers and consumers may share it.

    A consumer takes all that is queued, up to `capacity` items, in one request and hands it
    out one by one, so at most ``capacity * (1 + consumers)`` items are under way. Items
    taken by a consumer that dies are lost with it: whoever needs each item exactly once
    keeps a `Ledger` and puts what is missing again.

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
    >>> pipe.put([1, 2]); pipe.put("three"); pipe.close()
    >>> list(pipe)
    [(1, 2), 'three']
    >>> pipe.delete(); client.close()
    """

    def __init__(self, name: str, capacity: int, client: Client | None = None) -> None:
        if capacity < 1:
            raise ValueError(f"The capacity of pipe {name!r} is {capacity}; it must be at least 1.")
        self.name, self.capacity = name, capacity
        self._client = client
        self._attached: tuple[Queue, Variable] | None = None
        self._taken: deque[Any] = deque()
        self._state = _State()
        self._state_read_at = float("-inf")

    def __reduce__(self) -> tuple[Any, ...]:
        return Pipe, (self.name, self.capacity)

    def __repr__(self) -> str:
        state = self._state.failure or ("closed" if self._state.closed else "open")
        return f"<Pipe {self.name!r} capacity {self.capacity}, {state}>"

    # -- the two parts on the scheduler ------------------------------------------------

    def _parts(self) -> tuple[Queue, Variable]:
        if self._attached is None:
            client = self._client or get_client()
            # A client of its own in both: without it they would look for one again, and on a
            # worker thread that has seceded they would find another.
            self._attached = (
                Queue(self.name, client=client, maxsize=self.capacity),
                Variable(self.name, client=client),
            )
        return self._attached

    def create(self) -> Pipe:
        """Open the pipe on the scheduler; returns itself."""
        self._write_state(_State())
        return self

    def delete(self) -> None:
        """Forget the pipe on the scheduler, with what is still in it."""
        forget_pipes(self._client or get_client(), [self.name])

    def _write_state(self, state: _State) -> None:
        self._parts()[1].set(state.wire())
        self._state, self._state_read_at = state, time.monotonic()

    def _read_state(self, max_age_s: float = _STATE_MAX_AGE_S) -> _State:
        if time.monotonic() - self._state_read_at >= max_age_s:
            try:
                self._state = _State(**self._parts()[1].get(timeout=10))
            except TimeoutError:
                raise PipeFailed(f"Pipe {self.name!r} does not exist (any more).") from None
            self._state_read_at = time.monotonic()
        if self._state.failure:
            raise PipeFailed(self._state.failure)
        return self._state

    # -- both ends ---------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Items queued now."""
        return int(self._parts()[0].qsize())

    def close(self) -> None:
        """No more items will be put; consumers take what is left, then end."""
        self._write_state(_State(True, self._state.failure, self._state.advice))

    def fail(self, reason: str) -> None:
        """Make every `put` and `get`, at both ends, raise `PipeFailed` with this reason."""
        self._write_state(_State(True, reason, self._state.advice))

    # -- producers ---------------------------------------------------------------------

    @property
    def advice(self) -> int:
        """How much the consuming side would like in one item; a producer is free to ignore it."""
        return self._read_state().advice

    def advise(self, amount: int) -> None:
        """Tell producers how much to put into one item."""
        if amount != self._state.advice:
            state = self._read_state(0)
            self._write_state(_State(state.closed, state.failure, amount))

    def put(self, item: Any, timeout_s: float | None = None) -> None:
        """Add an item; waits while the pipe is full.

        Parameters
        ----------
        item
            What msgpack can carry (numbers, strings, bytes, lists, dicts), or a Future.
            It travels through the scheduler: keep it small.
        timeout_s
            Longest wait in seconds.

        Raises
        ------
        PipeClosed
            If the pipe was closed.
        PipeFailed
            If it was failed, with the reason.
        TimeoutError
            If it stayed full for so long.
        """
        queue, _ = self._parts()
        deadline = _deadline(timeout_s)
        pause = Backoff()
        while True:
            if self._read_state().closed:
                raise PipeClosed(f"Pipe {self.name!r} is closed; nothing can be put into it.")
            # Two producers may both see room for one; the second then waits inside the
            # scheduler until there is, which is harmless for a put.
            if queue.qsize() < self.capacity:
                queue.put(item)
                return
            if time.monotonic() > deadline:
                raise TimeoutError(f"Pipe {self.name!r} stayed full for {timeout_s} s.")
            pause.sleep()

    # -- consumers ---------------------------------------------------------------------

    def poll(self) -> list[Any]:
        """Everything that is queued now, possibly nothing; never waits."""
        taken = [*self._taken, *self._parts()[0].get(batch=True)]
        self._taken.clear()
        return taken

    def get_all(self, timeout_s: float | None = None) -> list[Any]:
        """Everything that is queued, as soon as there is anything.

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
        pause = Backoff()
        while True:
            # The state is read before the queue: items put before the closing are seen.
            closed = self._read_state().closed
            if items := self.poll():
                return items
            if closed:
                raise PipeClosed(f"Pipe {self.name!r} is closed and empty.")
            if time.monotonic() > deadline:
                raise TimeoutError(f"Nothing came through pipe {self.name!r} for {timeout_s} s.")
            pause.sleep()

    def get(self, timeout_s: float | None = None) -> Any:
        """The next item; waits for one, and raises as `get_all` does."""
        if not self._taken:
            self._taken.extend(self.get_all(timeout_s))
        return self._taken.popleft()

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


def forget_pipes(client: Client, names: list[str]) -> None:
    """Remove the queues and variables of these pipes from the scheduler.

    Each construction of a Queue counts as a reference and those of killed workers are never
    given back, so `Queue.close` alone would leave the queue behind; this releases it until
    it is gone.
    """
    client.run_on_scheduler(_forget_on_scheduler, names=names)


async def _forget_on_scheduler(names: list[str], dask_scheduler: Any = None) -> None:
    queues = dask_scheduler.extensions["queues"]
    variables = dask_scheduler.extensions["variables"]
    for name in names:
        while name in queues.queues:
            queues.release(name=name, client="poolpart")
        if name in variables.variables:
            await variables.delete(name=name, client="poolpart")
