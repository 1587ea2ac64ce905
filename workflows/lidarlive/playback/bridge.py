"""Interface of bridges, which publish sweeps with the protocol selected by `--as`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, ClassVar, Self

from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.picture_file import PictureContent
from lidarsim.columns.cloud import Cloud
from lidarsim.environment.extras import install_command
from lidarsim.errors import LidarError
from lidarsim.sweeps.sweeps import Sweeps
from lidarsim.words import did_you_mean

from .bridge_table import BRIDGES
from .schedule import Schedule


@dataclass(frozen=True)
class BridgeOptions:
    """Options of bridges from the command line."""

    # addresses; empty for the default of the bridge on the loopback interface
    to: tuple[str, ...] = ()
    period_ns: int = 0  # period of `--loop` (`PlaybackSource.period_ns`); 0 to play once
    # options that only some bridges have, by name
    settings: Mapping[str, Any] = field(default_factory=dict)


class Bridge(ABC):
    """Context manager that sends sweeps to receivers.

    Entering and leaving the context opens and closes the connections. The constructor of a subclass
    checks the options, and raises LidarError with a single-line message if it cannot send the
    sweeps.

    Parameters
    ----------
    sweeps
        The sweeps that will be sent.
    schedule
        The times of the sweeps. It is started before the first call to `send`.
    options
        Options of the command. Its `settings` are those that the class names in `settings`.
    note
        Function that prints a note for the user.
    """

    format: ClassVar[ExportSpec | None] = None  # format whose columns are sent
    # supported options of the command, in addition to `to`
    settings: ClassVar[tuple[str, ...]] = ()
    lead_ns: ClassVar[float] = 0.0  # time before `due_ns` at which the bridge receives a sweep

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
        """Return the format that determines which columns are sent. It may depend on `settings`.

        Raises
        ------
        LidarError
            If the settings contradict each other.
        """
        del settings
        return cls.format

    @classmethod  # noqa: B027 - most need none
    def check_installed(cls) -> None:
        """Raise LidarError if a package that the bridge imports lazily is missing."""

    @property
    @abstractmethod
    def description(self) -> str:
        """Address at which receivers find the sweeps. It is part of the "ready" message."""

    def due_ns(self, sweep: int) -> float:
        """Return the time at which a sweep is due, in nanoseconds since the start of the survey.

        By default, a sweep is due after its last firing. A bridge that sends a sweep over its whole
        duration overrides this method, and receives the sweep `lead_ns` earlier.
        """
        return float(self.sweeps.ends_ns[sweep])

    def prepare(self, sweep: int, points: Cloud) -> None:  # noqa: B027 - most need nothing
        """Perform slow initialization, such as compilation, before the schedule starts.

        `sweep` is the first sweep of a sensor, which is passed to `send` later.
        """

    def show_content(  # noqa: B027 - most receivers have no use for a scene
        self, content: Callable[[], PictureContent | None]
    ) -> None:
        """Show the scene and the planned path before the first sweep is sent.

        `content` returns the scene with the path, or None if the result does not contain them.
        """

    @abstractmethod
    def send(self, sweep: int, points: Cloud, shift_ns: int) -> None:
        """Send a sweep.

        With `--loop`, its times are `shift_ns` later than in the survey.
        """

    def finish(self) -> None:  # noqa: B027 - messages are sent at once
        """Send the remaining data after the last sweep, and wait until all data has been sent."""

    @property
    def summary(self) -> str:
        """Summary of what was sent, which is available after the context has ended.

        It may be an empty string.
        """
        return ""

    def __enter__(self) -> Self:
        return self

    @abstractmethod
    def __exit__(self, *error: object) -> None:
        """Close all connections, and stop all threads and processes."""


def bridge_class(name: str) -> type[Bridge]:
    """Import and return the class of a bridge.

    Raises
    ------
    LidarError
        If the bridge is unknown, or if its packages are not installed.
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
