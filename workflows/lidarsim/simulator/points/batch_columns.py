"""Collect the columns of a batch from the returns of its scans."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...columns.part_columns import PartColumns
from .batch_points import BatchPoints
from .device_columns import DevicePoints


def columns_of(batches: Sequence[BatchPoints | DevicePoints]) -> PartColumns:
    """Return the stored columns of a batch, and the count of each hit counter.

    `batches` are the returns of consecutive scans in order, as `Rig.cast` yields them: one item for
    each sensor and station. All items must belong to the same survey.
    """
    columns = {
        column.name: _joined([returns.column(column) for returns in batches])
        for column in batches[0].survey.stored_columns
    }
    counters, hits = batches[0].tally  # nonzero counters, and their hits
    if len(batches) > 1:
        all_counters, all_hits = map(
            np.concatenate, zip(*(returns.tally for returns in batches), strict=True)
        )
        counters, row = np.unique(all_counters, return_inverse=True)
        hits = np.zeros(len(counters), np.int64)
        np.add.at(hits, row, all_hits)
    return PartColumns(
        batches[0].specs[0].scan,
        _joined([returns.counts for returns in batches]),
        columns,
        counters.astype(np.int32),
        hits,
        actor_rays=_joined([returns.actor_rays for returns in batches]),
    )


def _joined(arrays: list[NDArray]) -> NDArray:  # type: ignore[type-arg]
    """Concatenate arrays. A single array is copied only if it is not contiguous."""
    return np.ascontiguousarray(arrays[0]) if len(arrays) == 1 else np.concatenate(arrays)
