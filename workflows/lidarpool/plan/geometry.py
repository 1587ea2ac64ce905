"""Segments against discs in the plane, exactly, and normalized coordinates for planning."""

from __future__ import annotations

import math

import numpy as np

from lidarsim.base.arrays import Floats


def segment_distances(first: Floats, last: Floats, centers: Floats) -> Floats:
    """Return the distance of every segment to every center.

    Segments (s, 2) and (s, 2), which may be single points, and centers (m, 2): the distance from
    each center to the closest point of each segment is (s, m).
    """
    direction = last - first
    squared = direction[:, 0] ** 2 + direction[:, 1] ** 2
    to_center = centers[None, :, :] - first[:, None, :]
    reach = to_center[..., 0] * direction[:, None, 0] + to_center[..., 1] * direction[:, None, 1]
    # A segment of length 0 has reach 0: whatever the divisor, its point is closest.
    share = np.clip(reach / np.where(squared > 0, squared, 1.0)[:, None], 0.0, 1.0)
    gap_x = to_center[..., 0] - share * direction[:, None, 0]
    gap_y = to_center[..., 1] - share * direction[:, None, 1]
    return np.asarray(np.sqrt(gap_x**2 + gap_y**2))


def path_length(points: Floats) -> float:
    """Return the length of the path through `points`, (p, 2)."""
    steps = np.diff(points, axis=0)
    # Not np.sum, whose order of additions varies: the length is the same on any machine.
    return float(sum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2).tolist()))


def clearance(points: Floats, centers: Floats, radii: Floats) -> float:
    """Return the smallest distance from the path through `points`, (p, 2), to the edge of a disc.

    The distance is negative if the path enters a disc, by its greatest depth; 0 if the path touches
    a disc; inf without discs. Discs are (m, 2) and (m,).
    """
    if not len(radii):
        return float("inf")
    return float((segment_distances(points[:-1], points[1:], centers) - radii).min())


class PathAxes:
    """Axes that let the path start at (-½, 0) and end at (½, 0), two different points.

    The swarm computes in single precision and with fixed distances; in these axes neither
    georeferenced coordinates nor the size of the scene matter. Only + - x / and square roots are
    used, whose rounding IEEE 754 defines: the same numbers on every machine.
    """

    def __init__(self, start: tuple[float, float], target: tuple[float, float]) -> None:
        run = target[0] - start[0]
        rise = target[1] - start[1]
        self.unit_m = math.sqrt(run * run + rise * rise)  # meters in a unit of these axes
        self._axis = run / self.unit_m, rise / self.unit_m  # x, in the plane
        self._middle = (np.array(start) + np.array(target)) / 2

    def to_local(self, points: Floats) -> Floats:
        """Convert points of the plane, (p, 2), to these axes."""
        cos, sin = self._axis
        x, y = (points - self._middle).T / self.unit_m
        return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)

    def to_plane(self, points: Floats) -> Floats:
        """Convert points on these axes, (p, 2), to the plane."""
        cos, sin = self._axis
        x, y = points.T * self.unit_m
        return np.stack([cos * x - sin * y, sin * x + cos * y], axis=1) + self._middle
