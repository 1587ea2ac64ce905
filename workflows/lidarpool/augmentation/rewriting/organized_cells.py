"""Cells of organized clouds to which augmented points belong.

An organized cloud has a cell for each pulse. The template of an added return is another point of
the same ring, so its cell is found from its azimuth, which increases or decreases steadily along a
ring.
"""

from __future__ import annotations

from bisect import bisect_left

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
    added = np.flatnonzero(~is_recorded)
    # If the template is the cell of a pulse without a return, it is the pulse of the added return.
    templates, first = np.unique(cells[added], return_index=True)
    own = first[~taken[templates] & ~recorded.has_return[templates]]
    taken[cells[added[own]]] = True
    remaining = np.delete(added, own)
    if not len(remaining):
        return cells
    rings = recorded.rings
    if rings is None:
        return None
    for ring in np.unique(rings[cells[remaining]]).tolist():
        points = remaining[rings[cells[remaining]] == ring]
        rows = np.flatnonzero(rings == ring)
        found = _cells_in_ring(recorded, rows, taken, np.asarray(augmented.sweep.points)[points])
        if found is None:
            return None
        cells[points] = found
        taken[found] = True
    return cells


def _cells_in_ring(recorded: Sweep, rows: Ints, taken: Bools, points: Floats) -> Ints | None:
    """Return the free cells of a ring that are closest to the azimuths of points, or None."""
    positions = _positions_in_ring(recorded, rows, points)
    if positions is None:
        return None
    free = np.flatnonzero(~taken[rows]).tolist()
    found = np.empty(len(points), np.intp)
    for point in np.argsort(positions, kind="stable").tolist():
        index = bisect_left(free, positions[point])
        candidates = [k for k in (index - 1, index) if 0 <= k < len(free)]
        best = min(candidates, key=lambda k: abs(free[k] - positions[point]), default=None)
        if best is None or abs(free[best] - positions[point]) > _MAX_OFFSET:
            return None
        found[point] = rows[free.pop(best)]
    return found


def _positions_in_ring(recorded: Sweep, rows: Ints, points: Floats) -> Floats | None:
    """Return the positions of points among the cells of a ring, according to their azimuths.

    Returns None if the azimuths of the recorded points do not increase or decrease steadily.
    """
    known = np.flatnonzero(recorded.has_return[rows])
    if len(known) < 2:
        return None
    x, y, _ = np.asarray(recorded.points, np.float64)[rows[known]].T
    angles = np.unwrap(np.arctan2(y, x))
    direction = np.sign(angles[-1] - angles[0])
    angles *= direction
    if direction == 0 or (np.diff(angles) < 0).mean() > _MAX_REVERSED:
        return None
    angles = np.maximum.accumulate(angles)
    step = (angles[-1] - angles[0]) / (known[-1] - known[0])
    azimuths = direction * np.arctan2(points[:, 1], points[:, 0])
    azimuths = angles[0] + (azimuths - angles[0]) % (2 * np.pi)
    positions = np.interp(azimuths, angles, known)
    after = known[-1] + (azimuths - angles[-1]) / step
    before = known[0] - (angles[0] + 2 * np.pi - azimuths) / step
    is_after = azimuths > angles[-1]
    is_behind_end = after > len(rows) - 0.5
    positions = np.where(is_after, np.where(is_behind_end, before, after), positions)
    return np.asarray(positions.clip(0, len(rows) - 1), np.float64)
