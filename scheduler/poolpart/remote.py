"""Running functions on the scheduler and workers of a cluster, by clients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from distributed import Client
from distributed.comm.core import CommClosedError

from .errors import PoolError
from .internals import identities


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


def worker_identities(client: Client) -> dict[str, dict[str, Any]]:
    """Ask the scheduler for all its workers, by address.

    Raises
    ------
    PoolError
        If the client is closed, or asynchronous.
    """
    check_client(client)
    workers: dict[str, dict[str, Any]] = client.sync(identities, client)
    return workers


def ask_workers(
    client: Client, question: Callable[..., Any], addresses: Sequence[str]
) -> dict[str, Any]:
    """Run a function on workers, outside their tasks.

    Parameters
    ----------
    client
        Client of their cluster.
    question
        What `Client.run` is to run there.
    addresses
        The workers.

    Returns
    -------
    dict
        By address, what each returned, or the exception that it raised there. Workers that
        have died before they answered are left out, as those that had died before.
    """
    if not addresses:  # to Client.run that would be all workers
        return {}
    answers = client.run(question, workers=list(addresses), on_error="return")
    if not any(isinstance(answer, OSError) for answer in answers.values()):
        return dict(answers)
    here = worker_identities(client)
    return {a: answer for a, answer in answers.items() if not _has_died(answer, a in here)}


def _has_died(answer: Any, is_here: bool) -> bool:
    # An OSError may also be what the question raised on a worker that is well.
    return isinstance(answer, CommClosedError) or (isinstance(answer, OSError) and not is_here)
