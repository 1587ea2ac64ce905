"""Find the directions in which the vehicle blocks the pulses of a sensor.

Roof racks, camera posts and antennas move with the sensor, so they block the same directions in all
sweeps. Pulses are also lost in the sky, at windows and at black cars. At these, however, the
surroundings change while the vehicle moves, and only the vehicle interrupts surfaces at close range
again and again in the same direction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices

_MIN_SWEEPS = 10  # minimum number of sweeps at different positions
_MAX_SWEEPS = 100
_MIN_MOTION_M = 1.0  # minimum distance between their positions
_MIN_PULSES = 6  # minimum number of pulses in a cell
_MAX_RETURN_SHARE = 0.5  # maximum share of pulses that return in a blocked cell
_MAX_SURFACE_M = 20.0  # maximum range of surfaces that almost always return pulses
_MIN_INTERRUPTED = 4  # minimum number of pulses in a blocked cell that were lost within a surface
_MIN_INTERRUPTED_SHARE = 0.25  # minimum share of these among the lost pulses
_RINGS_AROUND = 2  # rings of sensors with two columns of lasers alternate
_LOW_RAD = np.radians(-3)  # Rings below this elevation observe the ground.
_MAX_LOW_RETURN_SHARE = 0.1  # maximum share of pulses that return in a blocked cell of these


class BlockedDirections(NamedTuple):
    """Directions in which the vehicle blocks the pulses of a sensor."""

    cells: Bools  # (r, c), rings and azimuth cells; (0, 0) if nothing is blocked

    @classmethod
    def none(cls) -> BlockedDirections:
        """Return an instance without blocked directions."""
        return cls(np.zeros((0, 0), bool))

    def contains(self, azimuth: Floats, ring: Ints) -> Bools:
        """Return whether directions are blocked.

        The azimuths of the beams in radians, the rings and the result have shape (n,).
        """
        if not self.cells.any():
            return np.zeros(len(ring), bool)
        return np.asarray(self.cells[azimuth_cells(azimuth, ring, self.cells.shape[1])])

    def sectors_deg(self) -> list[tuple[int, float, float]]:
        """Return the ring, the start and the stop of each blocked sector.

        Azimuths are in degrees from -180 to 180, and sectors extend counterclockwise.
        """
        count = self.cells.shape[1]
        found = []
        for ring, row in enumerate(self.cells):
            starts = np.flatnonzero(row & ~np.roll(row, 1))
            stops = np.flatnonzero(row & ~np.roll(row, -1)) + 1
            if row.all():
                starts = np.array([0])
                stops = np.array([count])
            if len(stops) and stops[0] <= starts[0]:
                stops = np.roll(stops, -1)
            edges = np.column_stack([starts, stops]) * (360 / count) - 180
            found += [(ring, start, stop) for start, stop in edges.round(3).tolist()]
        return found


def azimuth_cells(azimuth: Floats, ring: Ints, count: int) -> tuple[Ints, Ints]:
    """Return the indices of the rings and of the azimuth cells, of which there are `count`."""
    turns = azimuth / (2 * np.pi) + 0.5
    return ring, np.floor(turns * count).astype(np.int64) % count


class PulseCounts(NamedTuple):
    """Numbers of pulses by ring and azimuth cell, as arrays of shape (r, c)."""

    returned: Ints
    near: Ints  # returned pulses from surfaces at close range
    lost: Ints
    interrupted: Ints  # lost pulses that a surface at close range surrounds

    @classmethod
    def zeros(cls, ring_count: int, columns: int) -> PulseCounts:
        """Return counts of 0."""
        return cls(*np.zeros((4, ring_count, columns), np.int64))

    def add_returned(self, azimuth: Floats, ring: Ints, range_m: Floats) -> None:
        """Count returned pulses. The azimuths of the beams are in radians."""
        ring, column = azimuth_cells(azimuth, ring, self.returned.shape[1])
        np.add.at(self.returned, (ring, column), 1)
        is_near = range_m < _MAX_SURFACE_M
        np.add.at(self.near, (ring[is_near], column[is_near]), 1)

    def add_lost(self, azimuth: Floats, ring: Ints, range_m: Floats) -> None:
        """Count lost pulses. `range_m` are the ranges of the surfaces around them, or NaN."""
        ring, column = azimuth_cells(azimuth, ring, self.lost.shape[1])
        np.add.at(self.lost, (ring, column), 1)
        inside = range_m < _MAX_SURFACE_M
        np.add.at(self.interrupted, (ring[inside], column[inside]), 1)

    def blocked(self, elevation_rad: Floats) -> BlockedDirections:
        """Determine the blocked directions.

        `elevation_rad` are the elevations of the rings, from the highest to the lowest. Rings far
        below the horizon almost always return from the ground. Their cells without returns are
        therefore also blocked if they adjoin blocked cells. Gaps across the roof are often too wide
        to be recognized as interrupted surfaces.
        """
        from scipy.ndimage import binary_propagation, convolve1d

        pulses = self.returned + self.lost
        is_sampled = pulses >= _MIN_PULSES
        cells = is_sampled & (self.returned <= _MAX_RETURN_SHARE * pulses)
        expected = self.near + self.interrupted
        cells &= self.near <= _MAX_RETURN_SHARE * expected
        cells &= self.interrupted >= _MIN_INTERRUPTED
        cells &= self.interrupted >= _MIN_INTERRUPTED_SHARE * self.lost
        # A single cell may have lost its pulses by chance.
        around = convolve1d(cells.astype(np.int64), np.ones(3, np.int64), axis=1, mode="wrap")
        rings = np.ones(2 * _RINGS_AROUND + 1, np.int64)
        cells &= convolve1d(around, rings, axis=0, mode="constant") > 1
        is_low = np.zeros(len(cells), bool)
        is_low[: len(elevation_rad)] = elevation_rad < _LOW_RAD
        silent = is_sampled & (self.returned <= _MAX_LOW_RETURN_SHARE * pulses) & is_low[:, None]
        reach = np.ones((2 * _RINGS_AROUND + 1, 1), bool)
        return BlockedDirections(binary_propagation(cells, reach, mask=cells | silent))


def separated_sweeps(numbers: Ints, positions: Floats) -> Ints:
    """Select sweeps that were recorded at different positions.

    Parameters
    ----------
    numbers
        Numbers of the sweeps to select from, in ascending order.
    positions
        Positions of the sensor at all sweeps, in meters. Shape (s, 3).

    Returns
    -------
    array
        Numbers of the selected sweeps. The array is empty if they are too few to distinguish the
        vehicle from its surroundings.
    """
    chosen: list[int] = []
    for number in numbers.tolist():
        step = positions[number] - positions[chosen[-1]] if chosen else np.inf
        if np.linalg.norm(step) >= _MIN_MOTION_M:
            chosen.append(number)
    if len(chosen) < _MIN_SWEEPS:
        return numbers[:0]
    return np.array(chosen)[even_indices(len(chosen), _MAX_SWEEPS)]
