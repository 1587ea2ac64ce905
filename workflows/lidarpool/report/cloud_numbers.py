"""What the points of a cloud look like together, counted while they are read once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..columns.cloud import CHUNK_POINTS, Cloud, CloudLike
from ..columns.table import Column
from ..render.stage import nice_step
from ..sensor import Survey

BARS = 40  # of a histogram, about
RANGES_MOST = 2_000_000  # points whose distance is worked out
_FINE = 2000  # bins that are counted in, at least; wide ones are sums of them


@dataclass(frozen=True, eq=False)
class CloudNumbers:
    """Counts of a cloud."""

    by_object: NDArray[np.int64]  # (objects,) points of each
    by_channel: NDArray[np.int64]  # (channels,) points of each beam of the sensor
    limits: Mapping[str, tuple[float, float]]  # {column: lowest and highest}; {} without points
    by_range: NDArray[np.int64]  # (b,) points by distance from the sensor; of large clouds a part
    edges: NDArray[np.float64]  # (b + 1,) where these bins end, metres; empty without points
    nearest: float  # metres
    median: float  # to the nearest thousandth or so of the farthest
    farthest: float
    bounds: NDArray[np.float64]  # (2, 3) lowest and highest coordinates in the world


class CountedCloud:
    """A cloud that is counted while somebody else reads it: what it takes is one pass.

    Parameters
    ----------
    cloud
        The points, in world coordinates.
    survey, origin
        Where each scan was made from; `origin`, (3,) metres, is added to its coordinates.
    objects
        How many objects there are.
    """

    def __init__(
        self, cloud: CloudLike, survey: Survey, origin: NDArray[np.float64], objects: int
    ) -> None:
        self._cloud, self._survey, self._origin = cloud, survey, origin
        self._by_object = np.zeros(objects, np.int64)
        self._by_channel = np.zeros(survey.sensor.channels, np.int64)
        self._limits: dict[str, tuple[float, float]] = {}
        self._counts = np.zeros(0, np.int64)  # by range, in fine bins
        self._nearest, self._farthest = np.inf, 0.0
        self._every = -(-max(len(cloud), 1) // RANGES_MOST)
        self.bounds: NDArray[np.float64] = np.asarray(cloud.bounds, dtype=np.float64)
        self.table: tuple[Column, ...] = cloud.table
        path = survey.path
        stations = np.array([path.pose(station).position for station in range(path.stations)])
        self._stations = stations + origin
        # A power of ten, metres, that divides whatever ranges there may be finely.
        reach = np.abs(self._stations[:, None] - self.bounds).max(axis=1)
        most = max(float(np.linalg.norm(reach, axis=1).max()), 1e-3)
        self._fine = float(10.0 ** np.floor(np.log10(most / _FINE)))

    def __len__(self) -> int:
        return len(self._cloud)

    def chunks(self, points: int = CHUNK_POINTS) -> Iterator[Cloud]:
        """Give the points in order, and count them."""
        for chunk in self._cloud.chunks(points):
            self._count(chunk)
            yield chunk

    def _count(self, chunk: Cloud) -> None:
        self._by_object += np.bincount(chunk["object"], minlength=len(self._by_object))
        self._by_channel += np.bincount(chunk["channel"], minlength=len(self._by_channel))
        for name, values in chunk.columns.items():
            low, high = self._limits.get(name, (np.inf, -np.inf))
            self._limits[name] = min(low, values.min().item()), max(high, values.max().item())
        some = slice(None, None, self._every)
        ranges = np.linalg.norm(chunk.positions[some] - self._stands(chunk["scan"][some]), axis=1)
        self._nearest = min(self._nearest, float(ranges.min(initial=np.inf)))
        self._farthest = max(self._farthest, float(ranges.max(initial=0.0)))
        more = np.bincount((ranges / self._fine).astype(np.int64), minlength=len(self._counts))
        more[: len(self._counts)] += self._counts
        self._counts = more

    def _stands(self, scans: NDArray[np.int32]) -> NDArray[np.float64]:
        """Where the sensor was when scans began, (n, 3), world coordinates."""
        if not self._survey.path.moves:
            return self._stations[scans // self._survey.steps]
        different, which = np.unique(scans, return_inverse=True)
        poses = [self._survey.pose(scan).position for scan in different.tolist()]
        return (np.array(poses) + self._origin)[which]

    def numbers(self) -> CloudNumbers:
        """Sum up all points that were read."""
        by_range, edges, median = np.zeros(0, np.int64), np.zeros(0), 0.0
        filled = np.flatnonzero(self._counts)
        if len(filled):
            middle = np.searchsorted(np.cumsum(self._counts), self._counts.sum() / 2)
            median = float(self._fine * (middle + 0.5))
            span = max(self._farthest - self._nearest, self._fine)
            wide = max(1, round(nice_step(span / BARS) / self._fine))
            first, stop = filled[0] // wide, filled[-1] // wide + 1
            if first <= (stop - first) // 3:
                first = 0  # from the sensor on, where that wastes little
            by_range = self._every * np.add.reduceat(self._counts, np.arange(first, stop) * wide)
            edges = np.arange(first, stop + 1) * (wide * self._fine)
        return CloudNumbers(
            self._by_object,
            self._by_channel,
            self._limits,
            by_range,
            edges,
            self._nearest if len(filled) else 0.0,
            median,
            self._farthest,
            self.bounds,
        )
