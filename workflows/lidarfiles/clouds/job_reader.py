"""Access to the files of a data set job, for formats that read individual sweeps."""

from __future__ import annotations

import io
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lidarsim.columns.cloud import Cloud
from lidarsim.io.storage import Storage
from lidarsim.numerics.arrays import AnyArray, Floats32
from lidarsim.sweeps.sweeps import Sweeps

# Points in the sensor frame in meters, with shape (n, 3), and the columns that the format stores,
# as {column: array with shape (n,)}.
PointColumns = tuple[Floats32, dict[str, AnyArray]]

T = TypeVar("T")


@dataclass(frozen=True)
class Entry:
    """A job in a data set, whose number and name identify its files."""

    number: int
    name: str
    split: str = ""
    values: Mapping[str, Any] = field(default_factory=dict)  # varied values by name


class JobReader:
    """Reader for the files of a data set job.

    The files can be read in any order, but only from one thread.
    """

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
        self.layout = layout  # point layout in mcap
        self.classes = classes  # names of the classes of all jobs
        self.last_file = ""  # the file that `read_rows` has read last, for error messages
        self.opened = ExitStack()  # open files, which `close` closes
        self._cache: dict[str, Any] = {}
        self._copies: Path | None = None

    def get_or_compute(self, key: str, make: Callable[[], T]) -> T:
        """Return the cached value for a key, computing it with `make` on the first call."""
        if key not in self._cache:
            self._cache[key] = make()
        value: T = self._cache[key]
        return value

    def prefetch(self, names: Sequence[str]) -> None:
        """Ask the operating system to load files into its page cache.

        If one of the files is already cached, the others are assumed to be cached, too.
        """
        # Reading will raise any OSError. Only Linux has all of these functions.
        with suppress(OSError, AttributeError):
            for name in names:
                with io.FileIO(self.storage.path(name)) as file:
                    try:
                        os.preadv(file.fileno(), [bytearray(1)], 0, os.RWF_NOWAIT)
                        return
                    except OSError:
                        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_WILLNEED)

    def close(self) -> None:
        """Close open files and remove local copies."""
        self.opened.close()
        if self._copies is not None:
            _remove(self._copies, os.getpid())

    def local(self, name: str) -> Path:
        """Return the local path of a file.

        If the storage is remote, this is a copy that exists until `close` is called.
        """
        if self.storage.is_local:
            return Path(self.storage.path(name))
        if self._copies is None:
            self._copies = Path(tempfile.mkdtemp(prefix="lidarpool-"))
            weakref.finalize(self, _remove, self._copies, os.getpid())
        path = self._copies / Path(name).name
        self.storage.get(name, path)
        return path

    def read_rows(self, name: str, row: np.dtype[Any], count: int | None = None) -> AnyArray:
        """Read a file that consists of rows into a writable array.

        Raises ValueError if the last row is incomplete, or if the number of rows is not `count`.
        """
        points_file = self.last_file
        self.last_file = name
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
        """Return the points of a cloud in the sensor frame, with all of their columns."""
        positions = self.sweeps.in_sensor(sweep, cloud.positions).astype(np.float32)
        columns = self.sweeps.columns_in_sensor(sweep, cloud)
        return positions, {name: np.array(array) for name, array in columns.items()}


def _remove(folder: Path, process: int) -> None:
    """Remove a folder, unless this process is a fork of the process that created it."""
    if os.getpid() == process:
        shutil.rmtree(folder, ignore_errors=True)
