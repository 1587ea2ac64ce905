"""Runs in a remote storage, such as an object store.

SQLite requires a local disk. The database is therefore kept in a temporary folder of the driver and
copied to the storage every few seconds. When a run is resumed, results that were committed after
the last copy are recovered from the parts of a survey, or from the manifests of a campaign's jobs.
"""

from __future__ import annotations

import secrets
import time
from contextlib import AbstractContextManager
from pathlib import Path

from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import Storage

from .database import FILE, RunDatabase

OWNER = "run.owner"  # file with the mark of the run that may write copies
COPY_EVERY_S = 5.0
COPY_REST = 20  # minimum pause after a copy as a multiple of the time that the copy took


class RemoteRun:
    """Remote storage that contains a copy of a run's database.

    A mark in the storage identifies the run that owns the copy. A resumed run takes over the files
    of an earlier run. If the earlier run is still alive, it detects this before its next copy and
    then exits.

    All methods raise LidarError if the storage fails or is not writable.
    """

    def __init__(self, storage: Storage) -> None:
        storage.claim()
        self.storage = storage
        self.lost = False  # True if another run has taken over
        self._mark = secrets.token_hex(8).encode()
        self._due = float("-inf")

    def claim(self, db: RunDatabase) -> None:
        """Take over the run, and write the first copy of the database."""
        with self._explained():
            self.storage.write(OWNER, self._mark)
        self.save(db)

    def save(self, db: RunDatabase, *, force: bool = False) -> None:
        """Copy the database to the storage if a copy is due or if `force` is True.

        Raise LidarError if another run has taken over.
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
            except FileNotFoundError:  # a later run has finished and deleted the file
                self.lost = True
        if self.lost:
            raise LidarError(
                f"A later run has taken over or deleted {self.storage.url}, so this run was "
                "stopped."
            )

    def _explained(self) -> AbstractContextManager[None]:
        return explain_os_errors(f"The run cannot be stored in {self.storage.url}")


def fetch_database(storage: Storage, path: Path) -> None:
    """Copy the database of a run from a remote storage to a local path, if it exists."""
    with explain_os_errors(f"The run in {storage} cannot be read"):
        if FILE in storage.sizes():
            storage.get(FILE, path)
