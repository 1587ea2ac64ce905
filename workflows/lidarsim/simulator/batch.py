"""The columns of a batch: those of the returns of its scans, one station after the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..columns.part_columns import PartColumns
from .device import DevicePoints
from .points import BatchPoints


def columns_of(found: Sequence[BatchPoints | DevicePoints]) -> PartColumns:
    """Make the columns of consecutive scans, and count the hits of each triangle."""
    columns = {
        column.name: _joined([returns.column(column) for returns in found])
        for column in found[0].survey.stored_columns
    }
    triangles, hits = found[0].tally
    if len(found) > 1:
        every, counts = map(np.concatenate, zip(*(returns.tally for returns in found), strict=True))
        triangles, row = np.unique(every, return_inverse=True)
        hits = np.zeros(len(triangles), np.int64)
        np.add.at(hits, row, counts)
    return PartColumns(
        found[0].specs[0].scan,
        _joined([returns.counts for returns in found]),
        columns,
        triangles.astype(np.int32),
        hits,
    )


def _joined(arrays: list[NDArray]) -> NDArray:  # type: ignore[type-arg]
    return np.ascontiguousarray(arrays[0]) if len(arrays) == 1 else np.concatenate(arrays)
