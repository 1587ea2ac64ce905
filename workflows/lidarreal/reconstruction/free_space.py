"""Detect points on moving objects, so that they can be excluded from the static scene.

The rays of a sweep form a range image. A point of another sweep is in front of, among, or behind
the surfaces in the image around its direction. If the point is in front of them, a ray passed
through its position, so the point was on an object that moved. Directions and ranges are as seen
from the laser whose ray is closest to the point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarfiles.clouds.rings import elevations
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints

from ..scan_patterns.lasers import RingLasers
from .alignment import AlignedSweeps

_COLUMNS = 1024  # number of image columns, more than the pulses per ring of nearly all sensors
_ROW_RAD = np.radians(0.5)  # height of an image row for a sensor without rings
_MARGIN_RAD = 0.003  # margin beyond the highest and lowest rings, for the beam divergence
# Tolerance for points in front of a surface, as a constant and relative to the range.
_TOLERANCE_M = 0.2
_TOLERANCE_PER_M = 0.01
# Offsets of the earlier and later sweeps that a sweep is compared with, in sweeps.
_OFFSETS = (1, 2, 3, 5, 8, 13, 21, 34)
_LASER_ROUNDS = 2  # iterations of determining the laser whose ray is closest to a point
_MIN_PASSING = 2  # From this number of passing rays, a tie counts as motion.


@dataclass(frozen=True, eq=False)
class RangeImage:
    """Ranges of the nearest and farthest surfaces around each direction of a sweep.

    The neighborhood of a direction is three rows by three columns. Beams are wide, so a point next
    to an edge is neither in front of nor behind it.
    """

    lasers: RingLasers  # of the rows, from the highest to the lowest
    limits_rad: tuple[float, float]  # lowest and highest elevation of the rays
    nearest_m: Floats32  # (r, c), inf without a return
    farthest_m: Floats32  # (r, c), -inf without a return

    @classmethod
    def from_points(cls, points: Floats, lasers: RingLasers) -> RangeImage:
        """Create a range image from points in sensor coordinates.

        The points have shape (n, 3). The image has a row for each laser, and the highest is first.
        """
        from scipy.ndimage import maximum_filter, minimum_filter

        shape = (len(lasers), _COLUMNS)
        cells, _, range_m = locate(points, lasers, _COLUMNS)
        range_m = range_m.astype(np.float32)
        nearest = np.full(shape, np.inf, np.float32)
        farthest = np.full(shape, -np.inf, np.float32)
        np.minimum.at(nearest, cells, range_m)
        np.maximum.at(farthest, cells, range_m)
        modes = ("nearest", "wrap")
        elevation_rad = lasers.elevation_rad
        limits = elevation_rad[-1] - _MARGIN_RAD, elevation_rad[0] + _MARGIN_RAD
        return cls(
            lasers,
            (float(limits[0]), float(limits[1])),
            minimum_filter(nearest, 3, mode=modes),
            maximum_filter(farthest, 3, mode=modes),
        )

    def classify(self, points: Floats) -> tuple[Bools, Bools]:
        """Compare points in sensor coordinates with the range image.

        Return two masks of shape (n,). The first marks points that a ray passed through, and the
        second marks points that the image confirms.
        """
        cells, elevation, range_m = locate(points, self.lasers, _COLUMNS)
        tolerance_m = _TOLERANCE_M + _TOLERANCE_PER_M * range_m
        nearest = self.nearest_m[cells]
        low, high = self.limits_rad
        observed = np.isfinite(nearest) & (elevation > low) & (elevation < high)
        passing = observed & (nearest > range_m + tolerance_m)
        behind = self.farthest_m[cells] < range_m - tolerance_m
        return passing, observed & ~passing & ~behind


def locate(
    points: Floats, lasers: RingLasers, column_count: int
) -> tuple[tuple[Ints, Ints], Floats, Floats]:
    """Return the image cells, elevations and ranges of points as seen from the closest lasers.

    The points are in sensor coordinates, with shape (n, 3). The image has a row for each laser,
    from the highest to the lowest.
    """
    edges_rad = -(lasers.elevation_rad[1:] + lasers.elevation_rad[:-1]) / 2
    elevation = elevations(points)
    rows = np.searchsorted(edges_rad, -elevation)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    if not lasers.is_at_origin:
        for _ in range(_LASER_ROUNDS):
            azimuth, elevation = lasers.angles(points, rows)
            rows = np.searchsorted(edges_rad, -elevation)
    range_m = lasers.ranges(points, rows)
    turns = azimuth / (2 * np.pi) + 0.5
    columns = np.floor(turns * column_count).astype(np.int64) % column_count
    return (rows, columns), elevation, range_m


def find_stationary_points(sweeps: AlignedSweeps, numbers: Sequence[int]) -> dict[int, Bools]:
    """Find the stationary points of each sweep, and return their masks, keyed by sweep number.

    `numbers` are the sweeps to compare with each other, in ascending order. The masks have shape
    (n,).
    """
    lasers = sweeps.recorded.lasers.sort_by_elevation()
    if not len(lasers):
        elevation = np.concatenate([elevations(sweeps.read(number).points) for number in numbers])
        high = float(elevation.max())
        rows_rad = np.arange(high, float(elevation.min()) - _ROW_RAD, -_ROW_RAD)
        lasers = RingLasers.at_origin(rows_rad)
    images = {
        number: RangeImage.from_points(sweeps.read(number).points, lasers) for number in numbers
    }
    masks = {}
    for index, number in enumerate(numbers):
        world = sweeps.read(number).world
        passing = np.zeros(len(world), np.int64)
        confirming = np.zeros(len(world), np.int64)
        rows = np.arange(len(world))  # points whose result is still open
        others = [
            numbers[index + offset]
            for offset in (*_OFFSETS, *(-offset for offset in _OFFSETS))
            if 0 <= index + offset < len(numbers)
        ]
        for left, other in zip(reversed(range(len(others))), others, strict=True):
            pose = sweeps.alignment.poses[other]
            passed, confirmed = images[other].classify((world[rows] - pose[:3, 3]) @ pose[:3, :3])
            passing[rows] += passed
            confirming[rows] += confirmed
            rows = rows[np.abs(passing[rows] - confirming[rows]) <= left]
        moved = (passing > confirming) | ((passing >= _MIN_PASSING) & (passing >= confirming))
        masks[number] = ~moved
    return masks
