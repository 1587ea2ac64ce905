"""Parse rows of comma-separated numbers."""

from __future__ import annotations

import io

import numpy as np

from ..numerics.arrays import Floats


def parse_rows(text: str, skip: int, columns: int) -> Floats:
    """Parse the lines after a header as rows of numbers.

    `skip` is the number of header lines.

    Raises
    ------
    ValueError
        If there are no such lines, or if a number is not finite. The message names the line.
    """
    if not any(line.strip() for line in text.splitlines()[skip:]):
        raise ValueError(f"it has no lines of {columns} numbers")
    rows = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=skip, ndmin=2)
    if rows.shape[1] != columns:
        raise ValueError(f"its lines must have {columns} numbers")
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(bad):
        raise ValueError(f"line {bad[0] + skip + 1} contains NaN or infinity")
    return rows
