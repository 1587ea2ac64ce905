"""Implementation of a pipe's Queue and Variable in Dask's scheduler extensions."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Iterable
from contextlib import suppress
from typing import Any

from distributed import Client, Future

# Private names of Dask that this module uses, in the form "module:object.attribute(parameters)".
PRIVATE_NAMES = (
    "distributed.queues:QueueExtension.queues",
    "distributed.queues:QueueExtension.create(name, maxsize)",
    "distributed.queues:QueueExtension.put(name)",  # awaits the queue's `put`
    "distributed.queues:QueueExtension.get(name, batch)",  # awaits the queue's `get`
    "distributed.queues:QueueExtension.release(name)",
    "distributed.variable:VariableExtension.variables",
    "distributed.variable:VariableExtension.started",  # condition on which early `get` calls wait
    "distributed.variable:VariableExtension.set(name, key, data)",
    "distributed.scheduler:Scheduler.extensions",
    "distributed.scheduler:Scheduler.handlers",
    "distributed.protocol.serialize:Serialized",
    "distributed.client:Client._send_to_scheduler",
)

VARIABLE_SET = "variable_set"  # name of the request that `Variable.set` sends
CHECK_S = 1.0  # interval at which a wait checks its condition without a notification

Record = dict[str, Any]  # record of an item in Dask's queue extension
Packed = bytes | Record  # item that is sent to a client, which calls `unpack_item`
# Type of the items that pipes put, in addition to Dask's types "msgpack" and "Future". The
# scheduler does not deserialize their value, and a client's `Queue.get` returns the object.
_PICKLED = "pickled"


class Waiters:
    """Requests that wait until a queue changes or a task ends.

    After each `notify`, a request checks its condition again.
    """

    def __init__(self) -> None:
        self._events: set[asyncio.Event] = set()

    def notify(self) -> None:
        """Make all waiting requests check their conditions again."""
        for event in self._events:
            event.set()

    def subscribe(self, event: asyncio.Event) -> None:
        """From now on, set an event at each notification."""
        self._events.add(event)

    def unsubscribe(self, event: asyncio.Event) -> None:
        """No longer set an event at notifications."""
        self._events.discard(event)

    def __len__(self) -> int:
        """Return the number of waiting requests."""
        return len(self._events)


async def wait_until(
    condition: Callable[[], bool], waiters: Collection[Waiters], seconds: float = math.inf
) -> None:
    """Wait until a condition is true, but at most `seconds`.

    The condition is checked after each notification of one of the `waiters`.
    """
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
                async with asyncio.timeout(min(remaining, CHECK_S)):
                    await event.wait()
    finally:
        for group in waiters:
            group.unsubscribe(event)


class BoundedQueue:
    """Queue in which waits end with an error once the pipe has ended.

    It takes the place of an `asyncio.Queue` in Dask's queue extension. The extension calls its
    methods `put`, `get` and `qsize` when a client calls the methods of a `distributed.Queue`.
    Therefore, the capacity applies to the items of all clients, and all waiting requests are
    notified of them.

    Parameters
    ----------
    capacity
        Maximum number of queued items. `extend` ignores it.
    why_no_put
        Function that returns the error that a `put` would raise now, or None.
    why_no_get
        Function that returns the error that a `get` would raise now, or None.
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
        # When the extension deletes a queue, it searches the attribute of this name for futures.
        self._queue: deque[Record] = deque()

    def qsize(self) -> int:
        """Return the number of items."""
        return len(self._queue)

    def empty(self) -> bool:
        """Return whether the queue has no items."""
        return not self._queue

    @property
    def free_capacity(self) -> int:
        """Number of items for which there is space."""
        return max(0, self.capacity - len(self._queue))

    async def put(self, record: Record) -> None:
        """Add an item once the queue has space for it."""
        await wait_until(
            lambda: self.free_capacity > 0 or self._why_no_put() is not None, [self.waiters]
        )
        if (error := self._why_no_put()) is not None:
            raise error
        self.extend([record])

    async def get(self) -> Record:
        """Remove and return the first item once there is one."""
        await wait_until(
            lambda: bool(self._queue) or self._why_no_put() is not None, [self.waiters]
        )
        error = self._why_no_get() if self._queue else self._why_no_put()
        if error is not None:
            raise error
        return self.pop_items(1)[0]

    def extend(self, records: Iterable[Record]) -> None:
        """Add items even if this exceeds the capacity."""
        was_empty = not self._queue
        self._queue.extend(records)
        # Consumers wait for the first item, or linger until the queue is full.
        if was_empty or not self.free_capacity:
            self.waiters.notify()

    def pop_items(self, number: int) -> list[Record]:
        """Remove and return at most `number` items from the front of the queue."""
        had_room = self.free_capacity > 0
        records = [self._queue.popleft() for _ in range(min(number, len(self._queue)))]
        if records and not had_room:  # producers wait only while the queue is full
            self.waiters.notify()
        return records


class QueueAndVariable:
    """Queue of items and Variable of plain data, which have the same name.

    All clients can access both of them.
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
        """Return whether a queue or a variable with the given name exists in the cluster."""
        extensions = scheduler.extensions
        return name in extensions["queues"].queues or name in extensions["variables"].variables

    @property
    def exists(self) -> bool:
        """Whether both the queue and the variable exist. Any client can delete either of them."""
        is_queued = self._queues.queues.get(self.name) is self.queue
        return is_queued and self.name in self._variables.variables

    @property
    def value(self) -> Any:
        """Current value of the variable."""
        return self._variables.variables[self.name]["value"]

    def set(self, value: Any) -> None:
        """Set the variable, and notify all waiting requests."""
        self._variables.variables[self.name] = {"type": "msgpack", "value": value}
        self.queue.waiters.notify()

    async def wake_early_readers(self) -> None:
        """Answer requests that tried to read the variable before it existed."""
        async with self._variables.started:
            self._variables.started.notify_all()

    def put(self, items: Iterable[bytes]) -> None:
        """Add pickled items to the queue, even if this exceeds the capacity."""
        self.queue.extend([_record_of(item) for item in items])

    def pop_items(self, limit: int) -> list[Packed]:
        """Remove at most `limit` items from the queue, and return them in packed form."""
        records = self.queue.pop_items(limit)
        return [_packed(self.name, record) for record in records]

    def delete(self) -> None:
        """Delete the queue and the variable, and end all waiting requests."""
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
    """Convert an item to the form in which it is sent to a client.

    An item from a pipe becomes pickled bytes, and an item from `Queue.put` becomes its record.
    """
    if record["type"] == _PICKLED:
        item: bytes = record["value"].frames[0]
        return item
    return {**record, "queue": name}


def unpack_item(client: Client, packed: Packed) -> Any:
    """Unpack an item from `QueueAndVariable.pop_items`, with the same result as `Queue.get`."""
    from distributed.protocol.pickle import loads

    if isinstance(packed, bytes | bytearray | memoryview):
        return loads(packed)
    if packed["type"] != "Future":
        return packed["value"]
    future = Future(packed["value"], client)
    client._send_to_scheduler(  # the queue no longer needs to keep the result
        {"op": "queue-future-release", "name": packed["queue"], "key": packed["value"]}
    )
    return future


def intercept_variable_set(
    handlers: dict[str, Any], check: Callable[[str, Any], None], on_change: Callable[[str], None]
) -> Callable[[], None]:
    """Intercept requests that set a variable, and return a function that ends the interception.

    Parameters
    ----------
    handlers
        Handlers of the scheduler's requests.
    check
        Function that is called with the name and the new value of a variable, where the value is
        None for a future. The client receives an error that it raises.
    on_change
        Function that is called with the name after the variable was set.
    """
    answer: Callable[..., Awaitable[None]] = handlers[VARIABLE_SET]

    async def set_variable(name: str, key: Any = None, data: Any = None, **options: Any) -> None:
        check(name, data if key is None else None)
        await answer(name=name, key=key, data=data, **options)
        on_change(name)

    def end() -> None:
        if handlers[VARIABLE_SET] is set_variable:  # otherwise, another library has wrapped it
            handlers[VARIABLE_SET] = answer

    handlers[VARIABLE_SET] = set_variable
    return end
