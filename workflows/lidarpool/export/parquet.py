"""Parquet, a folder of files, through pyarrow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from ..columns.table import AXES, Column
from . import pieces
from .pieces import Entry
from .sweeps import Sweeps

_GROUP_ROWS = 65_536


class Pieces(pieces.Pieces):
    """A file for each million points; units and meanings are in the metadata of the fields.

    In a data set it is a partition, `points/job=7`, in groups of rows of which readers of single
    sweeps read one or two.
    """

    def __init__(self, cloud: CloudLike, sweeps: Sweeps, entry: Entry | None = None) -> None:
        super().__init__(cloud, sweeps, entry)
        self.folders = [] if entry is None else [f"points/job={entry.number}"]
        fields = [
            pa.field(c.in_files, pa.from_numpy_dtype(kind), True, _words(c))
            for c, kind in (
                *((axis, np.dtype(np.float64)) for axis in AXES),
                *((column, np.dtype(column.dtype)) for column in cloud.table),
            )
        ]
        words = {"coordinates": sweeps.coordinates, "objects": _list(sweeps)}
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


def _words(column: Column) -> dict[str, str]:
    return {"unit": column.unit, "meaning": column.meaning}


def _list(sweeps: Sweeps) -> str:
    """Names that the column `object` counts."""
    return "\n".join((*sweeps.objects, *sweeps.actors))
