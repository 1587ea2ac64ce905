"""Fetching results from the workers that have them, without waiting on a dead one for long."""

from __future__ import annotations

import asyncio
import random
from collections import defaultdict
from collections.abc import Collection
from typing import Any

from distributed import Client
from distributed.utils import wait_for
from distributed.utils_comm import gather_from_workers


def fetch_available(
    client: Client, keys: Collection[str], patience_s: float = 2.0
) -> dict[str, Any]:
    """Fetch those of the results that can be had now; ask again for the others.

    `Client.gather` is the wrong tool for a long-running consumer. When a worker dies, a
    connection to it is tried for half a minute, and nothing else is delivered meanwhile; and
    a future for a key that was released since makes the scheduler wait for ever for a task
    that nobody submits. This asks where the keys are, takes them from there, and gives up on
    a worker that is silent for `patience_s`: the next call asks anew, and finds them where they
    were computed again. It takes no reference to the keys: whoever submitted them must hold
    theirs.

    Parameters
    ----------
    client
        A client; on a worker, the worker's own.
    keys
        Keys of tasks, finished or not.
    patience_s
        Longest time to wait for an answer of the scheduler, and then for a sign of life of each
        worker, in seconds. What a worker sends may take longer.

    Returns
    -------
    dict
        Results by key, possibly none.
    """

    async def take(address: str, held: list[str]) -> dict[str, Any]:
        who_has = {key: [address] for key in held}
        taking = asyncio.ensure_future(gather_from_workers(who_has, rpc=client.rpc))
        try:
            # To give up one that answers would throw away what has come, and all would come again
            # with the next call, as slowly: on a busy machine that went on for ever. And a worker
            # keeps each message that nobody reads to its end (the error holds its own stream).
            while not (await asyncio.wait([taking], timeout=patience_s))[0]:
                if not await _answers(client, address, patience_s):
                    return {}
            data, *_ = taking.result()
        finally:
            taking.cancel()
        return data

    async def fetch() -> dict[str, Any]:
        try:
            who_has = await wait_for(client.scheduler.who_has(keys=list(keys)), patience_s)
        except TimeoutError:
            return {}
        by_worker: dict[str, list[str]] = defaultdict(list)
        for key, addresses in who_has.items():
            if addresses:
                # Any one of them: if it does not answer, the next call may ask another.
                by_worker[random.choice(list(addresses))].append(key)
        taken = await asyncio.gather(*(take(*worker) for worker in by_worker.items()))
        return {key: result for data in taken for key, result in data.items()}

    return client.sync(fetch)


async def _answers(client: Client, address: str, patience_s: float) -> bool:
    try:
        await wait_for(client.rpc(address).ping(), patience_s)
    except (TimeoutError, OSError):
        return False
    return True
