"""What clients do beyond their documented methods: waits that lend, callbacks, requests."""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Awaitable, Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from typing import Any, Protocol

import distributed
from distributed import Client, Future, as_completed, futures_of

ANSWER_S = 300.0  # longest wait for an answer of the scheduler, in seconds
REQUEST_S = 0.05  # a call of the scheduler that takes longer waits for something
_OPTIONS_OF_SYNC = {"asynchronous", "callback_timeout"}  # the others are of the called function


class WaitHooks(Protocol):
    """Functions that a wait calls to lend the slots of the waiting task."""

    def may_lend(self) -> bool:
        """Return whether the task of this thread has slots to lend."""

    def wait_until_wanted(self, answer: concurrent.futures.Future[Any]) -> None:
        """Wait until a call has its answer, or further tasks want the slots."""

    def lend(self, waits: bool = True) -> AbstractContextManager[None]:
        """Lend the slots within the block, if the task waits."""


_hooks: list[WaitHooks] = []  # hooks that `install_wait_hooks` has set


@cache  # once: another library may have wrapped the same since, and goes on calling this
def install_wait_hooks(hooks: WaitHooks) -> None:
    """Wrap the waits of Dask's clients so that waiting tasks of this process lend slots.

    `Future.result` and `exception`, `Client.gather`, `wait`, the computing of collections, and
    `as_completed` lend at once if they have to wait. All other calls of the scheduler, such as
    `Queue.get`, `Variable.get`, `Event.wait` and `Lock.acquire`, lend from the moment on that other
    tasks want the slots, to their end. All but `as_completed` and the results of actors' methods
    come down to `SyncMethodMixin.sync`.
    """
    from distributed.actor import ActorFuture
    from distributed.utils import SyncMethodMixin

    _hooks.append(hooks)
    of_future = (Future._result, Future._exception, Future._traceback)
    waits_for_futures = {*of_future, Client._gather, distributed.client._wait}
    sync = SyncMethodMixin.sync
    next_completed = as_completed.__next__
    result_of_actor = ActorFuture.result

    def sync_lending(caller: Any, function: Any, *args: Any, **kwargs: Any) -> Any:
        if not hooks.may_lend():
            return sync(caller, function, *args, **kwargs)
        if getattr(function, "__func__", function) in waits_for_futures:
            bound_to = getattr(function, "__self__", None)
            futures = futures_of(bound_to if isinstance(bound_to, Future) else [*args])
            pending = [future.status in ("pending", "lost") for future in futures]
            first = kwargs.get("return_when") == "FIRST_COMPLETED"
            waits = all(pending) if first else any(pending)
            with hooks.lend(waits):
                return sync(caller, function, *args, **kwargs)
        if caller.asynchronous or not kwargs.keys().isdisjoint(_OPTIONS_OF_SYNC):
            return sync(caller, function, *args, **kwargs)
        return sync_until_wanted(caller, function, *args, **kwargs)

    def sync_until_wanted(caller: Any, function: Any, *args: Any, **kwargs: Any) -> Any:
        async def call() -> Any:
            return await function(*args, **kwargs)

        answer = asyncio.run_coroutine_threadsafe(call(), caller.loop.asyncio_loop)
        try:
            concurrent.futures.wait([answer], REQUEST_S)
            hooks.wait_until_wanted(answer)
            # One loan to the end of the wait: a task that borrows the slots may wait in turn, and
            # trees of such tasks hang if each looks again and again whether its slots are wanted.
            with hooks.lend(not answer.done()):
                return answer.result()
        finally:
            answer.cancel()  # after an error in this thread

    def next_lending(completed: Any) -> Any:
        waits = not completed.has_ready() and not completed.is_empty()
        with hooks.lend(waits):
            return next_completed(completed)

    def result_of_actor_lending(future: Any, *args: Any, **kwargs: Any) -> Any:
        with hooks.lend(not future.done()):
            return result_of_actor(future, *args, **kwargs)

    SyncMethodMixin.sync = sync_lending
    ActorFuture.result = result_of_actor_lending
    as_completed.__next__ = as_completed.next = next_lending


def lend_slots(waits: bool) -> AbstractContextManager[None]:
    """Lend the slots of this thread's task within the block, if it waits, and tasks lend here."""
    return _hooks[0].lend(waits) if _hooks else nullcontext()


def call_when_done(future: Future, function: Callable[[Future], Any]) -> None:
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


async def fetch_from_worker(client: Client, address: str, keys: Collection[str]) -> dict[str, Any]:
    """Fetch results directly from a worker, without involving the scheduler."""
    from distributed.utils_comm import gather_from_workers

    data, *_ = await gather_from_workers({key: [address] for key in keys}, rpc=client.rpc)
    return dict(data)


async def send_request(client: Client, address: str | None, question: str, **arguments: Any) -> Any:
    """Call a handler of a worker, or of the scheduler if the address is None.

    Returns None if the scheduler lacks the handler, in which case the scheduler logs an error. The
    caller sets a time limit for a worker; `await_scheduler` sets the limit for the scheduler.
    """
    if address is None:
        return await await_scheduler(client, getattr(client.scheduler, question)(**arguments))
    return await getattr(client.rpc(address), question)(**arguments)


async def await_scheduler(
    client: Client, request: Awaitable[Any], seconds: float | None = None
) -> Any:
    """Await a request to the scheduler, for `ANSWER_S` seconds by default.

    Raises
    ------
    OSError
        If the scheduler does not answer in time.
    """
    # A scheduler process that is stopped (SIGSTOP), or whose machine is suspended, keeps its
    # connections open: tried, `Pipe.get`, `Partition.stats` and `Pool.partitions` never returned.
    seconds = ANSWER_S if seconds is None else seconds
    try:
        async with asyncio.timeout(seconds) as limit:
            return await request
    except TimeoutError as error:
        if not limit.expired():
            raise
        # Not a TimeoutError, which `Pipe.get` raises if no item comes.
        raise OSError(
            f"The scheduler at {client.scheduler.address} has not responded for {seconds:g} s. "
            "Check that its process is running."
        ) from error


def gather(client: Client, futures: Sequence[Future]) -> list[Any]:
    """Return the results of finished tasks, as `Client.gather` does.

    Raises OSError, as `await_scheduler` does, where `Client.gather` would wait forever.
    """

    async def watch() -> list[Any]:
        results = asyncio.ensure_future(client.gather(futures, asynchronous=True))
        try:
            # Large results may take longer than an answer of the scheduler.
            while not (await asyncio.wait([results], timeout=ANSWER_S))[0]:
                await send_request(client, None, "identity", n_workers=0)
            return list(results.result())
        finally:
            results.cancel()

    return list(client.sync(watch))


def wrap_bytes(data: Any) -> Any:
    """Wrap bytes so that they are sent without copying."""
    from distributed.protocol import to_serialize

    return to_serialize(memoryview(data))
