"""The totals of a run's frames on disk: replaced as a whole, once in a while."""

from __future__ import annotations

import time
from pathlib import Path

from .journal_folder import FRAMES, FRESH
from .records import DamagedFileError, RecordFile
from .totals import FrameTotals

_TOTALS = 1  # kind of the one record

EVERY_S = 3.0
SHARE = 20  # writing may take one part in so many of the time
_BYTES_PER_S = 100e6  # what a disk takes, until it is known


class TotalsFile:
    """Keeps totals in the folder of a journal.

    Parameters
    ----------
    folder
        The journal's.
    totals
        What is kept.
    """

    def __init__(self, folder: Path, totals: FrameTotals) -> None:
        self.folder, self.totals = folder, totals
        self._kept = 0  # frames that are in the totals on disk
        costs = SHARE * totals.nbytes / _BYTES_PER_S
        self._due = time.monotonic() + max(EVERY_S, costs)

    def load(self) -> None:
        """Take the totals over from an earlier run, if it came to writing them.

        Raises
        ------
        ValueError
            If they are damaged.
        OSError
            If they cannot be read.
        """
        if not (self.folder / FRAMES).is_file():
            return
        file = RecordFile(self.folder / FRAMES)
        try:
            for record in file.records():
                self.totals.unpack(record.payload)
        finally:
            file.close()
        if not self.totals.frames:  # it was replaced as a whole: no crash can have cut it
            raise DamagedFileError(f"{FRAMES} holds no whole record")
        self._kept = self.totals.frames

    def write_if_due(self) -> None:
        """Write the totals every few seconds, or less often where that takes long."""
        if time.monotonic() >= self._due:
            self.write()

    def write(self) -> None:
        """Replace the totals on disk by those of now, unless they hold a part of a frame.

        Raises
        ------
        OSError
            If they cannot be written.
        """
        begun = time.monotonic()
        if self.totals.whole and self.totals.frames > self._kept:
            fresh = self.folder / FRESH
            fresh.unlink(missing_ok=True)
            file = RecordFile(fresh)
            try:
                file.append(_TOTALS, *self.totals.pack())
                file.sync()
            finally:
                file.close()
            fresh.replace(self.folder / FRAMES)
            self._kept = self.totals.frames
        now = time.monotonic()
        self._due = now + max(EVERY_S, SHARE * (now - begun))
