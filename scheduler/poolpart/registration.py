"""Partitions for which the clients of this process are registered with their scheduler.

A client registers once for each partition (`membership.py`); afterwards it submits without a
request. The registration ends with the connection of the client, and with the partition.
"""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

from distributed import Client

# {client: {partition: connection to the scheduler on which the client registered}}. A client
# that was cut off from its scheduler connects again, and the scheduler has forgotten the client.
_connections: WeakKeyDictionary[Client, dict[str, Any]] = WeakKeyDictionary()


def is_registered(client: Client, name: str) -> bool:
    """Return whether a client is registered for a partition."""
    connection = client.scheduler_comm
    return connection is not None and _connections.get(client, {}).get(name) is connection


def record_registration(client: Client, name: str, connection: Any) -> None:
    """Note that a client has registered for a partition by a connection to its scheduler."""
    _connections.setdefault(client, {})[name] = connection


def forget_registrations(name: str | None = None) -> None:
    """Let the clients of this process register again for a partition, or for all with None."""
    for connections in _connections.values():
        if name is None:
            connections.clear()
        else:
            connections.pop(name, None)
