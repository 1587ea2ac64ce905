"""Rays as a Parquet table (.parquet), with the header in the schema metadata."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ..errors import message_of
from ..io.allowance import Allowance
from ..io.input_files import check_input, open_input
from .complete_files import open_complete
from .fired_rays import RayList
from .ray_header import (
    COLUMNS,
    check_names,
    columns_of,
    header_of,
    not_numbers,
    parsed_header,
    rays_of,
)

_HEADER = b"lidarpool"
_NUMBERS = (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write rays to a Parquet table.

    The header is stored as JSON in the schema metadata.
    """
    table = pa.table(columns_of(rays)).replace_schema_metadata(
        {_HEADER: json.dumps(header_of(rays, left_out)).encode()}
    )
    with open_complete(path) as file:
        pq.write_table(table, file)
    return left_out


def read(path: Path) -> RayList | None:
    """Read rays from a Parquet table.

    Raises
    ------
    ValueError
        If the file is not a Parquet file, or if a column is invalid.
    LidarError
        If the rays exceed the memory limit.
    """
    try:
        allowance = Allowance(check_input(path), "write it again with fewer rays")
        with open_input(path) as file, pq.ParquetFile(file) as content:
            schema = content.schema_arrow
            check_names("columns", schema.names, COLUMNS)
            for field in schema:
                if not any(is_kind(field.type) for is_kind in _NUMBERS):
                    raise not_numbers(field.name, field.type)
            allowance.reserve(_bytes_of(content.metadata))
            table = content.read()
    except pa.ArrowException as error:
        raise ValueError(f"it is not a Parquet file: {message_of(error)}") from error
    header = parsed_header((schema.metadata or {}).get(_HEADER, b"{}"))
    return rays_of({name: table[name].to_numpy() for name in table.column_names}, header)


def _bytes_of(metadata: pq.FileMetaData) -> int:
    """Return the memory in bytes that the columns of a table require.

    This is 8 bytes per number, or the size of the pages if that is larger. The pages alone do not
    suffice, because a column of equal values occupies only a few bytes.
    """
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    rows = max(metadata.num_rows, sum(group.num_rows for group in groups))
    return max(8 * rows * metadata.num_columns, sum(group.total_byte_size for group in groups))
