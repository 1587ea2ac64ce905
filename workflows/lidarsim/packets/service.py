"""Base class of services that answer a manufacturer's software for a live sensor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from ipaddress import IPv4Address
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Self

_BROADCAST = IPv4Address("255.255.255.255")
_ANY_PORT = 9


@dataclass(frozen=True)
class Destination:
    """Destination of the datagrams of a live sensor."""

    host: str  # IPv4 address
    # {port of `Datagrams`: port of the host}. Other ports do not change. Datagrams for port 0 are
    # not sent.
    ports: Mapping[int, int] = field(default_factory=dict)


def is_single_receiver(address: IPv4Address) -> bool:
    """Return whether an address is neither unspecified nor a multicast or broadcast address.

    The operating system knows the broadcast addresses of the local networks. It refuses to connect
    sockets to them unless broadcasting has been enabled.
    """
    if address.is_unspecified or address.is_multicast or address == _BROADCAST:
        return False
    with socket(AF_INET, SOCK_DGRAM) as probe:
        try:
            probe.connect((str(address), _ANY_PORT))
        except PermissionError:
            return False
        except OSError:  # for example because there is no network yet
            return True
    return True


class Service(ABC):
    """Context manager that answers a manufacturer's software from separate threads.

    Clients that never complete a request or send invalid data must not stop the sensor, so a
    service limits its threads and the size and duration of requests.

    Parameters
    ----------
    destination
        Initial destination of the datagrams.
    send_to
        Function that redirects the datagrams. It must be thread-safe.
    """

    def __init__(self, destination: Destination, send_to: Callable[[Destination], None]) -> None:
        self.destination = destination
        self.send_to = send_to
        # Further names of this service in requests, in addition to the machine's names. They must
        # be set before the service starts.
        self.names: frozenset[str] = frozenset()

    @property
    @abstractmethod
    def description(self) -> str:
        """Instructions for reaching the service, shown when it is ready."""

    @abstractmethod
    def __enter__(self) -> Self:
        """Start listening.

        Raises LidarError if the address cannot be used.
        """

    @abstractmethod
    def __exit__(self, *error: object) -> None:
        """Stop listening, and end all threads."""
