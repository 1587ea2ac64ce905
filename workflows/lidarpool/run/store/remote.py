"""The database of a run that is kept in storage which is no disk, such as an object store.

SQLite writes to disks only, so the database is in a temporary folder of the driver, and a copy of
it is put into the storage every few seconds. A survey resumed from a copy finds by its parts what
was committed after it, a campaign the jobs that have ended by their manifests.
"""

from __future__ import annotations

import secrets
import time
from contextlib import AbstractContextManager
from pathlib import Path

from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import Storage

from .database import FILE, RunDatabase

OWNER = "run.owner"  # the mark of the run that may write the copy
COPY_EVERY_S = 5.0
COPY_REST = 20  # a copy that takes a second is followed by none for so many seconds


class RemoteRun:
    """A run in storage: copies of its database, and who may write them.

    A resumed run takes over what an earlier run left. If the earlier run is still alive, it detects
    this before its next copy, and ends.

    All methods raise LidarError if the storage fails, and also if nothing can be written there.
    """

    def __init__(self, storage: Storage) -> None:
        storage.claim()
        self.storage = storage
        self.lost = False  # whether another run has taken over
        self._mark = secrets.token_hex(8).encode()
        self._due = float("-inf")

    def claim(self, db: RunDatabase) -> None:
        """Take the run over, and put a first copy there."""
        with self._explained():
            self.storage.write(OWNER, self._mark)
        self.save(db)

    def save(self, db: RunDatabase, *, now: bool = False) -> None:
        """Put a copy of the database into the storage, if it is time or `now`.

        LidarError if another run has taken over.
        """
        began = time.monotonic()
        if began < self._due and not now:
            return
        self.check()
        with self._explained():
            self.storage.write(FILE, db.copy())
        ended = time.monotonic()
        self._due = ended + max(COPY_EVERY_S, COPY_REST * (ended - began))

    def check(self) -> None:
        """Check that the run is still this one's; LidarError if another has taken over."""
        with self._explained():
            try:
                self.lost = self.storage.read(OWNER) != self._mark
            except FileNotFoundError:  # a later run has finished and deleted it
                self.lost = True
        if self.lost:
            raise LidarError(
                f"A later run has taken over or deleted {self.storage.url}: this one has ended."
            )

    def _explained(self) -> AbstractContextManager[None]:
        return explained(f"The run cannot be kept in {self.storage.url}")


def fetch_database(storage: Storage, path: Path) -> None:
    """Copy the database of a run, if there is one, to this machine."""
    with explained(f"The run in {storage} cannot be read"):
        if FILE in storage.sizes():
            storage.get(FILE, path)
