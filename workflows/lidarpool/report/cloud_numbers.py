"""Statistics of a cloud, computed in one pass."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from ..columns.table import Column


class CountedCloud:
    """A cloud that computes its statistics while its points are read for something else.

    Parameters
    ----------
    cloud
        The points, in world coordinates.
    objects
        How many objects there are.

    Attributes
    ----------
    by_object : int64 (objects,)
        Points of each.
    limits : dict
        {column: minimum and maximum}; empty without points.
    bounds : float64 (2, 3)
        Lowest and highest coordinates in the world.
    """

    def __init__(self, cloud: CloudLike, objects: int) -> None:
        self._cloud = cloud
        self.by_object = np.zeros(objects, np.int64)
        self.limits: dict[str, tuple[float, float]] = {}
        self.bounds: NDArray[np.float64] = np.asarray(cloud.bounds, dtype=np.float64)
        self.table: tuple[Column, ...] = cloud.table
        self.row_of = cloud.row_of

    def __len__(self) -> int:
        return len(self._cloud)

    def chunks(self, points: int = CHUNK_POINTS, first: int = 0) -> Iterator[Cloud]:
        """Yield the points in order, and update the statistics."""
        for chunk in self._cloud.chunks(points, first):
            self.by_object += np.bincount(chunk["object"], minlength=len(self.by_object))
            for name, values in chunk.columns.items():
                low, high = self.limits.get(name, (np.inf, -np.inf))
                self.limits[name] = min(low, values.min().item()), max(high, values.max().item())
            yield chunk
