"""Returns from the vehicle that carries the sensor, which do not belong to the scene."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints

VEHICLE_COLUMNS = 720  # azimuth cells per ring
_MARGIN_M = 0.1  # margin behind the surfaces of the vehicle


class VehicleReturns(NamedTuple):
    """Ranges of the vehicle that carries the sensor, by ring and azimuth cell."""

    farthest_m: Floats32  # (r, c), -inf where the vehicle is not visible
    share: float = 0.0  # share of the returns that come from the vehicle

    @property
    def are_found(self) -> bool:
        """Whether the sensor receives returns from the vehicle."""
        return bool(np.isfinite(self.farthest_m).any())

    def contain(self, sweep: Sweep) -> Bools:
        """Return whether the returns of a sweep come from the vehicle.

        Returns in front of the vehicle, such as from its edges, count as well.

        The sweep has the column `row` with the ring of each return. The mask has shape (n,).
        """
        cell = vehicle_cells(sweep.points, sweep.columns["row"])
        range_m = np.linalg.norm(sweep.points, axis=1)
        return np.asarray(range_m < self.farthest_m[cell] + _MARGIN_M)


def vehicle_cells(points: Floats, row: Ints) -> tuple[Ints, Ints]:
    """Return the rings and azimuth cells of points in sensor coordinates, of shape (n, 3)."""
    turns = np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5
    return row, np.floor(turns * VEHICLE_COLUMNS).astype(np.int64) % VEHICLE_COLUMNS
