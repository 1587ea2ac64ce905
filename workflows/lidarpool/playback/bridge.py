"""Bridges: where played sweeps go, by the protocol of `--as`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, ClassVar, Self

from lidarsim.columns.cloud import Cloud
from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError
from lidarsim.sweeps.sweeps import Sweeps
from lidarsim.words import did_you_mean
from lidarview.picture_file import PictureContent

from ..clouds.writing import ExportSpec
from .bridge_table import BRIDGES
from .schedule import Schedule


@dataclass(frozen=True)
class BridgeOptions:
    """Options of the command that bridges share, or that some bridges have."""

    to: tuple[str, ...] = ()  # addresses; empty for the bridge's default, on the loopback interface
    period_ns: int = 0  # period of --loop (`Played.period_ns`); 0 to play once
    settings: Mapping[str, Any] = field(default_factory=dict)  # {option of some bridges: value}


class Bridge(ABC):
    """Sends sweeps to receivers, as a context manager that opens and closes the connections.

    A subclass checks its options when it is made, and raises LidarError, in one line, for what it
    cannot send.

    Parameters
    ----------
    sweeps
        The sweeps that will be sent.
    schedule
        Their times; it starts before the first `send`.
    options
        Options of the command; `settings` are those that the class names.
    note
        Prints a note for the user.
    """

    format: ClassVar[ExportSpec | None] = None  # clouds of it have the columns that are sent
    settings: ClassVar[tuple[str, ...]] = ()  # options of the command beside `to`
    lead_ns: ClassVar[float] = 0.0  # how long before `due_ns` the bridge gets a sweep

    def __init__(
        self,
        sweeps: Sweeps,
        schedule: Schedule,
        options: BridgeOptions,
        note: Callable[[str], None],
    ) -> None:
        self.sweeps = sweeps
        self.schedule = schedule
        self.options = options
        self.note = note

    @classmethod
    def format_of(cls, settings: Mapping[str, Any]) -> ExportSpec | None:
        """Return `format`, or the format of `settings`.

        Raises LidarError if these do not fit together.
        """
        del settings
        return cls.format

    @classmethod  # noqa: B027 - most need none
    def check_installed(cls) -> None:
        """Raise LidarError if a package is missing that is imported with the first bridge."""

    @property
    @abstractmethod
    def description(self) -> str:
        """The address where receivers find the sweeps, for the line that says «ready»."""

    def due_ns(self, sweep: int) -> float:
        """Return when a sweep is sent, nanoseconds since the survey's start: after its last firing.

        A bridge that spreads a sweep over its time overrides this, and gets it `lead_ns` before.
        """
        return float(self.sweeps.ends_ns[sweep])

    def prepare(self, sweep: int, points: Cloud) -> None:  # noqa: B027 - most need nothing
        """Do what takes long the first time, such as compiling, before the schedule starts.

        `sweep` is the first sweep of a sensor, which `send` gets later.
        """

    def show_content(  # noqa: B027 - most receivers have no use for a scene
        self, content: Callable[[], PictureContent | None]
    ) -> None:
        """Show scene and planned path before the first sweep.

        `content` returns both.
        """

    @abstractmethod
    def send(self, sweep: int, points: Cloud, shift_ns: int) -> None:
        """Send a sweep.

        With `--loop`, its times are `shift_ns` later than in the survey.
        """

    def finish(self) -> None:  # noqa: B027 - messages are sent at once
        """Send what is left after the last sweep, and wait until all is sent."""

    @property
    def summary(self) -> str:
        """What was sent, for the user, once the context has ended, or no text."""
        return ""

    def __enter__(self) -> Self:
        return self

    @abstractmethod
    def __exit__(self, *error: object) -> None:
        """Close all connections, and end all threads and processes."""


def bridge_class(name: str) -> type[Bridge]:
    """Return the class of a bridge.

    LidarError if the bridge is unknown, or its packages are not installed.
    """
    if name not in BRIDGES:
        names = ", ".join(BRIDGES)
        raise LidarError(f"{name!r} is not a bridge.{did_you_mean(name, BRIDGES)} Use {names}.")
    entry = BRIDGES[name]
    module, _, attribute = entry.target.partition(":")
    try:
        bridge: type[Bridge] = getattr(import_module(module), attribute)
    except ModuleNotFoundError as error:
        if not entry.extra or (error.name or "").startswith("lidar"):
            raise
        raise LidarError(
            f"`--as {name}` requires {error.name}. Run "
            f"{install_command(f'lidarpool[{entry.extra}]')}."
        ) from error
    bridge.check_installed()
    return bridge
