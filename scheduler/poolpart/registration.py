"""Keep track of the partitions for which this process has registered its clients.

A client registers once per partition (see `membership.py`) and then submits tasks without a further
request. The registration ends when the client loses its connection, or when the partition is
dissolved.
"""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

from distributed import Client

# {client: {partition: scheduler connection on which the client registered}}. The connection is
# stored because a client that reconnects is unknown to the scheduler and must register again.
_connections: WeakKeyDictionary[Client, dict[str, Any]] = WeakKeyDictionary()


def is_registered(client: Client, name: str) -> bool:
    """Return whether a client is registered for a partition on its current connection."""
    connection = client.scheduler_comm
    return connection is not None and _connections.get(client, {}).get(name) is connection


def record_registration(client: Client, name: str, connection: Any) -> None:
    """Record that a client has registered for a partition on the given connection."""
    _connections.setdefault(client, {})[name] = connection


def forget_registrations(name: str | None = None) -> None:
    """Make this process's clients register again for a partition, or for all if it is None."""
    for connections in _connections.values():
        if name is None:
            connections.clear()
        else:
            connections.pop(name, None)
