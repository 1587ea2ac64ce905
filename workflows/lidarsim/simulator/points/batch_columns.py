"""Columns of a batch, from the returns of its scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...columns.part_columns import PartColumns
from .batch_points import BatchPoints
from .device_columns import DevicePoints


def columns_of(batches: Sequence[BatchPoints | DevicePoints]) -> PartColumns:
    """Return the stored columns of a batch, with the number of hits of each triangle.

    `batches` are the returns of consecutive scans in order, as `Rig.cast` yields them: separate for
    each sensor and station. All are of the same survey.
    """
    columns = {
        column.name: _joined([returns.column(column) for returns in batches])
        for column in batches[0].survey.stored_columns
    }
    triangles, hit_counts = batches[0].tally  # counters that are not 0, and their hits
    if len(batches) > 1:
        all_triangles, counts = map(
            np.concatenate, zip(*(returns.tally for returns in batches), strict=True)
        )
        triangles, row = np.unique(all_triangles, return_inverse=True)
        hit_counts = np.zeros(len(triangles), np.int64)
        np.add.at(hit_counts, row, counts)
    return PartColumns(
        batches[0].specs[0].scan,
        _joined([returns.counts for returns in batches]),
        columns,
        triangles.astype(np.int32),
        hit_counts,
    )


def _joined(arrays: list[NDArray]) -> NDArray:  # type: ignore[type-arg]
    """Concatenate arrays, or return a single contiguous array as is."""
    return np.ascontiguousarray(arrays[0]) if len(arrays) == 1 else np.concatenate(arrays)
