"""A run that is paused: what is under way still arrives, nothing more is begun."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Protocol


class Pausable(Protocol):
    """A part of a run that can be told to begin nothing more."""

    paused: bool

    @property
    def idle(self) -> bool:
        """Whether nothing is under way."""


class Standstill:
    """Brings a run to stand still, and lets it go on.

    The run is stepped all the while: a worker that dies is noticed, and a lost cluster. As
    nothing is under way when it stands still, there is nothing that could take too long.

    Parameters
    ----------
    wanted
        Says whether the run is to stand still.
    on_still
        Called when it has come to stand still.
    """

    def __init__(self, wanted: Callable[[], bool], on_still: Callable[[], None]) -> None:
        self._wanted, self._on_still = wanted, on_still
        self._since: float | None = None
        self._before = 0.0  # seconds, of earlier times

    @property
    def still(self) -> bool:
        """Whether the run stood still when it was last looked at."""
        return self._since is not None

    @property
    def seconds(self) -> float:
        """Seconds that it has stood still, in all."""
        return self._before + (0.0 if self._since is None else time.monotonic() - self._since)

    def look(self, parts: Iterable[Pausable]) -> None:
        """Ask what is wanted, and tell the parts of the run; call it once each turn."""
        wanted, idle = self._wanted(), True
        for part in parts:
            part.paused = wanted
            idle = idle and part.idle
        still = wanted and idle
        if still and self._since is None:
            self._since = time.monotonic()
            self._on_still()
        elif not still and self._since is not None:
            self._before, self._since = self.seconds, None
