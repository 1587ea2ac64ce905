"""Groups of rows of Parquet: the memory that they take is known before they are read.

A column of equal values takes some bytes for any number of rows, so a small file unpacks to any
size.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from lidarsim.base.allowance import Allowance

_ADVICE = "write fewer points, or smaller row groups"


def number_columns(schema: Any) -> list[str]:
    """Return the names of the columns of numbers and times, whose values have a fixed size."""
    import pyarrow as pa

    return [field.name for field in schema if pa.types.is_primitive(field.type)]


def check_groups(groups: Iterable[Any], columns: Sequence[str], size: int) -> None:
    """Check the size of groups of rows that are read one after the other.

    Parameters
    ----------
    groups
        Fragments of a data set of pyarrow, of a group of rows each.
    columns
        Names of the columns that will be read.
    size
        Size of the files, bytes.

    Raises
    ------
    LidarError
        If the rows take far more memory than the files have bytes.
    """
    Allowance(size, _ADVICE, in_parts=True).take(sum(_bytes_of(g, columns) for g in groups))


def group_allowance(size: int) -> Allowance:
    """Return the allowance of groups of rows that are in memory together.

    `size` is in bytes.
    """
    return Allowance(size, _ADVICE)


def read_group(group: Any, columns: Sequence[str], allowance: Allowance) -> Any:
    """Read columns of a group of rows.

    Raises LidarError above the allowance.
    """
    allowance.take(_bytes_of(group, columns))
    # Further threads would be many beside the workers that load data.
    return group.to_table(columns=list(columns), use_threads=False)


def _bytes_of(group: Any, columns: Sequence[str]) -> int:
    """Return the memory of columns of a group of rows, as its file states it."""
    (info,) = group.row_groups
    schema = group.physical_schema
    bits = sum(max(8, schema.field(column).type.bit_width) for column in columns)
    return max(info.num_rows * bits // 8, info.total_byte_size)
