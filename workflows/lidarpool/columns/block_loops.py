"""The loop that writes the scans of the rows of a block."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from raybeam.compiled import compiled, noinline


@noinline
def _fill(values, value):
    for k in range(len(values)):
        values[k] = value


@compiled()
def write_scans(row_ends, first_scan, first_row, scan_of_row):
    """Write the scans of rows, (n,) int32, the first of which is row `first_row` of the part.

    `row_ends` (scans,) are the numbers of rows up to the end of each scan, from `first_scan` on.
    """
    start = 0
    for k in range(len(row_ends)):
        stop = min(row_ends[k] - first_row, len(scan_of_row))
        if stop > start:
            _fill(scan_of_row[start:stop], first_scan + k)
            start = stop
