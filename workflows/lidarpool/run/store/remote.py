"""The database of a run in storage that is not a disk, such as an object store.

SQLite writes to disks only, so the database is in a temporary folder of the driver, and a copy is
put into the storage every few seconds. A survey resumed from a copy finds later commits by its
parts, a campaign finds ended jobs by their manifests.
"""

from __future__ import annotations

import secrets
import time
from contextlib import AbstractContextManager
from pathlib import Path

from lidarsim.errors import LidarError, explained
from lidarsim.io.storage import Storage

from .database import FILE, RunDatabase

OWNER = "run.owner"  # the mark of the run that may write the copy
COPY_EVERY_S = 5.0
COPY_REST = 20  # pause after a copy, as a multiple of the time that the copy took


class RemoteRun:
    """A run in storage: copies of its database, and the mark of the run that may write copies.

    A resumed run takes over the files of an earlier run. If the earlier run is still alive, it
    detects this before its next copy, and ends.

    All methods raise LidarError if the storage fails or cannot be written.
    """

    def __init__(self, storage: Storage) -> None:
        storage.claim()
        self.storage = storage
        self.lost = False  # True if another run has taken over
        self._mark = secrets.token_hex(8).encode()
        self._due = float("-inf")

    def claim(self, db: RunDatabase) -> None:
        """Take the run over, and write a first copy of the database."""
        with self._explained():
            self.storage.write(OWNER, self._mark)
        self.save(db)

    def save(self, db: RunDatabase, *, force: bool = False) -> None:
        """Copy the database to the storage, if a copy is due or with `force`.

        LidarError if another run has taken over.
        """
        start_s = time.monotonic()
        if start_s < self._due and not force:
            return
        self.check()
        with self._explained():
            self.storage.write(FILE, db.copy())
        stop_s = time.monotonic()
        self._due = stop_s + max(COPY_EVERY_S, COPY_REST * (stop_s - start_s))

    def check(self) -> None:
        """Raise LidarError if another run has taken over or deleted the storage."""
        with self._explained():
            try:
                self.lost = self.storage.read(OWNER) != self._mark
            except FileNotFoundError:  # a later run has finished and deleted it
                self.lost = True
        if self.lost:
            raise LidarError(
                f"A later run has taken over or deleted {self.storage.url}, so this run was "
                "stopped."
            )

    def _explained(self) -> AbstractContextManager[None]:
        return explained(f"The run cannot be stored in {self.storage.url}")


def fetch_database(storage: Storage, path: Path) -> None:
    """Copy the database of a run in storage, if there is a database, to a local path."""
    with explained(f"The run in {storage} cannot be read"):
        if FILE in storage.sizes():
            storage.get(FILE, path)
