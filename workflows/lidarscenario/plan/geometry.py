"""Exact distances between segments and discs in the plane, and normalized planning coordinates."""

from __future__ import annotations

import math

import numpy as np

from lidarsim.numerics.arrays import Floats


def segment_distances(first: Floats, last: Floats, centers: Floats) -> Floats:
    """Return the distance from each center to the closest point of each segment.

    `first` and `last` contain the end points of the segments and have shape (s, 2). A segment may
    be a single point. `centers` has shape (m, 2), and the result has shape (s, m).
    """
    direction = last - first
    squared = direction[:, 0] ** 2 + direction[:, 1] ** 2
    to_center = centers[None, :, :] - first[:, None, :]
    reach = to_center[..., 0] * direction[:, None, 0] + to_center[..., 1] * direction[:, None, 1]
    # A segment of length 0 has a reach of 0, so any nonzero divisor selects its only point.
    fraction = np.clip(reach / np.where(squared > 0, squared, 1.0)[:, None], 0.0, 1.0)
    gap_x = to_center[..., 0] - fraction * direction[:, None, 0]
    gap_y = to_center[..., 1] - fraction * direction[:, None, 1]
    return np.asarray(np.sqrt(gap_x**2 + gap_y**2))


def path_length(points: Floats) -> float:
    """Return the length of the polyline through the given points."""
    steps = np.diff(points, axis=0)
    # The order of additions in np.sum varies between machines, but Python's sum is reproducible.
    return float(sum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2).tolist()))


def clearance(points: Floats, centers: Floats, radii: Floats) -> float:
    """Return the smallest distance between a path and the edge of a disc.

    The path is the polyline through `points`, with shape (p, 2). Discs have `centers` of shape (m,
    2) and `radii` of shape (m,). If the path enters a disc, the result is negative, and its
    magnitude is the largest depth. Without discs, the result is inf.
    """
    if not len(radii):
        return float("inf")
    return float((segment_distances(points[:-1], points[1:], centers) - radii).min())


class PathAxes:
    """Coordinate system in which the path starts at (-½, 0) and ends at (½, 0).

    The swarm computes in single precision and uses fixed distances. In these axes, its results
    depend neither on the size of georeferenced coordinates nor on the size of the scene. Start and
    target must differ. Only additions, subtractions, multiplications, divisions and square roots
    are used, because IEEE 754 defines their rounding. Thus the numbers are the same on all
    machines.
    """

    def __init__(self, start: tuple[float, float], target: tuple[float, float]) -> None:
        run = target[0] - start[0]
        rise = target[1] - start[1]
        self.unit_m = math.sqrt(run * run + rise * rise)  # meters in a unit of these axes
        self._axis = run / self.unit_m, rise / self.unit_m  # x, in the plane
        self._middle = (np.array(start) + np.array(target)) / 2

    def to_local(self, points: Floats) -> Floats:
        """Convert points from the plane to this coordinate system.

        Both arrays have shape (p, 2).
        """
        cos, sin = self._axis
        x, y = (points - self._middle).T / self.unit_m
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)

    def to_plane(self, points: Floats) -> Floats:
        """Convert points from this coordinate system to the plane.

        Both arrays have shape (p, 2).
        """
        cos, sin = self._axis
        x, y = points.T * self.unit_m
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1) + self._middle
