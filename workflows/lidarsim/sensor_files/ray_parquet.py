"""Rays as a table of Parquet, with the header in the metadata of its schema."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ..base.errors import message_of
from ..base.input_files import open_input
from .complete_files import write_bytes_of
from .fired_rays import FiredRays
from .ray_header import COLUMNS, check_names, columns_of, header_of, rays_of

_HEADER = b"lidarpool"


def write(path: Path, rays: FiredRays, left_out: Sequence[str]) -> Sequence[str]:
    """Write rays as a table.

    The metadata of the schema have the header as JSON.
    """
    table = pa.table(columns_of(rays)).replace_schema_metadata(
        {_HEADER: json.dumps(header_of(rays, left_out)).encode()}
    )
    with write_bytes_of(path) as file:
        pq.write_table(table, file)
    return left_out


def read(path: Path) -> FiredRays | None:
    """Return the rays of a table.

    Raises
    ------
    ValueError
        If the file is not of Parquet, or a column cannot be used.
    """
    try:
        with open_input(path) as file:
            table = pq.read_table(file)
    except pa.ArrowException as error:
        raise ValueError(f"it is not a table of Parquet: {message_of(error)}") from error
    header = json.loads((table.schema.metadata or {}).get(_HEADER, b"{}"))
    check_names("columns", table.column_names, COLUMNS)
    return rays_of({name: table[name].to_numpy() for name in table.column_names}, header)
