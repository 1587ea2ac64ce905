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
    """Counts of a cloud.

    Parameters
    ----------
    by_object, by_channel
        int64 (objects,), (channels,): points of each object, and of each beam of the sensor.
    limits
        {column: lowest and highest value}; empty where there are no points.
    by_range, edges
        int64 (b,) points by distance from the sensor, and float64 (b + 1,) where the bins end,
        in metres; both empty where there are no points. Of large clouds a part is looked at.
    nearest, median, farthest
        Distances in metres; the median to the nearest thousandth or so of the farthest.
    bounds
        float64 (2, 3): lowest and highest coordinates, metres, in the world.
    """

    by_object: NDArray[np.int64]
    by_channel: NDArray[np.int64]
    limits: Mapping[str, tuple[float, float]]
    by_range: NDArray[np.int64]
    edges: NDArray[np.float64]
    nearest: float
    median: float
    farthest: float
    bounds: NDArray[np.float64]


class CountedCloud:
    """A cloud that is counted while somebody else reads it: what it takes is one pass.

    Parameters
    ----------
    cloud
        The points, in world coordinates.
    survey
        Where each scan was made from.
    origin
        World position of the survey's coordinates, (3,), metres.
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
        path = survey.path
        stations = np.array([path.pose(station).position for station in range(path.stations)])
        self._stations = stations + origin
        self._fine = _fine_step(self._stations, self.bounds)

    def __len__(self) -> int:
        return len(self._cloud)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest coordinates, (2, 3), metres."""
        return np.asarray(self._cloud.bounds, dtype=np.float64)

    @property
    def table(self) -> tuple[Column, ...]:
        """The columns beside the positions."""
        return self._cloud.table

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
        empty = np.zeros(0)
        by_range, edges, median = empty.astype(np.int64), empty, 0.0
        if self._counts.any():
            middle = self._counts.sum() / 2
            median = self._fine * (np.searchsorted(np.cumsum(self._counts), middle) + 0.5)
            by_range, edges = _coarse(self._counts, self._fine, self._nearest, self._farthest)
        return CloudNumbers(
            self._by_object,
            self._by_channel,
            self._limits,
            by_range * self._every,
            edges,
            self._nearest if by_range.size else 0.0,
            float(median),
            self._farthest,
            self.bounds,
        )


def _fine_step(stands: NDArray[np.float64], bounds: NDArray[np.float64]) -> float:
    """Return a power of ten, metres, that divides whatever ranges there may be finely."""
    reach = np.maximum(np.abs(stands - bounds[0]), np.abs(stands - bounds[1]))
    most = float(np.linalg.norm(reach, axis=1).max())
    return float(10.0 ** np.floor(np.log10(max(most, 1e-3) / _FINE)))


def _coarse(
    counts: NDArray[np.int64], fine: float, nearest: float, farthest: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Sum fine bins up to about `BARS` wide ones from nearest to farthest."""
    wide = max(1, round(nice_step((farthest - nearest) / BARS) / fine)) if farthest > nearest else 1
    filled = np.flatnonzero(counts)
    first, stop = filled[0] // wide, filled[-1] // wide + 1
    if first <= (stop - first) // 3:
        first = 0  # from the sensor on, where that wastes little
    starts = np.arange(first, stop) * wide
    return np.add.reduceat(counts, starts), np.arange(first, stop + 1) * (wide * fine)
