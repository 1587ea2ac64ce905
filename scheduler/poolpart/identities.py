"""What the scheduler knows of its workers."""

from __future__ import annotations

from typing import Any

from distributed import Client

from .remote import check_client


def worker_identities(client: Client) -> dict[str, dict[str, Any]]:
    """Ask the scheduler for all its workers, by address.

    `Client.scheduler_info(n_workers=-1)` asks too, but returns what is in an attribute by then.
    Every two seconds the client itself puts an answer there that has no workers, so that on a
    busy machine a cluster of hundreds looks empty now and then.

    Raises
    ------
    PoolError
        If the client is closed, or asynchronous.
    """
    check_client(client)
    identity: dict[str, Any] = client.sync(client.scheduler.identity, n_workers=-1)
    workers: dict[str, dict[str, Any]] = identity["workers"]
    return workers
