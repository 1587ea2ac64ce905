"""Read Parquet row groups after checking how much memory they require.

A column of equal values takes a few bytes in a file, regardless of the number of rows. A small file
can therefore decompress to any size.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from lidarsim.io.allowance import Allowance

_ADVICE = "write fewer points, or smaller row groups"


def number_columns(schema: Any) -> list[str]:
    """Return the names of the numeric and time columns, whose values have a fixed size."""
    import pyarrow as pa

    return [field.name for field in schema if pa.types.is_primitive(field.type)]


def check_groups(groups: Iterable[Any], columns: Sequence[str], size: int) -> None:
    """Check the total size of row groups that are read one at a time.

    Parameters
    ----------
    groups
        Fragments of a pyarrow data set, each with a single row group.
    columns
        Names of the columns to read.
    size
        Size of the files in bytes.

    Raises
    ------
    LidarError
        If the rows require far more memory than the size of the files suggests.
    """
    Allowance(size, _ADVICE, in_parts=True).reserve(sum(_bytes_of(g, columns) for g in groups))


def group_allowance(size: int) -> Allowance:
    """Return the memory allowance for row groups that are held in memory together.

    `size` is the size of their files in bytes.
    """
    return Allowance(size, _ADVICE)


def read_group(group: Any, columns: Sequence[str], allowance: Allowance) -> Any:
    """Read columns of a row group, or raise LidarError if they exceed the allowance."""
    allowance.reserve(_bytes_of(group, columns))
    # Data loaders already use several worker processes, so more threads would not help.
    return group.to_table(columns=list(columns), use_threads=False)


def _bytes_of(group: Any, columns: Sequence[str]) -> int:
    """Return the memory that columns of a row group require, according to the file metadata."""
    (info,) = group.row_groups
    schema = group.physical_schema
    bits = sum(max(8, schema.field(column).type.bit_width) for column in columns)
    return max(info.num_rows * bits // 8, info.total_byte_size)
