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
import pyarrow.dataset
import pyarrow.parquet as pq

from lidarsim.base.allowance import Allowance
from lidarsim.base.extras import reading
from lidarsim.base.input_files import input_size
from lidarsim.columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import AXES, TABLE
from lidarsim.sweeps.sweeps import Sweeps

from . import pieces, sweep_reader
from .parquet_groups import check_groups, group_allowance, number_columns, read_group
from .pieces import Entry
from .recording import Recording, RecordingSource, sweep_from_columns

_GROUP_ROWS = 65_536


class Pieces(pieces.Pieces):
    """A file for each million points, with units and meanings in the metadata of the fields.

    In a data set it is a partition, `points/job=7`, in groups of rows; readers of single sweeps
    read one or two groups.
    """

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        super().__init__(cloud, sweeps, entry)
        self.folders = [] if entry is None else [entry.path_of("parquet")]
        fields = [
            pa.field(
                c.in_files, pa.from_numpy_dtype(kind), True, {"unit": c.unit, "meaning": c.meaning}
            )
            for c, kind in (
                *((axis, np.dtype(np.float64)) for axis in AXES),
                *((column, np.dtype(column.dtype)) for column in cloud.table),
            )
        ]
        objects = "\n".join(sweeps.object_names)  # names that the column `object` counts
        words = {"coordinates": sweeps.coordinates, "objects": objects}
        words |= {} if sweeps.epsg is None else {"crs": f"EPSG:{sweeps.epsg}"}
        words |= {"classes": json.dumps(dict(sweeps.classes))} if sweeps.classes else {}
        if any(column.name == "material" for column in cloud.table):
            words |= {"materials": json.dumps(sweeps.materials)}
        self.schema = pa.schema(fields, words)

    def __len__(self) -> int:
        return -(-len(self.cloud) // CHUNK_POINTS)

    def read(self, first: int, stop: int) -> Iterator[Cloud]:
        """Yield the points of pieces, a million each."""
        return islice(self.cloud.chunks(CHUNK_POINTS, first * CHUNK_POINTS), stop - first)

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return the file of a piece."""
        table = self.cloud.table
        arrays = [*points.positions.T.astype(np.float64), *(points[c.name] for c in table)]
        filled = [pa.array(np.ascontiguousarray(array)) for array in arrays]
        return self._file(number, pa.Table.from_arrays(filled, schema=self.schema)), None

    def shared_files(self, pieces: Sequence[None]) -> dict[str, bytes]:
        """Return a file without rows for a data set without pieces."""
        return {} if pieces else self._file(0, self.schema.empty_table())

    def _file(self, number: int, table: pa.Table) -> dict[str, bytes]:
        memory = pa.BufferOutputStream()
        pq.write_table(table, memory, row_group_size=_GROUP_ROWS if self.entry else None)
        name = f"part-{number:05}.parquet"
        return {"/".join([*self.folders, name]): memory.getvalue()}


class Reader(sweep_reader.Reader):
    """Reads sweeps of a data set: all columns of each point, by their names in clouds."""

    _held: Mapping[tuple[str, int], Any] = MappingProxyType({})  # {(file, group): rows}

    def files(self, sweep: int) -> list[str]:
        """Return the name of the job's partition."""
        return [self.entry.path_of("parquet")]

    @cached_property
    def _table(self) -> Any:
        if self.storage.is_local:
            return pyarrow.dataset.dataset(self.storage.path(self.files(0)[0]), format="parquet")
        system, folder = self.storage.file_system()
        return pyarrow.dataset.dataset(
            f"{folder}/{self.files(0)[0]}", format="parquet", filesystem=system
        )

    @cached_property
    def _size(self) -> int:
        """Size of the files of the partition, bytes."""
        table = self._table
        return sum(info.size for info in table.filesystem.get_file_info(table.files))

    def _group(self, fragment: Any, allowance: Allowance) -> pa.Table:
        """Read a group of rows, cached because neighboring sweeps share groups."""
        key = fragment.path, fragment.row_groups[0].id
        if key not in self._held:
            rows = read_group(fragment, number_columns(fragment.physical_schema), allowance)
            self._held = dict([*self._held.items()][-1:]) | {key: rows}
        return self._held[key]

    def read(self, sweep: int) -> sweep_reader.PointColumns:
        """Return the points of a sweep, read from the groups of rows with its scans."""
        first, stop = self.sweeps.scans[sweep : sweep + 2].tolist()
        scan = pyarrow.dataset.field("scan")
        in_range = (scan >= first) & (scan < stop)
        files = self._table.get_fragments(in_range)
        allowance = group_allowance(self._size)
        groups = [
            self._group(group, allowance)
            for file in files
            for group in file.split_by_row_group(in_range)
        ]
        rows = pa.concat_tables(groups or [self._table.schema.empty_table()])
        begin, end = np.searchsorted(rows["scan"].to_numpy(), (first, stop))
        rows = rows.slice(begin, end - begin)
        names = {column.in_files: column.name for column in TABLE.values()}
        columns = {names.get(name, name): rows[name].to_numpy() for name in rows.column_names}
        positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
        return self.inside(sweep, Cloud(positions, columns))


def open_file(source: RecordingSource) -> Recording:
    """Open a .parquet file in its groups of rows."""
    with reading(source.name):
        return _parts(source)


def open_folder(source: RecordingSource) -> Recording:
    """Open a folder of .parquet files in their groups of rows."""
    return open_file(source)


def _parts(source: RecordingSource) -> Recording:
    """Open the parts of a file or folder.

    Only columns of numbers are read: the memory of others is not known before.
    """
    path = source.path
    if path.is_file():
        input_size(path)
    dataset = pa.dataset.dataset(str(path), format="parquet")
    groups = []
    files = []  # names of columns of numbers, and size in bytes, for each group
    unread = set[str]()  # names of columns
    for file in dataset.get_fragments():
        columns = number_columns(file.physical_schema)
        unread |= set(file.physical_schema.names) - set(columns)
        size = input_size(file.path)
        of_file = file.split_by_row_group()
        check_groups(of_file, columns, size)
        groups += of_file
        files += len(of_file) * [(columns, size)]
    if axes := sorted(unread.intersection("xyz")):
        raise ValueError(f"its coordinate columns are not numeric: {', '.join(axes)}")

    def read(number: int) -> Sweep:
        number_names, size = files[number]
        rows = read_group(groups[number], number_names, group_allowance(size))
        return sweep_from_columns({name: rows[name].to_numpy() for name in rows.column_names})

    notes = []
    if unread:
        notes.append(f"has non-numeric columns, which were skipped: {', '.join(sorted(unread))}")
    return source.recording(
        len(groups),
        read,
        is_cloud=True,
        point_count=dataset.count_rows(),
        notes=source.named(notes),
    )
