"""The Queue and the Variable of a pipe, in the extensions of Dask that all clients use."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Iterable
from contextlib import suppress
from typing import Any

from distributed import Client, Future

# Private names of Dask that this module relies on: "module:object.attribute(parameters)".
PRIVATE_NAMES = (
    "distributed.queues:QueueExtension.queues",
    "distributed.queues:QueueExtension.create(name, maxsize)",
    "distributed.queues:QueueExtension.put(name)",  # awaits `put` of the queue
    "distributed.queues:QueueExtension.get(name, batch)",  # awaits `get` of the queue
    "distributed.queues:QueueExtension.release(name)",
    "distributed.variable:VariableExtension.variables",
    "distributed.variable:VariableExtension.started",  # condition of `get` before the first `set`
    "distributed.variable:VariableExtension.set(name, key, data)",
    "distributed.scheduler:Scheduler.extensions",
    "distributed.scheduler:Scheduler.handlers",
    "distributed.protocol.serialize:Serialized",
    "distributed.client:Client._send_to_scheduler",
)

VARIABLE_SET = "variable_set"  # the request of `Variable.set`
LOOK_S = 1.0  # a wait looks so often whether it has ended, even if nothing has changed

Record = dict[str, Any]  # an item's record, as Dask's queue extension keeps it
Packed = bytes | Record  # an item on its way to a client (`unpack_item`)
# Type of the items that pipes put. Their value is serialized: the scheduler passes it on, and
# `Queue.get` of a client returns the object. Clients themselves put types "msgpack" and "Future".
_PICKLED = "pickled"


class Waiters:
    """Requests that wait for changes of a queue, or for the end of a task.

    A request looks again whether its condition holds after each `notify`.
    """

    def __init__(self) -> None:
        self._events: set[asyncio.Event] = set()

    def notify(self) -> None:
        """Let the requests look again."""
        for event in self._events:
            event.set()

    def subscribe(self, event: asyncio.Event) -> None:
        """Set an event at each change."""
        self._events.add(event)

    def unsubscribe(self, event: asyncio.Event) -> None:
        """Do not set the event any more."""
        self._events.discard(event)

    def __len__(self) -> int:
        """Return the number of requests that wait."""
        return len(self._events)


async def wait_until(
    condition: Callable[[], bool], waiters: Collection[Waiters], seconds: float = math.inf
) -> None:
    """Wait until a condition that depends on queues holds, or for `seconds`."""
    if condition():
        return
    deadline = time.monotonic() + seconds
    event = asyncio.Event()
    for group in waiters:
        group.subscribe(event)
    try:
        while not condition() and (remaining := deadline - time.monotonic()) > 0:
            event.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(min(remaining, LOOK_S)):
                    await event.wait()
    finally:
        for group in waiters:
            group.unsubscribe(event)


class BoundedQueue:
    """Queue of items whose waits end with an error once the pipe has ended.

    It stands in Dask's queue extension in place of an `asyncio.Queue`: the extension answers
    `put`, `get` and `qsize` of a `distributed.Queue` by the methods of the same names. So what any
    client puts or takes is bounded by the capacity, and is noticed by all that wait.

    Parameters
    ----------
    capacity
        Items that may be queued, except by `extend`.
    why_no_put
        Returns the error of a `put` now, or None while the pipe is open.
    why_no_get
        Returns the error of a `get` now, or None while the items may be taken.
    """

    def __init__(
        self,
        capacity: int,
        why_no_put: Callable[[], Exception | None],
        why_no_get: Callable[[], Exception | None],
    ) -> None:
        self.capacity = capacity
        self.waiters = Waiters()
        self._why_no_put = why_no_put
        self._why_no_get = why_no_get
        # The extension looks in an attribute of this name for futures, when it deletes a queue.
        self._queue: deque[Record] = deque()

    def qsize(self) -> int:
        """Return the number of items."""
        return len(self._queue)

    def empty(self) -> bool:
        """Whether the queue has no items."""
        return not self._queue

    @property
    def free_capacity(self) -> int:
        """Items that may be put now."""
        return max(0, self.capacity - len(self._queue))

    async def put(self, record: Record) -> None:
        """Wait until the queue has room, then add an item."""
        await wait_until(
            lambda: self.free_capacity > 0 or self._why_no_put() is not None, [self.waiters]
        )
        if (error := self._why_no_put()) is not None:
            raise error
        self.extend([record])

    async def get(self) -> Record:
        """Wait until the queue has an item, then remove the first item."""
        await wait_until(
            lambda: bool(self._queue) or self._why_no_put() is not None, [self.waiters]
        )
        error = self._why_no_get() if self._queue else self._why_no_put()
        if error is not None:
            raise error
        return self.pop_items(1)[0]

    def extend(self, records: Iterable[Record]) -> None:
        """Add items, also beyond the capacity."""
        was_empty = not self._queue
        self._queue.extend(records)
        if (
            was_empty or not self.free_capacity
        ):  # takers wait for the first item, or linger until it is full
            self.waiters.notify()

    def pop_items(self, number: int) -> list[Record]:
        """Remove and return the first items, `number` at most."""
        had_room = self.free_capacity > 0
        records = [self._queue.popleft() for _ in range(min(number, len(self._queue)))]
        if records and not had_room:  # producers wait only while the queue is full
            self.waiters.notify()
        return records


class QueueAndVariable:
    """A `distributed.Queue` of items and a `distributed.Variable` with a common name.

    All clients of the cluster see both. The value of the variable is plain data.
    """

    def __init__(self, scheduler: Any, name: str, queue: BoundedQueue, value: Any) -> None:
        self.name = name
        self.queue = queue
        self._queues = scheduler.extensions["queues"]
        self._variables = scheduler.extensions["variables"]
        self._queues.create(name=name, maxsize=queue.capacity)
        self._queues.queues[name] = queue
        self.set(value)

    @staticmethod
    def is_used(scheduler: Any, name: str) -> bool:
        """Whether the cluster has a queue or a variable of a name."""
        extensions = scheduler.extensions
        return name in extensions["queues"].queues or name in extensions["variables"].variables

    @property
    def exists(self) -> bool:
        """Whether both exist: any client can delete either."""
        is_queued = self._queues.queues.get(self.name) is self.queue
        return is_queued and self.name in self._variables.variables

    @property
    def value(self) -> Any:
        """Value of the variable."""
        return self._variables.variables[self.name]["value"]

    def set(self, value: Any) -> None:
        """Set the variable, and let all waiting requests look at its value."""
        self._variables.variables[self.name] = {"type": "msgpack", "value": value}
        self.queue.waiters.notify()

    async def wake_early_readers(self) -> None:
        """Answer the requests that tried to read the variable before it existed."""
        async with self._variables.started:
            self._variables.started.notify_all()

    def put(self, items: Iterable[bytes]) -> None:
        """Add pickled items to the queue, also beyond its capacity."""
        self.queue.extend([_record_of(item) for item in items])

    def pop_items(self, limit: int) -> list[Packed]:
        """Remove the first items, at most `limit`, from the queue, and return them packed."""
        records = self.queue.pop_items(limit)
        return [_packed(self.name, record) for record in records]

    def delete(self) -> None:
        """Delete queue and variable, and end the waiting requests."""
        while self._queues.queues.get(self.name) is self.queue:
            self._queues.release(name=self.name)
        self._variables.variables.pop(self.name, None)
        self.queue.waiters.notify()


def _record_of(item: bytes) -> Record:
    from distributed.protocol.serialize import Serialized

    return {
        "type": _PICKLED,
        "value": Serialized({"serializer": "pickle", "writeable": ()}, [item]),
    }


def _packed(name: str, record: Record) -> Packed:
    """Pack an item for a client: the pickled item, or the record of an item of `Queue.put`."""
    if record["type"] == _PICKLED:
        item: bytes = record["value"].frames[0]
        return item
    return {**record, "queue": name}


def unpack_item(client: Client, packed: Packed) -> Any:
    """Return an item that a client has got from `QueueAndVariable.take`, as `Queue.get` would."""
    from distributed.protocol.pickle import loads

    if isinstance(packed, bytes | bytearray | memoryview):
        return loads(packed)
    if packed["type"] != "Future":
        return packed["value"]
    future = Future(packed["value"], client)
    client._send_to_scheduler(  # the queue need not hold the result any more
        {"op": "queue-future-release", "name": packed["queue"], "key": packed["value"]}
    )
    return future


def intercept_variable_set(
    handlers: dict[str, Any], check: Callable[[str, Any], None], on_change: Callable[[str], None]
) -> Callable[[], None]:
    """Check and follow the variables that clients set, and return a function that ends this.

    Parameters
    ----------
    handlers
        Requests that the scheduler answers.
    check
        Is called with the name and the value of a variable that a client sets, None for a future;
        an error that it raises is the client's.
    on_change
        Is called with the name once the variable has its value.
    """
    answer: Callable[..., Awaitable[None]] = handlers[VARIABLE_SET]

    async def set_variable(name: str, key: Any = None, data: Any = None, **options: Any) -> None:
        check(name, data if key is None else None)
        await answer(name=name, key=key, data=data, **options)
        on_change(name)

    def end() -> None:
        if handlers[VARIABLE_SET] is set_variable:  # else another library has wrapped it since
            handlers[VARIABLE_SET] = answer

    handlers[VARIABLE_SET] = set_variable
    return end
