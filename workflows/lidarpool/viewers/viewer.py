"""Interface of viewers, and the table of viewers."""

from __future__ import annotations

import socket
from abc import ABC, abstractmethod
from importlib import import_module
from importlib.util import find_spec
from types import TracebackType
from typing import Literal, NamedTuple, Self

from lidarsim.base.errors import LidarError

from ..export.shown_sweeps import ShownSweep, Surroundings

LOOPBACK = "127.0.0.1"


class Viewer(ABC):
    """A viewer that gets sweeps, and sends them to the programs that are connected.

    A context manager. Programs that connect late get the surroundings, too.
    """

    description: str  # one line for users: what to open

    @abstractmethod
    def show_surroundings(self, surroundings: Surroundings) -> None:
        """Show scene, trajectories and path in place of earlier ones."""

    @abstractmethod
    def show_sweep(self, shown: ShownSweep) -> None:
        """Show the points of a sweep, its frames and its boxes of actors; return at once."""

    @abstractmethod
    def close(self) -> None:
        """Disconnect all programs."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


class ViewerRow(NamedTuple):
    """A kind of viewers: where its class is, and what it needs."""

    module: str
    name: str  # of the class, which takes an address
    package: str  # import package
    distribution: str
    extra: str  # of lidarpool that installs the distribution


VIEWERS = {
    "foxglove": ViewerRow(
        "lidarpool.viewers.foxglove_server", "FoxgloveServer", "foxglove", "foxglove-sdk", "live"
    ),
    "rerun": ViewerRow(
        "lidarpool.viewers.rerun_server", "RerunServer", "rerun", "rerun-sdk", "rerun"
    ),
}
ViewerName = Literal["foxglove", "rerun"]


def open_viewer(name: str, to: str | None = None, title: str = "lidarpool") -> Viewer:
    """Start the viewer of a name at an address, by default the viewer's usual port on loopback.

    Raises
    ------
    LidarError
        If the package of the viewer is missing, or the address cannot be used.
    """
    check_installed(name)
    row = VIEWERS[name]
    viewer: Viewer = getattr(import_module(row.module), row.name)(to, title)
    return viewer


def check_installed(name: str) -> None:
    """Raise LidarError if the package of a viewer is missing in this environment."""
    row = VIEWERS[name]
    if find_spec(row.package) is None:
        raise LidarError(
            f'{name} needs {row.distribution}: pip install "lidarpool[{row.extra}]".'
        )


class Address(NamedTuple):
    """Where a viewer listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    @classmethod
    def parse(cls, text: str | None, port: int) -> Address:
        """Return the address of ADDRESS:PORT, ADDRESS or :PORT; the rest is loopback and `port`.

        LidarError for other text.
        """
        host, _, number = (text or "").rpartition(":")
        if text and ":" not in text:
            host, number = text, ""
        elif text and text.endswith("]"):  # an IPv6 address without port
            host, number = text, ""
        if number and not (number.isascii() and number.isdigit() and int(number) < 1 << 16):
            raise LidarError(f"{text!r} is not an address: give ADDRESS:PORT, such as {LOOPBACK}:{port}.")
        return cls(host.strip("[]") or LOOPBACK, int(number) if number else port)

    def check_free(self) -> None:
        """Raise LidarError unless a server can listen here."""
        try:
            family, kind, protocol, _, place = socket.getaddrinfo(
                self.host, self.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            with socket.socket(family, kind, protocol) as listener:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                listener.bind(place)
        except OSError as error:
            reason = error.strerror or str(error)
            raise LidarError(
                f"{self} cannot be used: {reason}. Give another address and port, such as "
                f"{LOOPBACK}:{self.port + 1 if self.port else 0}."
            ) from error
