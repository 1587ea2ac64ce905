"""Parquet, a folder of files, through pyarrow."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import islice
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from ..columns.table import AXES, TABLE
from . import pieces, reading
from .pieces import Entry
from .sweeps import Sweeps

_GROUP_ROWS = 65_536
_GROUPS_HELD = 2  # of each open job


class Pieces(pieces.Pieces):
    """A file for each million points; units and meanings are in the metadata of the fields.

    In a data set it is a partition, `points/job=7`, in groups of rows of which readers of single
    sweeps read one or two.
    """

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        super().__init__(cloud, sweeps, entry)
        self.folders = [] if entry is None else [entry.place("parquet")]
        fields = [
            pa.field(
                c.in_files, pa.from_numpy_dtype(kind), True, {"unit": c.unit, "meaning": c.meaning}
            )
            for c, kind in (
                *((axis, np.dtype(np.float64)) for axis in AXES),
                *((column, np.dtype(column.dtype)) for column in cloud.table),
            )
        ]
        objects = "\n".join((*sweeps.objects, *sweeps.actors))  # that the column `object` counts
        words = {"coordinates": sweeps.coordinates, "objects": objects}
        words |= {"classes": json.dumps(dict(sweeps.classes))} if sweeps.classes else {}
        self.schema = pa.schema(fields, words)

    def __len__(self) -> int:
        return -(-len(self.cloud) // CHUNK_POINTS)

    def read(self, first: int, stop: int) -> Iterator[Cloud]:
        """Yield so many million points."""
        return islice(self.cloud.chunks(CHUNK_POINTS, first * CHUNK_POINTS), stop - first)

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return a file."""
        table = self.cloud.table
        arrays = [*points.positions.T.astype(np.float64), *(points[c.name] for c in table)]
        filled = [pa.array(np.ascontiguousarray(array)) for array in arrays]
        return self._file(number, pa.Table.from_arrays(filled, schema=self.schema)), None

    def others(self, made: Sequence[None]) -> dict[str, bytes]:
        """Return a file without rows if there is no other."""
        return {} if made else self._file(0, self.schema.empty_table())

    def _file(self, number: int, table: pa.Table) -> dict[str, bytes]:
        memory = pa.BufferOutputStream()
        pq.write_table(table, memory, row_group_size=_GROUP_ROWS if self.entry else None)
        name = f"part-{number:05}.parquet"
        return {"/".join([*self.folders, name]): memory.getvalue()}


class Reader(reading.Reader):
    """Reads sweeps of a data set: all columns of each point, by their names in clouds."""

    _held: Mapping[tuple[int, int], Any] = MappingProxyType({})  # {(file, group): rows}

    def file(self, sweep: int) -> str:
        """Return the name of the job's partition."""
        return self.entry.place("parquet")

    @cached_property
    def _groups(self) -> list[tuple[int, int, int, int]]:
        """First and last scan of each group of rows, its file, and its number there."""
        groups = []
        for number, file in enumerate(self._files):
            column = file.schema_arrow.get_field_index("scan")
            for group in range(file.metadata.num_row_groups):
                scans = file.metadata.row_group(group).column(column).statistics
                if scans is not None and scans.has_min_max:
                    groups.append((scans.min, scans.max, number, group))
        return groups

    @cached_property
    def _files(self) -> list[pq.ParquetFile]:
        folder = self.place.below(self.file(0))
        names = sorted(name for name in folder.sizes() if name.endswith(".parquet"))
        if not names:
            raise FileNotFoundError(2, "it has no file")
        if folder.is_local:
            return [pq.ParquetFile(folder.local(name)) for name in names]
        system, path = folder.file_system()
        return [pq.ParquetFile(f"{path}/{name}", filesystem=system) for name in names]

    def _read(self, file: int, group: int) -> Any:
        """Read a group of rows; neighbouring sweeps share some."""
        if (file, group) not in self._held:
            # Threads of its own would be many beside those of the workers that load data.
            rows = self._files[file].read_row_group(group, use_threads=False)
            self._held = dict([*self._held.items()][1 - _GROUPS_HELD :]) | {(file, group): rows}
        return self._held[file, group]

    def read(self, sweep: int) -> reading.PointColumns:
        """Return the points of a sweep, of which only groups of rows with its scans are read."""
        first, stop = self.sweeps.scans[sweep : sweep + 2].tolist()
        there = [where for low, high, *where in self._groups if low < stop and high >= first]
        tables = [self._read(*where) for where in there] or [
            self._files[0].schema_arrow.empty_table()
        ]
        rows = pa.concat_tables(tables)
        begin, end = np.searchsorted(rows["scan"].to_numpy(), (first, stop))
        rows = rows.slice(begin, end - begin)
        names = {column.in_files: column.name for column in TABLE.values()}
        columns = {names.get(name, name): rows[name].to_numpy() for name in rows.column_names}
        positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
        return self.inside(sweep, Cloud(positions, columns))

    def close(self) -> None:
        """Close the files."""
        for file in self.__dict__.get("_files", ()):
            file.close()
        super().close()
