"""Parquet, a folder of files, through pyarrow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from ..columns.cloud import Cloud, CloudLike
from ..columns.table import AXES
from .sweeps import Sweeps
from .threads import write_each


def write_parquet(path: Path, cloud: CloudLike, sweeps: Sweeps) -> None:
    """Write all columns of a cloud; units and meanings are in the metadata of the fields."""
    fields = [
        pa.field(
            c.in_files, pa.from_numpy_dtype(kind), metadata={"unit": c.unit, "meaning": c.meaning}
        )
        for c, kind in (
            *((axis, np.dtype(np.float64)) for axis in AXES),
            *((column, np.dtype(column.dtype)) for column in cloud.table),
        )
    ]
    schema = pa.schema(fields, {"coordinates": sweeps.coordinates, "objects": _list(sweeps)})
    path.mkdir()

    def write(number: int, chunk: Cloud) -> None:
        arrays = [*chunk.positions.T.astype(np.float64), *(chunk[c.name] for c in cloud.table)]
        table = pa.Table.from_arrays(
            [pa.array(np.ascontiguousarray(a)) for a in arrays], schema=schema
        )
        pq.write_table(table, path / f"part-{number:05}.parquet")

    if not write_each(write, cloud.chunks()):
        pq.write_table(schema.empty_table(), path / "part-00000.parquet")


def _list(sweeps: Sweeps) -> str:
    """Names that the column `object` counts."""
    return "\n".join((*sweeps.objects, *sweeps.actors))
