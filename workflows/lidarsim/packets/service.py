"""Services: what answers a maker's software on the side of a live sensor."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Self


@dataclass(frozen=True)
class Destination:
    """Where the datagrams of a live sensor go."""

    host: str  # IPv4 address
    # {port of `Datagrams`: port of the host}: other ports stay; datagrams to port 0 are not sent.
    ports: Mapping[int, int] = field(default_factory=dict)


class Service(ABC):
    """Answers a maker's software, on threads of its own: a context manager.

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

    @property
    @abstractmethod
    def description(self) -> str:
        """What a user needs to reach the service, for the line that says that it is ready."""

    @abstractmethod
    def __enter__(self) -> Self:
        """Listen; LidarError if the address cannot be used."""

    @abstractmethod
    def __exit__(self, *error: object) -> None:
        """Close the address, and end all threads."""
