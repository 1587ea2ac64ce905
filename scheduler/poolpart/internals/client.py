"""What clients do beyond their documented methods: waits that lend, callbacks, requests."""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import AbstractContextManager
from functools import cache
from typing import Any

import distributed
from distributed import Client, Future, as_completed, futures_of
from distributed.protocol import to_serialize

from .worker import task_of_thread


@cache  # once: another library may have wrapped the same since, and goes on calling this
def let_waits_lend(context: Callable[[], AbstractContextManager[None]]) -> None:
    """Have what waits for futures in tasks of this process do it within a context, from now on.

    That is `Future.result` and `exception`, `Client.gather`, `wait`, the computing of collections,
    and `as_completed`, where they are called in the thread of a task and have to wait. All but the
    last come down to `Client.sync`, which is called for much else.
    """
    of_future = (Future._result, Future._exception, Future._traceback)
    waits = {*of_future, Client._gather, distributed.client._wait}
    sync, following = Client.sync, as_completed.__next__

    def sync_within(client: Any, function: Any, *args: Any, **kwargs: Any) -> Any:
        if getattr(function, "__func__", function) in waits and task_of_thread():
            owner = getattr(function, "__self__", None)
            futures = futures_of(owner if isinstance(owner, Future) else [*args])
            if any(future.status in ("pending", "lost") for future in futures):
                with context():
                    return sync(client, function, *args, **kwargs)
        return sync(client, function, *args, **kwargs)

    def following_within(done: Any) -> Any:
        if task_of_thread() and not done.has_ready() and not done.is_empty():
            with context():
                return following(done)
        return following(done)

    Client.sync = sync_within
    as_completed.__next__ = as_completed.next = following_within


def when_done(future: Future, function: Callable[[Future], Any]) -> None:
    """Call `function(future)` once the task has succeeded, failed or been cancelled.

    It is called in the client's event loop and must not block. `Future.add_done_callback` uses a
    thread that all callbacks of the process share: a user's callback that waits there for this
    one would wait for ever. It also considers a task done whose lost result is being recomputed.
    """

    async def wait() -> None:
        while future.status in ("pending", "lost"):
            await future._state.wait()
        function(future)

    future.client.loop.add_callback(wait)


async def take_from_worker(client: Client, address: str, keys: Collection[str]) -> dict[str, Any]:
    """Fetch results straight from a worker, as far as it has them."""
    from distributed.utils_comm import gather_from_workers

    data, *_ = await gather_from_workers({key: [address] for key in keys}, rpc=client.rpc)
    return dict(data)


async def ask(client: Client, address: str | None, question: str, **arguments: Any) -> Any:
    """Call such a handler of a worker, or of the scheduler if the address is None.

    None if the scheduler does not have it, which its log tells.
    """
    there = client.scheduler if address is None else client.rpc(address)
    return await getattr(there, question)(**arguments)


def as_bytes(data: Any) -> Any:
    """Wrap bytes so that they are sent without copying."""
    return to_serialize(memoryview(data))
