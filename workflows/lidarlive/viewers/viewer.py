"""Interface of viewers, and the addresses on which they listen."""

from __future__ import annotations

import socket
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from ipaddress import ip_address
from types import NoneType, TracebackType
from typing import Any, NamedTuple, Self

from lidarfiles.clouds.shown_sweeps import ShownSweep, Surroundings
from lidarsim.environment.extras import install_command
from lidarsim.environment.ports import port_number
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.schema.checks import check_type
from lidarsim.words import shorten_name

from .viewer_table import VIEWERS

LOOPBACK = "127.0.0.1"
_PORTS_TRIED = 20
_SHOWN_LETTERS = 60  # maximum length of an invalid address in messages


class Viewer(ABC):
    """Context manager that sends sweeps to connected clients.

    Clients that connect late also receive the surroundings.
    """

    description: str  # message for users that contains the addresses to open

    @abstractmethod
    def show_surroundings(self, surroundings: Surroundings) -> None:
        """Replace the scene, trajectories and planned path."""

    @abstractmethod
    def show_path(self, path: Floats) -> None:
        """Show a planned path in world coordinates, in meters.

        The path has shape (w, 3).
        """

    @abstractmethod
    def show_sweep(self, shown: ShownSweep) -> None:
        """Show a sweep's points, frames and actor boxes without waiting for clients."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect all clients."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def open_viewer(
    name: str, to: str | None = None, title: str = "lidarpool", **options: Any
) -> Viewer:
    """Start the viewer with the given name.

    Parameters
    ----------
    name
        Name of the viewer in `VIEWERS`.
    to
        Address and port to listen on. By default, the standard port of the viewer on the loopback
        interface.
    title
        Title of the data.
    **options
        Further options of the viewer class.

    Raises
    ------
    LidarError
        If the package of the viewer is not installed, or if the address cannot be used.
    """
    check_installed(name)
    module, _, kind = VIEWERS[name].target.partition(":")
    viewer: Viewer = getattr(import_module(module), kind)(to, title, **options)
    return viewer


def check_installed(name: str) -> None:
    """Raise LidarError if the package that a viewer requires is not installed."""
    row = VIEWERS[name]
    if find_spec(row.package) is None:
        command = install_command(f"lidarpool[{row.extra}]")
        raise LidarError(f"{name} requires {row.distribution}. Run {command}.")


class Address(NamedTuple):
    """Network address and port on which a viewer listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @classmethod
    def choose(cls, text: str | None, port: int, count: int = 1) -> Address:
        """Parse ADDRESS:PORT, ADDRESS or :PORT, or choose a free port.

        Missing values default to loopback and `port`. If `text` is empty, another free port is
        chosen if `port` is in use.

        Parameters
        ----------
        text
            Address to parse.
        port
            Default port.
        count
            Number of consecutive ports that must be free.

        Raises
        ------
        LidarError
            If the text is not a valid address, or if a server cannot listen there.
        """
        check_type("to", text, str, NoneType)
        if text:
            address = cls._parse(text, port)
            address._check_free(count)
            return address
        for candidate in range(port, port + count * _PORTS_TRIED, count):
            with suppress(LidarError):
                cls(LOOPBACK, candidate)._check_free(count)
                return cls(LOOPBACK, candidate)
        raise LidarError(f"No free port was found from {port} on. Specify an address and a port.")

    @classmethod
    def _parse(cls, text: str, port: int) -> Address:
        if text.isdecimal():  # The operating system would accept this as an address.
            raise LidarError(
                f"{shorten_name(text, _SHOWN_LETTERS)!r} is not a valid address. If it is a port, "
                f"write {LOOPBACK}:{shorten_name(text, _SHOWN_LETTERS)}."
            )
        has_port = ":" in text and not text.endswith("]")  # [::1] is an IPv6 address
        host, _, digits = text.rpartition(":") if has_port else (text, "", "")
        number = port_number(digits) if digits else port
        if number is None:
            shown = shorten_name(text, _SHOWN_LETTERS)
            raise LidarError(
                f"{shown!r} is not a valid address. Expected ADDRESS:PORT, such as "
                f"{LOOPBACK}:{port}."
            )
        return cls(host.strip("[]") or LOOPBACK, number)

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can connect to the address."""
        entries = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)
        return all(ip_address(entry[4][0]).is_loopback for entry in entries)

    def _check_free(self, count: int) -> None:
        """Raise LidarError unless servers can listen on `count` ports starting at `port`."""
        for port in range(self.port, self.port + count):
            try:
                family, kind, protocol, _, socket_address = socket.getaddrinfo(
                    self.host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
                )[0]
                with socket.socket(family, kind, protocol) as listener:
                    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    listener.bind(socket_address)
            except (OSError, OverflowError) as error:
                reason = getattr(error, "strerror", None) or str(error)
                raise LidarError(
                    f"The address {Address(self.host, port)} cannot be used: {reason}. "
                    "Specify another address and port."
                ) from error

    def wait_until_open(self, timeout_s: float, is_alive: Callable[[], bool]) -> None:
        """Wait until a server listens on the address.

        Raises
        ------
        LidarError
            If the server has exited, or after a timeout.
        """
        give_up_at = time.monotonic() + timeout_s
        while is_alive() and time.monotonic() < give_up_at:
            with suppress(OSError), socket.create_connection(self, timeout=1):
                return
            time.sleep(0.05)
        raise LidarError(f"The server on {self} did not start.")
