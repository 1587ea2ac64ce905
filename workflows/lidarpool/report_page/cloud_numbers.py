"""What the points of a cloud look like together, counted while they are read once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cloud import CloudLike
from ..survey import Survey
from ..view.stage import nice_step

BARS = 40  # of a histogram, about
_FINE = 2000  # bins that are counted in, at least; wide ones are sums of them


@dataclass(frozen=True, eq=False)
class CloudNumbers:
    """Counts of a cloud.

    Parameters
    ----------
    by_ring
        int64 (layers,): points of each layer of the sensor.
    by_range, edges
        int64 (b,) points by distance from the sensor, and float64 (b + 1,) where the bins end,
        in metres; both empty where there are no points.
    nearest, median, farthest
        Distances in metres; the median to the nearest thousandth or so of the farthest.
    bounds
        float64 (2, 3): lowest and highest coordinates, metres, in the world.
    """

    by_ring: NDArray[np.int64]
    by_range: NDArray[np.int64]
    edges: NDArray[np.float64]
    nearest: float
    median: float
    farthest: float
    bounds: NDArray[np.float64]


def count_cloud(cloud: CloudLike, survey: Survey, origin: NDArray[np.float64]) -> CloudNumbers:
    """Read a cloud once, a part at a time, and count.

    Parameters
    ----------
    cloud
        The points, in world coordinates.
    survey
        Where each scan was made from.
    origin
        World position of the survey's coordinates, (3,), metres.
    """
    stands = np.array([pose.position for pose in survey.poses]) + origin
    bounds = np.asarray(cloud.bounds, dtype=np.float64)
    fine = _fine_step(stands, bounds)
    by_ring = np.zeros(survey.sensor.layers, np.int64)
    counts = np.zeros(0, np.int64)
    nearest, farthest = np.inf, 0.0
    for chunk in cloud.chunks():
        by_ring += np.bincount(chunk.ring, minlength=len(by_ring))
        ranges = np.linalg.norm(chunk.positions - stands[chunk.scan // survey.steps], axis=1)
        nearest = min(nearest, float(ranges.min(initial=np.inf)))
        farthest = max(farthest, float(ranges.max(initial=0.0)))
        more = np.bincount((ranges / fine).astype(np.int64), minlength=len(counts))
        more[: len(counts)] += counts
        counts = more
    if not len(cloud):
        nothing = np.zeros(0)
        return CloudNumbers(by_ring, nothing.astype(np.int64), nothing, 0.0, 0.0, 0.0, bounds)
    median = fine * (np.searchsorted(np.cumsum(counts), len(cloud) / 2) + 0.5)
    by_range, edges = _coarse(counts, fine, nearest, farthest)
    return CloudNumbers(by_ring, by_range, edges, nearest, float(median), farthest, bounds)


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
