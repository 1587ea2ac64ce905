"""Running a function of this package on the scheduler; a leaf module."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from distributed import Client

from .errors import PoolError


def on_scheduler(client: Client, function: Callable[..., Any], **kwargs: Any) -> Any:
    """Call `function(**kwargs, dask_scheduler=…)` in the scheduler's event loop.

    Raises
    ------
    PoolError
        If the scheduler's environment lacks this package, or the client cannot be asked.
    """
    check_client(client)
    try:
        return client.run_on_scheduler(function, **kwargs)
    except ModuleNotFoundError as error:
        raise PoolError(
            f"The scheduler at {client.scheduler.address} has no module {error.name!r}: start "
            "it in the environment that is used here."
        ) from error


def check_client(client: Client) -> None:
    """Say so where a client cannot be asked anything; PoolError.

    What comes without this is a coroutine that nobody awaits, or an AttributeError.
    """
    if client.asynchronous:
        raise PoolError(
            "poolpart needs a client that is not asynchronous: make one with Client(address), "
            "and call it in a thread (asyncio.to_thread) where there is an event loop."
        )
    if client.status in ("closing", "closed"):
        raise PoolError(f"The client is {client.status}: make another one, and the pool anew.")
