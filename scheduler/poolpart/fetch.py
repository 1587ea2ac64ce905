"""Fetching results and held bytes from the workers that have them, past the scheduler."""

from __future__ import annotations

import asyncio
import random
from asyncio import wait_for
from collections import defaultdict
from collections.abc import Collection, Coroutine
from typing import Any, TypeVar

from distributed import Client, get_worker

from .internals.client import fetch_from_worker, send_request, wrap_bytes
from .internals.names import FETCHING, require
from .internals.worker import add_handler

T = TypeVar("T")

_HANDLER = "poolpart_fetch_held_bytes"  # name of the worker's handler for held bytes

_held: dict[str, Any] = {}  # {name: bytes that this process holds}


def fetch_available(
    client: Client, keys: Collection[str], patience_s: float = 2.0, *, holder: str | None = None
) -> dict[str, Any]:
    """Fetch the results that are currently available.

    Later calls fetch further results. `Client.gather` is not suitable for a long-running consumer.
    If a worker dies, it tries to connect to it for half a minute, and does not deliver other
    results in the meantime. If a key was released, its future lets the scheduler wait forever for a
    task that nobody submits. This function asks the scheduler which workers hold the results,
    fetches them, and gives up on a worker that is silent for `patience_s` seconds. The next call
    asks again, and finds recomputed results on other workers. The submitter must hold references to
    the keys.

    Parameters
    ----------
    client
        Client of the cluster. In a task, the client of its worker.
    keys
        Keys of finished or unfinished tasks.
    patience_s
        Maximum time in seconds to wait for a response of the scheduler, and then for a response of
        each worker. A transfer may take longer.
    holder
        Address of a worker that holds all results. If given, the scheduler is not asked.

    Returns
    -------
    dict
        Results by key, possibly empty.
    """
    require(FETCHING)

    async def fetch() -> dict[str, Any]:
        if holder is not None:
            return await _take(client, holder, list(keys), patience_s)
        try:
            holders = await wait_for(
                send_request(client, None, "who_has", keys=list(keys)), patience_s
            )
        except TimeoutError:
            return {}
        by_worker: dict[str, list[str]] = defaultdict(list)
        for key, addresses in holders.items():
            if addresses:
                # Any of the workers: if it does not answer, the next call may ask another.
                by_worker[random.choice(list(addresses))].append(key)
        results = await asyncio.gather(
            *(_take(client, address, held, patience_s) for address, held in by_worker.items())
        )
        return {key: result for part in results for key, result in part.items()}

    return client.sync(fetch)


async def _take(client: Client, address: str, held: list[str], patience_s: float) -> dict[str, Any]:
    request = fetch_from_worker(client, address, held)
    return await _unless_silent(client, address, request, patience_s) or {}


async def _unless_silent(
    client: Client, address: str, request: Coroutine[Any, Any, T], patience_s: float
) -> T | None:
    """Await a request to a worker, or return None if it does not respond in `patience_s`."""
    answer_task = asyncio.ensure_future(request)
    try:
        # Giving up a worker that answers would discard the data so far, and the next call would be
        # as slow: on a busy machine that never ended. And a worker keeps each message that nobody
        # reads to its end (the error holds its own stream).
        while not (await asyncio.wait([answer_task], timeout=patience_s))[0]:
            try:
                await wait_for(send_request(client, address, "ping"), patience_s)
            except (TimeoutError, OSError):
                return None
        return answer_task.result()
    finally:
        answer_task.cancel()


def hold_bytes(name: str, data: Any) -> str:
    """Keep bytes in this worker's memory until `fetch_held_bytes` and return the worker's address.

    The caller has to limit the amount: bytes that nobody fetches stay for ever.
    """
    worker = get_worker()
    _held[name] = data
    add_handler(worker, _HANDLER, _hand_over)
    return str(worker.address)


def holds_bytes() -> bool:
    """Whether this process holds bytes that no driver has fetched yet."""
    return bool(_held)


def fetch_held_bytes(client: Client, address: str, name: str, patience_s: float = 2.0) -> Any:
    """Fetch bytes that a worker holds under a name and then forgets.

    The address is the result of `hold_bytes`. Returns None if the bytes were taken before, or
    if the worker has died or is silent for `patience_s`; a transfer may take longer.
    """

    async def take() -> Any:
        request = send_request(client, address, _HANDLER, name=name)
        answer = await _unless_silent(client, address, request, patience_s)
        return answer and answer["data"]

    try:
        return client.sync(take)
    except (OSError, ValueError, AttributeError, TypeError, KeyError):
        return None  # the worker has died; a restarted one has no such handler


def _hand_over(name: str) -> dict[str, Any]:
    """Return and forget held bytes, as a handler of a worker."""
    data = _held.pop(name, None)
    return {"data": None if data is None else wrap_bytes(data)}
