"""Recordings whose files can only be read sequentially."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from itertools import islice
from threading import RLock
from typing import Any

from lidarsim.columns.sweep import Sweep
from lidarsim.errors import CutShortError
from lidarsim.words import plural

from ..processes.per_process import PerProcess
from .recording import Recording, RecordingInfo


class SequentialRecording(Recording):
    """A recording in a file that can only be read sequentially.

    Reading the sweeps in order takes a single pass. To go back, the file is read again from its
    start.

    Parameters
    ----------
    info
        What is known before the points are read.
    count
        Number of sweeps.
    """

    def __init__(self, info: RecordingInfo, count: int) -> None:
        super().__init__(info)
        self._count = count
        self._positions = PerProcess(_Position)

    @abstractmethod
    def stored_sweeps(self) -> Iterable[Any]:
        """Return the stored sweeps, starting with the first."""

    @abstractmethod
    def convert(self, stored: Any) -> Sweep:
        """Convert a stored sweep to a `Sweep`."""

    @property
    def lock(self) -> AbstractContextManager[Any]:
        """Lock for reading the file in this process."""
        return self._positions().lock

    def __len__(self) -> int:
        return self._count

    def load(self, number: int) -> Sweep:
        """Read a sweep. The next sweep is read fastest."""
        position = self._positions()
        with position.lock:
            start = position.next_number
            position.next_number = 0  # so that the next call starts again after an error
            if not 0 < start <= number:
                start = 0
                position.remaining = iter(self.stored_sweeps())
            stored = next(islice(position.remaining, number - start, None), None)
            if stored is None:
                raise CutShortError(
                    f"{plural(len(self), 'sweep')} were expected, but there are fewer"
                )
            position.next_number = number + 1
            return self.convert(stored)


@dataclass
class _Position:
    """Position at which a process reads a file, protected by a lock."""

    next_number: int = 0  # number of the next sweep, or 0 to start again
    remaining: Iterator[Any] = field(default_factory=lambda: iter(()))  # from `next_number`
    lock: RLock = field(default_factory=RLock)
