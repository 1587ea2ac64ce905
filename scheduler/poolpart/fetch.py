"""Transfer results and other data directly from workers, bypassing the scheduler."""

from __future__ import annotations

import asyncio
import random
from asyncio import wait_for
from collections import defaultdict
from collections.abc import Collection, Coroutine
from typing import Any, TypeVar

from distributed import Client, get_worker

from .internals.client import fetch_from_worker, send_request, wrap_bytes
from .internals.names import FETCHING, require_feature
from .internals.worker import add_handler

T = TypeVar("T")

_HANDLER = "poolpart_take_held"  # name of the worker's handler for held bytes

_held: dict[str, Any] = {}  # held bytes by name


def fetch_available(
    client: Client, keys: Collection[str], patience_s: float = 2.0, *, holder: str | None = None
) -> dict[str, Any]:
    """Fetch those results that are currently available.

    Call this function repeatedly to fetch further results. Unlike `Client.gather`, it is suitable
    for a long-running consumer. If a worker dies, `gather` tries to connect to it for half a minute
    and does not return other results in the meantime. If a key was released, its future makes the
    scheduler wait forever for a task that nobody submits.

    This function asks the scheduler which workers hold the results, fetches the results from these
    workers, and gives up on a worker that does not respond for `patience_s` seconds. The next call
    asks again and finds results that were recomputed on other workers. The submitter must hold
    references to the keys.

    Parameters
    ----------
    client
        Client of the cluster. In a task, the client of its worker.
    keys
        Keys of finished or unfinished tasks.
    patience_s
        Maximum time in seconds to wait for a response from the scheduler, and then for a response
        from each worker. A transfer may take longer.
    holder
        Address of a worker that holds all results. If given, the scheduler is not asked.

    Returns
    -------
    dict
        Results by key, possibly empty.
    """
    require_feature(FETCHING)

    async def fetch() -> dict[str, Any]:
        if holder is not None:
            return await _fetch_from(client, holder, list(keys), patience_s)
        try:
            holders = await wait_for(
                send_request(client, None, "who_has", keys=list(keys)), patience_s
            )
        except TimeoutError:
            return {}
        by_worker: dict[str, list[str]] = defaultdict(list)
        for key, addresses in holders.items():
            if addresses:
                # If the selected worker does not respond, the next call may select another one.
                by_worker[random.choice(list(addresses))].append(key)
        results = await asyncio.gather(
            *(_fetch_from(client, address, held, patience_s) for address, held in by_worker.items())
        )
        return {key: result for part in results for key, result in part.items()}

    return client.sync(fetch)


async def _fetch_from(
    client: Client, address: str, held: list[str], patience_s: float
) -> dict[str, Any]:
    request = fetch_from_worker(client, address, held)
    return await _unless_silent(client, address, request, patience_s) or {}


async def _unless_silent(
    client: Client, address: str, request: Coroutine[Any, Any, T], patience_s: float
) -> T | None:
    """Await a request to a worker, but return None if the worker stops responding.

    The worker counts as unresponsive if it does not answer a ping within `patience_s` seconds.
    """
    answer_task = asyncio.ensure_future(request)
    try:
        # Do not give up on a slow worker that still responds to a ping. Its partial transfer would
        # be lost, and on a busy machine the next transfers would not finish either. The worker
        # would also keep every message that was not read to the end, because the error holds a
        # reference to its own stream.
        while not (await asyncio.wait([answer_task], timeout=patience_s))[0]:
            try:
                await wait_for(send_request(client, address, "ping"), patience_s)
            except (TimeoutError, OSError):
                return None
        return answer_task.result()
    finally:
        answer_task.cancel()


def hold_bytes(name: str, data: Any) -> str:
    """Keep bytes in this worker's memory until they are fetched, and return its address.

    The caller must limit the amount of data, because bytes that are never fetched are never freed.
    """
    worker = get_worker()
    _held[name] = data
    add_handler(worker, _HANDLER, _hand_over)
    return str(worker.address)


def holds_bytes() -> bool:
    """Return whether this process holds bytes that have not been fetched yet."""
    return bool(_held)


def fetch_held_bytes(client: Client, address: str, name: str, patience_s: float = 2.0) -> Any:
    """Fetch the bytes that a worker holds under a given name, and free them there.

    `address` is the return value of `hold_bytes`. The result is None if the bytes have already been
    fetched, if the worker has died, or if it does not respond for `patience_s` seconds. A transfer
    may take longer.
    """

    async def take() -> Any:
        request = send_request(client, address, _HANDLER, name=name)
        answer = await _unless_silent(client, address, request, patience_s)
        return answer and answer["data"]

    try:
        return client.sync(take)
    except (OSError, ValueError, AttributeError, TypeError, KeyError):
        return None  # the worker has died, or was restarted and has no such handler


def _hand_over(name: str) -> dict[str, Any]:
    """Return the held bytes, and free them. Workers call this function as a request handler."""
    data = _held.pop(name, None)
    return {"data": None if data is None else wrap_bytes(data)}
