"""Fetching results from the workers that have them, without waiting on a dead one for long."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from distributed import Client
from distributed.utils import wait_for
from distributed.utils_comm import gather_from_workers


def fetch_available(
    client: Client, keys: Collection[str], patience_s: float = 2.0
) -> dict[str, Any]:
    """Those of the results that can be had now; ask again for the others.

    `Client.gather` is the wrong tool for a long-running consumer. When a worker dies, a
    connection to it is tried for half a minute, and nothing else is delivered meanwhile; and
    a future for a key that was released since makes the scheduler wait for ever for a task
    that nobody submits. This asks where the keys are, takes them from there, and gives up on
    a worker after `patience_s`: the next call asks anew, and finds them where they were
    computed again. It takes no reference to the keys: whoever submitted them must hold theirs.

    Parameters
    ----------
    client
        A client; on a worker, the worker's own.
    keys
        Keys of tasks, finished or not.
    patience_s
        Longest time to wait for a worker's answer, in seconds.

    Returns
    -------
    dict
        Results by key, possibly none.
    """

    async def fetch() -> dict[str, Any]:
        who_has = await client.scheduler.who_has(keys=list(keys))
        data, _missing, _failed, _gone = await gather_from_workers(who_has, rpc=client.rpc)
        return data

    async def fetch_or_give_up() -> dict[str, Any]:
        try:
            return await wait_for(fetch(), timeout=patience_s)
        except TimeoutError:
            return {}

    return client.sync(fetch_or_give_up)
