"""Compiled loop that computes the scan number of each row in a block."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from raybeam.compiled import compiled, noinline


@noinline
def _fill(values, value):
    for k in range(len(values)):
        values[k] = value


@compiled()
def write_scans(row_ends, first_scan, first_row, scan_of_row):
    """Write the scan number of each row in a block to `scan_of_row`.

    The block starts at row `first_row` of its part. `row_ends` contains, for each scan of the part
    starting with `first_scan`, the number of rows up to and including that scan. Shape (scans,).
    `scan_of_row` is an int32 array with shape (n,).
    """
    start = 0
    for k in range(len(row_ends)):
        stop = min(row_ends[k] - first_row, len(scan_of_row))
        if stop > start:
            _fill(scan_of_row[start:stop], first_scan + k)
            start = stop
