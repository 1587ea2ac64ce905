"""Who may connect to a page: programs of this machine, and pages that come from it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterable
from urllib.parse import urlsplit

import viser
from viser.infra import WebsockClientConnection

# By these names a browser reaches this machine, also through a port forwarded by SSH, which
# may have any number. A name that somebody else's DNS server lets point here is none of them.
OWN_NAMES = frozenset({"127.0.0.1", "localhost", "::1"})

_POLICY_VIOLATION = 1008  # RFC 6455, 7.4.1
_NAMED_MOST = 10  # of those refused; a page may try for ever, and under many names

_LOGGER = logging.getLogger(__name__)


def may_connect(origins: Iterable[str]) -> bool:
    """Whether a connection with these ``Origin`` headers is from this machine.

    A browser lets any page connect to any server, and tells the server which page it was
    (RFC 6454). A connection without the header is none of a browser's.

    Examples
    --------
    >>> may_connect(["http://localhost:8080"]), may_connect([])
    (True, True)
    >>> may_connect(["https://localhost.example.com"]), may_connect(["null"])
    (False, False)
    """
    return all(map(_is_own, origins))


def _is_own(origin: str) -> bool:
    try:
        parts = urlsplit(origin)
        return parts.scheme in ("http", "https") and parts.hostname in OWN_NAMES
    except ValueError:  # no address at all
        return False


def refuse_strangers(server: viser.ViserServer) -> None:
    """Let no page from elsewhere see what a server shows, nor press its buttons.

    viser itself lets everybody in. That its port is on the loopback interface does not help:
    the browser that opens the stranger's page is on this machine.
    """
    sockets = server._websock_server
    refused: set[str] = set()

    async def admit(client: WebsockClientConnection) -> None:
        connection = sockets._live_connections[client.client_id]
        request = connection.request
        origins = request.headers.get_all("Origin") if request else []
        if may_connect(origins):
            return
        origin = ", ".join(origins)
        if origin not in refused and len(refused) < _NAMED_MOST:
            refused.add(origin)
            _LOGGER.warning("a page of %r wanted to connect to the live page: refused", origin)
        await connection.close(_POLICY_VIOLATION, "only pages of this machine may connect")
        # What it sent meanwhile would still be taken, so that closing is not enough. The next
        # that the handler of this connection does is to wait for what sends and takes messages:
        # cancelled by then, it starts neither, and takes the client off its tables.
        task = asyncio.current_task()
        assert task is not None
        task.cancel()

    sockets.on_client_connect(admit)
    # Whoever was quicker comes again: viser listens before anybody can be kept out.
    sockets.disconnect_all_clients()
