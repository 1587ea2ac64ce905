"""Where the points of a survey lie until they are merged: on disk, not in memory."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import LidarpoolError
from ..records import read_into


class PointStore(Protocol):
    """Takes points (POINT) as they come and gives them back by place."""

    def append(self, scans: Sequence[int], counts: Sequence[int], points: NDArray[Any]) -> int:
        """Keep the points of some whole scans, one after the other; returns the first's offset."""

    def read_into(self, offset: int, buffer: memoryview) -> None:
        """Fill `buffer` with what lies at `offset`."""


class TemporaryStore:
    """Points in a file without a name, which is gone when nobody uses it any more.

    It lies where temporary files do; `TMPDIR` says where.
    """

    def __init__(self) -> None:
        self._file: Any = None  # not made before there is something to write
        self._end = 0

    def append(self, scans: Sequence[int], counts: Sequence[int], points: NDArray[Any]) -> int:
        """Keep the points of some scans.

        Raises
        ------
        LidarpoolError
            If the disk is full.
        """
        begin = self._end
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            self._file.seek(begin)
            view = np.ascontiguousarray(points).view(np.uint8).data
            while len(view):
                view = view[self._file.write(view) :]
        except OSError as error:
            raise LidarpoolError(
                f"Points cannot be kept in {tempfile.gettempdir()} ({error.strerror or error}): "
                "make room, or let TMPDIR name another folder."
            ) from error
        self._end = begin + points.nbytes
        return begin

    def read_into(self, offset: int, buffer: memoryview) -> None:
        """Fill `buffer` with what lies at `offset`."""
        read_into(self._file, offset, buffer)
