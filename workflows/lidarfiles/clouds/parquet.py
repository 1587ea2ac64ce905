"""Read and write clouds as folders of Parquet files with pyarrow."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np

from lidarsim.columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import AXES, TABLE
from lidarsim.environment.extras import reading
from lidarsim.io.allowance import Allowance
from lidarsim.io.input_files import input_size
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import Sweeps

from .job_reader import Entry, JobReader, PointColumns
from .multi_file_format import MultiFileFormat
from .parquet_groups import check_groups, group_allowance, number_columns, read_group
from .recording import PointCloud, sweep_from_columns
from .recording_ref import RecordingRef

_GROUP_ROWS = 65_536


class Parquet(MultiFileFormat):
    """A folder of Parquet files with one million points each.

    The metadata of the fields contains the units and meanings of the columns. In a data set, each
    job is a partition such as `points/job=7`. Its files consist of small row groups, so that only
    one or two row groups must be read to get a single sweep.
    """

    title = "Parquet"
    file_pattern = r"part-\d+\.parquet"
    job_path = "points/job={number}"
    for_scenes = True

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        import pyarrow as pa

        super().__init__(cloud, sweeps, entry)
        self.folders = [] if entry is None else [self.path_of_job(entry)]
        fields = [
            pa.field(
                c.in_files, pa.from_numpy_dtype(kind), True, {"unit": c.unit, "meaning": c.meaning}
            )
            for c, kind in (
                *((axis, np.dtype(np.float64)) for axis in AXES),
                *((column, np.dtype(column.dtype)) for column in cloud.table),
            )
        ]
        objects = "\n".join(sweeps.object_names)  # indexed by the column `object`
        words = {"coordinates": sweeps.coordinates, "objects": objects}
        words |= {} if sweeps.epsg is None else {"crs": f"EPSG:{sweeps.epsg}"}
        words |= {"classes": json.dumps(dict(sweeps.classes))} if sweeps.classes else {}
        if any(column.name == "material" for column in cloud.table):
            words |= {"materials": json.dumps(sweeps.materials)}
        self.schema = pa.schema(fields, words)

    def __len__(self) -> int:
        return -(-len(self.cloud) // CHUNK_POINTS)

    def read(self, first: int, stop: int) -> Iterator[Cloud]:
        """Yield the points of the pieces, each of which has one million points."""
        return islice(self.cloud.chunks(CHUNK_POINTS, first * CHUNK_POINTS), stop - first)

    def files(self, number: int, points: Cloud) -> tuple[dict[str, bytes], None]:
        """Return the file of a piece."""
        import pyarrow as pa

        table = self.cloud.table
        arrays = [*points.positions.T.astype(np.float64), *(points[c.name] for c in table)]
        filled = [pa.array(np.ascontiguousarray(array)) for array in arrays]
        return self._file(number, pa.Table.from_arrays(filled, schema=self.schema)), None

    def shared_files(self, pieces: Sequence[None]) -> dict[str, bytes]:
        """Return an empty file if there are no pieces."""
        return {} if pieces else self._file(0, self.schema.empty_table())

    def _file(self, number: int, table: Any) -> dict[str, bytes]:
        import pyarrow as pa
        import pyarrow.parquet as pq

        memory = pa.BufferOutputStream()
        pq.write_table(table, memory, row_group_size=_GROUP_ROWS if self.entry else None)
        name = f"part-{number:05}.parquet"
        return {"/".join([*self.folders, name]): memory.getvalue()}

    @classmethod
    def read_sweep(cls, job: JobReader, sweep: int) -> PointColumns:
        """Read the points of a sweep in a data set with all columns.

        Only row groups that contain scans of the sweep are read.
        """
        import pyarrow as pa
        import pyarrow.dataset

        table = job.get_or_compute(
            "table", lambda: _dataset(job.storage, cls.path_of_job(job.entry))
        )
        first, stop = job.sweeps.scans[sweep : sweep + 2].tolist()
        scan = pyarrow.dataset.field("scan")
        in_range = (scan >= first) & (scan < stop)
        allowance = group_allowance(job.get_or_compute("size", lambda: _size_of(table)))
        cache = job.get_or_compute("groups", dict[tuple[str, int], Any])
        groups = [
            _group(group, allowance, cache)
            for file in table.get_fragments(in_range)
            for group in file.split_by_row_group(in_range)
        ]
        rows = pa.concat_tables(groups or [table.schema.empty_table()])
        begin, end = np.searchsorted(rows["scan"].to_numpy(), (first, stop))
        rows = rows.slice(begin, end - begin)
        names = {column.in_files: column.name for column in TABLE.values()}
        columns = {names.get(name, name): rows[name].to_numpy() for name in rows.column_names}
        positions = np.stack([columns.pop(axis) for axis in "xyz"], axis=1)
        return job.in_sensor(sweep, Cloud(positions, columns))

    @classmethod
    def open(cls, ref: RecordingRef) -> PointCloud:
        """Open a .parquet file or a folder of such files.

        Row groups are read separately.
        """
        with reading(ref.name):
            return _ParquetCloud(ref)


def _dataset(storage: Storage, folder: str) -> Any:
    import pyarrow.dataset

    if storage.is_local:
        return pyarrow.dataset.dataset(storage.path(folder), format="parquet")
    system, root = storage.file_system()
    return pyarrow.dataset.dataset(f"{root}/{folder}", format="parquet", filesystem=system)


def _size_of(table: Any) -> int:
    return sum(info.size for info in table.filesystem.get_file_info(table.files))


def _group(fragment: Any, allowance: Allowance, cache: dict[tuple[str, int], Any]) -> Any:
    """Read a row group.

    The last two row groups are cached, because neighboring sweeps share row groups.
    """
    key = fragment.path, fragment.row_groups[0].id
    if key not in cache:
        rows = read_group(fragment, number_columns(fragment.physical_schema), allowance)
        for oldest in [*cache][:-1]:
            del cache[oldest]
        cache[key] = rows
    return cache[key]


class _ParquetCloud(PointCloud):
    """The row groups of a file or folder.

    Only numeric columns are read, because the memory that other columns require is not known in
    advance.
    """

    def __init__(self, ref: RecordingRef) -> None:
        import pyarrow.dataset

        path = ref.path
        if path.is_file():
            input_size(path)
        dataset = pyarrow.dataset.dataset(str(path), format="parquet")
        self._groups: list[Any] = []
        # Numeric columns and file size in bytes, for each row group.
        self._files: list[tuple[list[str], int]] = []
        unread = set[str]()  # names of skipped columns
        for file in dataset.get_fragments():
            columns = number_columns(file.physical_schema)
            unread |= set(file.physical_schema.names) - set(columns)
            size = input_size(file.path)
            of_file = file.split_by_row_group()
            check_groups(of_file, columns, size)
            self._groups += of_file
            self._files += len(of_file) * [(columns, size)]
        if axes := sorted(unread.intersection("xyz")):
            raise ValueError(f"its coordinate columns are not numeric: {', '.join(axes)}")
        notes = []
        if unread:
            names = ", ".join(sorted(unread))
            notes.append(f"has non-numeric columns, which were skipped: {names}")
        super().__init__(ref.info(point_count=dataset.count_rows(), notes=ref.prefix_notes(notes)))

    def __len__(self) -> int:
        return len(self._groups)

    def load(self, number: int) -> Sweep:
        names, size = self._files[number]
        rows = read_group(self._groups[number], names, group_allowance(size))
        return sweep_from_columns({name: rows[name].to_numpy() for name in rows.column_names})
