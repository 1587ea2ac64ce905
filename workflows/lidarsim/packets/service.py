"""Services: what answers a maker's software on the side of a live sensor."""

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
    """Where the datagrams of a live sensor go."""

    host: str  # IPv4 address
    # {port of `Datagrams`: port of the host}: other ports stay; datagrams to port 0 are not sent.
    ports: Mapping[int, int] = field(default_factory=dict)


def is_single_receiver(address: IPv4Address) -> bool:
    """Return True unless an address is unspecified, multicast or broadcast.

    The system knows the broadcast addresses of this machine's networks: it connects no socket to
    them that has not asked for broadcasts.
    """
    if address.is_unspecified or address.is_multicast or address == _BROADCAST:
        return False
    with socket(AF_INET, SOCK_DGRAM) as probe:
        try:
            probe.connect((str(address), _ANY_PORT))
        except PermissionError:
            return False
        except OSError:  # such as no network, which may come
            return True
    return True


class Service(ABC):
    """Answers a maker's software, on separate threads: a context manager.

    Software that never ends a request, or sends what is not understood, must not stop the sensor:
    a service bounds its threads, and the sizes and times of requests.

    Parameters
    ----------
    destination
        Where the datagrams go at first.
    send_to
        Sends the datagrams elsewhere from now on; threads may call it.
    """

    def __init__(self, destination: Destination, send_to: Callable[[Destination], None]) -> None:
        self.destination = destination
        self.send_to = send_to
        # Names of this service in requests, besides the machine's names; set before the start.
        self.names: frozenset[str] = frozenset()

    @property
    @abstractmethod
    def description(self) -> str:
        """What a user needs to reach the service, for the line that says that it is ready."""

    @abstractmethod
    def __enter__(self) -> Self:
        """Listen.

        Raises LidarError if the address cannot be used.
        """

    @abstractmethod
    def __exit__(self, *error: object) -> None:
        """Close the address, and end all threads."""
