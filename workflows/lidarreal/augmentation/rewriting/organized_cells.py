"""Cells of organized clouds to which augmented points belong.

An organized cloud has a cell for each pulse. The template of an added return is another point of
the same ring, so its cell is found from its azimuth, which increases or decreases steadily along a
ring.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Bools, Floats, Ints

from ..augmented_sweep import AugmentedSweep

_MAX_OFFSET = 2  # maximum distance of a point from the cell of its azimuth, in cells of the ring
_MAX_REVERSED = 0.02  # maximum fraction of neighbors in a ring whose azimuths are in reverse order


def assign_cells(recorded: Sweep, augmented: AugmentedSweep) -> Ints | None:
    """Return the cell of each augmented point.

    Recorded returns stay in their cells. Added returns are stored in the free cell of their ring
    that is closest to their azimuth.

    Parameters
    ----------
    recorded
        The recorded sweep, with a row for each cell.
    augmented
        The n augmented points.

    Returns
    -------
    Row indices of shape (n,), or None if a point has no free cell, for example because a pulse has
    several returns.
    """
    cells = np.array(augmented.template, np.intp)
    is_recorded = np.asarray(augmented.is_recorded, bool)
    taken = np.zeros(len(recorded), bool)
    if len(np.unique(cells[is_recorded])) != is_recorded.sum():
        return None
    taken[cells[is_recorded]] = True
    returned = recorded.has_return
    added = np.flatnonzero(~is_recorded)
    # If the template is the cell of a pulse without a return, it is the pulse of the added return.
    templates, first = np.unique(cells[added], return_index=True)
    own = first[~taken[templates] & ~returned[templates]]
    taken[cells[added[own]]] = True
    remaining = np.delete(added, own)
    if not len(remaining):
        return cells
    rings = recorded.rings
    if rings is None:
        return None
    positions = np.asarray(recorded.points, np.float64)
    for ring in np.unique(rings[cells[remaining]]).tolist():
        points = remaining[rings[cells[remaining]] == ring]
        rows = np.flatnonzero(rings == ring)
        ring_of_cells = _Ring(positions[rows], returned[rows], ~taken[rows])
        found = ring_of_cells.closest_free_cells(np.asarray(augmented.sweep.points)[points])
        if found is None:
            return None
        cells[points] = rows[found]
        taken[rows[found]] = True
    return cells


class _Ring(NamedTuple):
    """Cells of a ring."""

    points: Floats  # (m, 3)
    has_return: Bools  # (m,)
    is_free: Bools  # (m,)

    def closest_free_cells(self, points: Floats) -> Ints | None:
        """Return the free cell that is closest to the azimuth of each point, or None."""
        positions = self._positions(points)
        if positions is None:
            return None
        free = np.flatnonzero(self.is_free).tolist()
        found = np.empty(len(points), np.intp)
        for point in np.argsort(positions, kind="stable").tolist():
            position = float(positions[point])
            index = bisect_left(free, position)
            if index and (
                index == len(free) or position - free[index - 1] <= free[index] - position
            ):
                index -= 1
            if index == len(free) or abs(free[index] - position) > _MAX_OFFSET:
                return None
            found[point] = free.pop(index)
        return found

    def _positions(self, points: Floats) -> Floats | None:
        """Return the positions of points among the cells, according to their azimuths.

        Returns None if the azimuths of the recorded points do not increase or decrease steadily.
        """
        known = np.flatnonzero(self.has_return)
        if len(known) < 2:
            return None
        x, y, _ = self.points[known].T
        angles = np.unwrap(np.arctan2(y, x))
        direction = np.sign(angles[-1] - angles[0])
        angles *= direction
        if direction == 0 or (np.diff(angles) < 0).mean() > _MAX_REVERSED:
            return None
        angles = np.maximum.accumulate(angles)
        step = (angles[-1] - angles[0]) / (known[-1] - known[0])
        azimuths = direction * np.arctan2(points[:, 1], points[:, 0])
        azimuths = angles[0] + (azimuths - angles[0]) % (2 * np.pi)
        after = known[-1] + (azimuths - angles[-1]) / step
        before = known[0] - (angles[0] + 2 * np.pi - azimuths) / step
        outside = np.where(after > len(self.points) - 0.5, before, after)
        inside = np.interp(azimuths, angles, known)
        positions = np.where(azimuths > angles[-1], outside, inside)
        return np.asarray(positions.clip(0, len(self.points) - 1), np.float64)
