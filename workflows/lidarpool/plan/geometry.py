"""Segments against discs in the plane, exactly: closest points, no sampling."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def segment_distances(first: Floats, last: Floats, centres: Floats) -> Floats:
    """Distance of every segment to every centre.

    Parameters
    ----------
    first, last
        Ends of the segments: (s, 2). A segment may be a single point.
    centres
        Points to measure to: (m, 2).

    Returns
    -------
    Distance from each centre to the closest point of each segment: (s, m).
    """
    along = last - first
    squared = along[:, 0] ** 2 + along[:, 1] ** 2
    to_centre = centres[None, :, :] - first[:, None, :]
    reach = to_centre[..., 0] * along[:, None, 0] + to_centre[..., 1] * along[:, None, 1]
    # A segment of length 0 has reach 0: whatever the divisor, its one point is closest.
    share = np.clip(reach / np.where(squared > 0, squared, 1.0)[:, None], 0.0, 1.0)
    gap_x = to_centre[..., 0] - share * along[:, None, 0]
    gap_y = to_centre[..., 1] - share * along[:, None, 1]
    return np.asarray(np.sqrt(gap_x**2 + gap_y**2))


def path_length(points: Floats) -> float:
    """Length of the path through `points`, (p, 2)."""
    steps = np.diff(points, axis=0)
    # Not np.sum, whose order of additions varies: the length is the same on any machine.
    return float(sum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2).tolist()))


def clearance(points: Floats, centres: Floats, radii: Floats) -> float:
    """Least distance from the path through `points` to the edge of a disc.

    Negative if the path enters a disc, by its greatest depth; 0 if it touches one; inf without
    discs.

    Parameters
    ----------
    points
        Corners of the path: (p, 2), at least 2.
    centres, radii
        The discs: (m, 2) and (m,).
    """
    if not len(radii):
        return float("inf")
    return float((segment_distances(points[:-1], points[1:], centres) - radii).min())
