"""The files of a job in a data set, from which formats read single sweeps."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lidarsim.base.arrays import AnyArray
from lidarsim.base.storage import Storage
from lidarsim.columns.cloud import Cloud
from lidarsim.sweeps.sweeps import Sweeps

from .cloud_format import Entry, PointColumns

T = TypeVar("T")


class JobReader:
    """The files of a job in a data set, which are read in any order, in a single thread."""

    def __init__(
        self,
        storage: Storage,
        sweeps: Sweeps,
        entry: Entry,
        layout: str,
        classes: Mapping[int, str],
    ) -> None:
        self.storage = storage
        self.sweeps = sweeps
        self.entry = entry
        self.layout = layout  # of points in mcap
        self.classes = classes  # names of the classes of all jobs
        self.last = ""  # name of the file of rows that was read last, for errors
        self.opened = ExitStack()  # opened files, which `close` closes
        self._cache: dict[str, Any] = {}
        self._copies: Path | None = None

    def cached(self, key: str, make: Callable[[], T]) -> T:
        """Return the value of a key, which `make` makes once."""
        if key not in self._cache:
            self._cache[key] = make()
        value: T = self._cache[key]
        return value

    def expect(self, names: Sequence[str]) -> None:
        """Have the system load files into its memory, because they will be read soon."""
        # Reading will raise any OSError; only Linux has all of these functions.
        with suppress(OSError, AttributeError):
            for name in names:
                with io.FileIO(self.storage.path(name)) as file:
                    try:
                        os.preadv(file.fileno(), [bytearray(1)], 0, os.RWF_NOWAIT)
                        return
                    except OSError:
                        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_WILLNEED)

    def close(self) -> None:
        """Close opened files, and remove local copies."""
        self.opened.close()
        if self._copies is not None:
            _remove(self._copies, os.getpid())

    def local(self, name: str) -> Path:
        """Return the path of a file: of a copy until `close`, if the storage is remote."""
        if self.storage.is_local:
            return Path(self.storage.path(name))
        if self._copies is None:
            self._copies = Path(tempfile.mkdtemp(prefix="lidarpool-"))
            weakref.finalize(self, _remove, self._copies, os.getpid())
        path = self._copies / Path(name).name
        self.storage.get(name, path)
        return path

    def rows(self, name: str, row: np.dtype[Any], count: int | None = None) -> AnyArray:
        """Read a file of rows.

        Raises ValueError for a partial row, or another number than `count`.
        """
        points_file = self.last
        self.last = name
        if self.storage.is_local:
            with io.FileIO(self.storage.path(name)) as file:
                data = np.empty(os.fstat(file.fileno()).st_size, np.uint8)
                data = data[: file.readinto(data.data)]
        else:
            data = np.frombuffer(bytearray(self.storage.read(name)), np.uint8)
        if len(data) % row.itemsize:
            raise ValueError(
                f"its size of {len(data)} bytes is not a multiple of the row size "
                f"({row.itemsize} bytes)"
            )
        rows = data.view(row)
        if count not in (None, len(rows)):
            raise ValueError(f"it has {len(rows):,} points, but {points_file} has {count:,}")
        return rows  # PyTorch requires writable arrays

    def in_sensor(self, sweep: int, cloud: Cloud) -> PointColumns:
        """Return the points of a cloud in the sensor frame, and all their columns."""
        positions = self.sweeps.in_sensor(sweep, cloud.positions).astype(np.float32)
        columns = self.sweeps.columns_in_sensor(sweep, cloud)
        return positions, {name: np.array(array) for name, array in columns.items()}


def _remove(folder: Path, process: int) -> None:
    """Remove a folder, unless this process is a fork of its creator."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
