"""Statistics of a cloud whose points are counted all at once."""

from __future__ import annotations

import numpy as np

from lidarfiles.parts.parts import StoredCloud
from lidarpool.report.cloud_counts import CloudCounts
from lidarsim import Cloud
from lidarsim.columns.cloud import CloudLike


def counts_of(cloud: CloudLike, objects: int, materials: int = 0) -> CloudCounts:
    """Return the statistics of points of parts, or of a cloud in memory, whose cells are 1 mm."""
    origin = np.zeros(3)
    precision_m = 0.001
    if isinstance(cloud, StoredCloud):
        origin = cloud.origin
        precision_m = cloud.precision_m
    counts = CloudCounts(cloud.table, objects, materials, precision_m, origin)
    if not len(cloud):
        return counts
    points = Cloud.concatenate(list(cloud.chunks()))
    counts.add_points(points.columns)
    cells = np.rint((points.positions - origin) / precision_m).astype(np.int32)
    counts.widen(np.stack([cells.min(axis=0), cells.max(axis=0)]).astype(np.int64))
    counts.add_positions(list(cells.T))
    return counts
