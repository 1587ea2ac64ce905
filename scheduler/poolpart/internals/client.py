"""Extend the waits of Dask's clients, and send requests, through private API."""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from functools import cache, wraps
from typing import Any, Protocol

import distributed
from distributed import Client, Future, as_completed, futures_of

ANSWER_S = 300.0  # default time limit for a response of the scheduler
REQUEST_S = 0.05  # a call of the scheduler that takes longer is considered to be waiting
_OPTIONS_OF_SYNC = {"asynchronous", "callback_timeout"}  # options that `sync` itself accepts


class WaitHooks(Protocol):
    """Methods called by a waiting client so that the task lends its slots."""

    def may_lend(self) -> bool:
        """Return whether this thread's task has slots to lend."""

    def wait_until_wanted(self, answer: concurrent.futures.Future[Any]) -> None:
        """Wait until a call has been answered or another task needs the slots."""

    def lend(self, waits: bool = True) -> AbstractContextManager[None]:
        """If `waits` is true, lend the slots within the block."""


_hooks: list[WaitHooks] = []  # set by `install_wait_hooks`


@cache  # only once per process, because another library may have wrapped the wrapper since
def install_wait_hooks(hooks: WaitHooks) -> None:
    """Wrap the wait functions of Dask's clients so that waiting tasks lend their slots.

    `Future.result` and `Future.exception`, `Client.gather`, `wait`, the computation of collections,
    and `as_completed` lend slots immediately if they have to wait. All other calls of the
    scheduler, for example `Queue.get`, `Variable.get`, `Event.wait` and `Lock.acquire`, lend slots
    as soon as other tasks need them, until the end of the call. Except for `as_completed` and the
    results of actor methods, all of these calls go through `SyncMethodMixin.sync`.
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
        if kwargs.get("asynchronous") is False:
            del kwargs["asynchronous"]
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
            # A single loan until the end of the wait. Tasks that borrow the slots may wait in turn,
            # and trees of such tasks would hang if each loan ended when the demand ends.
            with hooks.lend(not answer.done()):
                return answer.result()
        finally:
            answer.cancel()  # has no effect unless an error was raised in this thread

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


_submitter: ContextVar[Any] = ContextVar("_submitter", default=None)  # key of a task


@cache  # only once per process, like `install_wait_hooks`
def name_submitter_in_coroutines() -> None:
    """Make coroutines that a task starts in the event loop submit tasks on behalf of the task.

    Dask sends the key of the submitting task, but looks it up in the state of the thread. Libraries
    such as xgboost and joblib submit in coroutines, which run in the thread of the event loop. A
    coroutine inherits the context variables of the thread that has started it, either with
    `Client.sync` or, after `get_client`, in any other way. Each task has its own context.
    """
    from distributed import Worker
    from distributed.utils import SyncMethodMixin

    sync = SyncMethodMixin.sync
    send = Client._send_to_scheduler
    get_client = Worker._get_client

    @wraps(sync)
    def sync_for_task(caller: Any, function: Any, *args: Any, **kwargs: Any) -> Any:
        with _submitting(_key_of_thread()):
            return sync(caller, function, *args, **kwargs)

    @wraps(send)
    def send_for_task(client: Client, message: dict[str, Any]) -> None:
        if message.get("op") == "update-graph" and message.get("submitting_task") is None:
            message["submitting_task"] = _submitter.get()
        send(client, message)

    @wraps(get_client)
    def get_client_for_task(worker: Any, *args: Any, **kwargs: Any) -> Client:
        client: Client = get_client(worker, *args, **kwargs)
        if (key := _key_of_thread()) is not None:
            _submitter.set(key)
        return client

    SyncMethodMixin.sync = sync_for_task
    Client._send_to_scheduler = send_for_task
    Worker._get_client = get_client_for_task


def _key_of_thread() -> Any:
    """Return the key of the task that this thread runs, or None."""
    from distributed.worker import thread_state

    return getattr(thread_state, "key", None)


@contextmanager
def _submitting(key: Any) -> Iterator[None]:
    """If a task is given, let coroutines that start in the block submit on its behalf."""
    if key is None:
        yield
        return
    token = _submitter.set(key)
    try:
        yield
    finally:
        _submitter.reset(token)


def lend_slots(waits: bool) -> AbstractContextManager[None]:
    """If `waits` is true, lend the slots of the current task within the block.

    Nothing happens if the hooks are not installed in this process.
    """
    return _hooks[0].lend(waits) if _hooks else nullcontext()


def call_when_done(future: Future, function: Callable[[Future], Any]) -> None:
    """Call `function(future)` once a task has succeeded, failed, or been canceled.

    The function is called in the client's event loop and must not block. `Future.add_done_callback`
    is not used for two reasons. All of its callbacks share a thread, so a user's callback that
    waits for this one would wait forever. It also considers a task done while its lost result is
    being recomputed.
    """

    async def wait() -> None:
        while future.status in ("pending", "lost"):
            await future._state.wait()
        function(future)

    future.client.loop.add_callback(wait)


async def fetch_from_worker(client: Client, address: str, keys: Collection[str]) -> dict[str, Any]:
    """Fetch results directly from a worker, bypassing the scheduler."""
    from distributed.utils_comm import gather_from_workers

    data, *_ = await gather_from_workers({key: [address] for key in keys}, rpc=client.rpc)
    return dict(data)


async def send_request(client: Client, address: str | None, handler: str, **arguments: Any) -> Any:
    """Call a request handler on a worker, or on the scheduler if the address is None.

    If the scheduler lacks the handler, it logs an error and the result is None. For a worker, the
    caller sets a time limit. For the scheduler, the limit is that of `await_scheduler`.
    """
    if address is None:
        return await await_scheduler(client, getattr(client.scheduler, handler)(**arguments))
    return await getattr(client.rpc(address), handler)(**arguments)


async def await_scheduler(
    client: Client, request: Awaitable[Any], seconds: float | None = None
) -> Any:
    """Await a request to the scheduler, for at most `ANSWER_S` seconds by default.

    Raises
    ------
    OSError
        If the scheduler does not respond in time.
    """
    # If the scheduler process is stopped (SIGSTOP) or its machine is suspended, its connections
    # remain open, and requests without a time limit would never return.
    seconds = ANSWER_S if seconds is None else seconds
    try:
        async with asyncio.timeout(seconds) as limit:
            return await request
    except TimeoutError as error:
        if not limit.expired():
            raise
        # Not a TimeoutError, because `Pipe.get` raises that if no item arrives.
        raise OSError(
            f"The scheduler at {client.scheduler.address} has not responded for {seconds:g} s. "
            "Check that its process is running."
        ) from error


def gather(client: Client, futures: Sequence[Future]) -> list[Any]:
    """Return the results of finished tasks like `Client.gather`, but with a time limit.

    Raises
    ------
    OSError
        If the scheduler does not respond. `Client.gather` would wait forever.
    """

    async def watch() -> list[Any]:
        results = asyncio.ensure_future(client.gather(futures, asynchronous=True))
        try:
            # A transfer of large results may take longer than the limit, so only check that the
            # scheduler responds.
            while not (await asyncio.wait([results], timeout=ANSWER_S))[0]:
                await send_request(client, None, "identity", n_workers=0)
            return list(results.result())
        finally:
            results.cancel()

    return list(client.sync(watch))


def wrap_bytes(data: Any) -> Any:
    """Wrap bytes so that Dask sends them without copying."""
    from distributed.protocol import to_serialize

    return to_serialize(memoryview(data))
