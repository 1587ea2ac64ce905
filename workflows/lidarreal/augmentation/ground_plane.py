"""The ground of a recorded sweep, on which objects are placed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats

_RADII_M = (2.0, 3.0, 5.0, 8.0, 12.0)  # radii within which ground points are searched
_MIN_POINTS = 12  # minimum number of points of a plane
_CELL_M = 0.5  # size of the cells whose lowest points are used
_MAX_SLOPE = 0.35  # maximum slope of the ground
_TOLERANCE_M = 0.1  # maximum distance of a ground point from its plane
_MAX_ABOVE_M = 0.0  # the ground is below the sensor


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """Ground of a sweep, which is approximated by a plane around each position.

    `points` (n, 3) are the lowest points of the cells of a grid, in the sensor frame in meters.
    """

    points: Floats

    @classmethod
    def from_sweep(cls, sweep: Sweep) -> GroundPlane:
        """Select the lowest points of a sweep."""
        points = sweep.returns().points
        points = points[points[:, 2] < _MAX_ABOVE_M]
        cells = np.floor(points[:, :2] / _CELL_M).astype(np.int64)
        order = np.lexsort((points[:, 2], cells[:, 1], cells[:, 0]))
        first = np.ones(len(order), np.bool_)
        first[1:] = np.diff(cells[order], axis=0).any(axis=1)
        return cls(points[order[first]])

    def at(self, x_m: float, y_m: float, name: str, recording: str) -> tuple[float, Floats]:
        """Return the height of the ground at a position, and its upward unit normal.

        The plane is fitted to the lowest points around the position, with those above it removed
        step by step. Raises LidarError if there are too few points. `name` and `recording` are the
        names of the object and the recording in the message.
        """
        distance = np.hypot(self.points[:, 0] - x_m, self.points[:, 1] - y_m)
        for radius in _RADII_M:
            near = self.points[distance < radius]
            if len(near) < _MIN_POINTS:
                continue
            low = near[near[:, 2] < np.quantile(near[:, 2], 0.5) + _TOLERANCE_M]
            for _ in range(5):
                offsets = np.column_stack([low[:, 0] - x_m, low[:, 1] - y_m, np.ones(len(low))])
                (a, b, c), *_ = np.linalg.lstsq(offsets, low[:, 2], rcond=None)
                all_offsets = np.column_stack(
                    [near[:, 0] - x_m, near[:, 1] - y_m, np.ones(len(near))]
                )
                above = near[:, 2] - all_offsets @ [a, b, c]
                kept = near[np.abs(above) < _TOLERANCE_M]
                if len(kept) < _MIN_POINTS:
                    break
                low = kept
            if len(low) >= _MIN_POINTS and np.hypot(a, b) < _MAX_SLOPE:
                up = np.array([-a, -b, 1.0])
                return float(c), up / np.linalg.norm(up)
        raise LidarError(
            f"{recording} contains too few ground points around {x_m:g},{y_m:g} to place {name}. "
            f"Set its height, for example `--at {x_m:g},{y_m:g},-1.8`."
        )
