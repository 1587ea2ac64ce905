"""The growing file of a journal, made with the first record; the store of its cloud's points."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from .errors import LidarpoolError
from .identity import Identity
from .journal_folder import RECORDS, flush_folder, remove_files, remove_folder, remove_totals
from .journal_format import HEADER, POINTS, pack_header, pack_points
from .records import RecordFile


class JournalStore:
    """Appends records and reads points; a `PointStore`.

    It knows nothing of the journal: whoever still reads its points holds it, and when nobody
    does, its file is closed.

    Parameters
    ----------
    folder
        The journal's; made with the first record.
    identity
        What the run computes, for the header.
    """

    def __init__(self, folder: Path, identity: Identity) -> None:
        self.folder, self.identity = folder, identity
        self.backend = ""  # of the scans, for the header
        self.file: RecordFile | None = None

    def append(self, scans: Sequence[int], counts: Sequence[int], points: NDArray[Any]) -> int:
        """Keep the points of some whole scans; returns where they lie.

        Raises
        ------
        LidarpoolError
            If the disk is full or fails; as in all methods that write.
        """
        head, rows = pack_points(scans, counts, points)
        return self.append_record(POINTS, head, rows) + len(head)

    def append_record(self, kind: int, *pieces: Any) -> int:
        """Keep a record; returns where its payload lies."""
        with self.explained():
            if self.file is None:
                self.file = self._create()
            return self.file.append(kind, *pieces)

    def read_into(self, offset: int, buffer: memoryview) -> None:
        """Fill `buffer` with what lies at `offset`."""
        assert self.file is not None  # or nobody could know of an offset
        self.file.read_into(offset, buffer)

    @property
    def is_there(self) -> bool:
        """Whether the file that is written to is the one that the next run will find."""
        return self.file is not None and self.file.is_at(self.folder / RECORDS)

    def discard(self) -> None:
        """Remove what there is of the journal: there is a header, and nothing was delivered."""
        if self.file is not None:
            with self.explained():
                if self.is_there:  # not what another run has made in its place
                    remove_files(self.folder)
                    remove_folder(self.folder)
            self.close()
            self.file = None

    def close(self) -> None:
        """Let go of the file; afterwards the points cannot be read any more."""
        if self.file is not None:
            self.file.close()

    @contextmanager
    def explained(self) -> Iterator[None]:
        """Say of an error of the disk what it means."""
        try:
            yield
        except OSError as error:
            if isinstance(error, FileNotFoundError) and not self.is_there:
                raise LidarpoolError(
                    f"The journal {self.folder} is gone: it was removed or moved while this run "
                    "wrote to it, and the run was ended."
                ) from error
            raise LidarpoolError(
                f"The journal {self.folder} cannot be written ({error.strerror or error}): make "
                "room on its disk, or give another folder."
            ) from error

    def _create(self) -> RecordFile:
        """Make the journal with its header, and both certain to be there after a crash."""
        self.folder.mkdir(exist_ok=True)
        try:
            file = self._open_alone()
        except BaseException:
            remove_folder(self.folder)
            raise
        try:
            try:
                # What there may be is of an earlier run that came to nothing.
                file.clear()
                remove_totals(self.folder)
                file.append(HEADER, pack_header(self.backend, self.identity))
                file.sync()
                flush_folder(self.folder)
                flush_folder(self.folder.parent)
            except BaseException:
                file.close()
                raise
        except BaseException:  # an interrupt, too: nothing was delivered, nothing is left
            remove_files(self.folder)
            remove_folder(self.folder)
            raise
        return file

    def _open_alone(self) -> RecordFile:
        """Open the file, new or not; LidarpoolError if a run that began meanwhile writes to it."""
        try:
            if os.name == "nt":  # has no locks, and does not remove what is open
                (self.folder / RECORDS).unlink(missing_ok=True)
            file = RecordFile(self.folder / RECORDS)
        except BlockingIOError as error:
            raise LidarpoolError(f"Another run is using the journal {self.folder}.") from error
        if not file.is_at(self.folder / RECORDS):  # that run has ended, and removed it
            file.close()
            raise LidarpoolError(
                f"Another run has just removed the journal {self.folder}: run it again."
            )
        return file
