"""Call functions in threads of this process, and return futures for their results.

The futures are those of `concurrent.futures`, so that `concurrent.futures.wait` and
`asyncio.wrap_future` accept them. Unlike Dask futures, they have no task on the scheduler.
"""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable, Iterable
from contextvars import copy_context
from queue import SimpleQueue
from threading import Thread
from typing import Any, TypeVar

from distributed import Future

from ..internals.client import call_when_done

Result = TypeVar("Result")


def run_in_background(
    call: Callable[[], Result], stop: Callable[[], object] = lambda: None
) -> concurrent.futures.Future[Result]:
    """Call a function in a daemon thread, and return a future for its result or error.

    Canceling the future takes effect immediately and calls `stop`, which should end the call.
    """
    # The future is never marked as running, because it could not be canceled afterwards.
    future: concurrent.futures.Future[Result] = concurrent.futures.Future()
    future.add_done_callback(lambda ended: stop() if ended.cancelled() else None)
    context = copy_context()  # includes Dask's annotations

    def run() -> None:
        try:
            result = context.run(call)
        except BaseException as error:
            _end(future, future.set_exception, error)
        else:
            _end(future, future.set_result, result)

    Thread(target=run, name="poolpart-background", daemon=True).start()
    return future


def _end(
    future: concurrent.futures.Future[Any], set_outcome: Callable[[Any], None], outcome: Any
) -> None:
    """Set the result or error of a future, unless the future was canceled."""
    try:
        set_outcome(outcome)
    except concurrent.futures.InvalidStateError:
        future.set_running_or_notify_cancel()  # notifies `concurrent.futures.wait`


def after_all(
    futures: Iterable[Future | concurrent.futures.Future[Any]],
    function: Callable[[list[Any]], Result],
) -> concurrent.futures.Future[Result]:
    """Call `function(results)` once all futures have succeeded, and return a new future.

    The function is called in a thread of this process. To call it on a partition, pass the futures
    to a task instead: ``partition.submit(function, futures)``.

    Parameters
    ----------
    futures
        Dask futures, futures returned by `Partition.for_each` or `after_all`, or futures of Python
        executors. The results are passed to `function` in the same order.
    function
        Function that is called with the list of results. If a future fails or is canceled, the
        function is not called, and the returned future immediately fails with the same error.

    Returns
    -------
    concurrent.futures.Future
        Future for the return value. Canceling it prevents the call to `function`, but does not
        cancel `futures`.

    Examples
    --------
    >>> best = after_all([other.submit(plan, t) for t in range(5)], min)   # doctest: +SKIP
    >>> best.result()                                                      # doctest: +SKIP
    7
    """
    futures = list(futures)
    # Futures in order of completion, and None if the call was canceled.
    ended: SimpleQueue[Any] = SimpleQueue()
    for future in futures:
        if isinstance(future, Future):
            call_when_done(future, ended.put)
        else:
            future.add_done_callback(ended.put)

    def wait_and_call() -> Result:
        for _ in futures:
            future = ended.get()
            if future is None:
                raise concurrent.futures.CancelledError
            if not isinstance(future, Future) or future.status != "finished":
                future.result()  # raises the error of the future
        return function([future.result() for future in futures])

    return run_in_background(wait_and_call, lambda: ended.put(None))
