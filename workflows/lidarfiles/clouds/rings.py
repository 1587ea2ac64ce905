"""Determine the rings of a recording from a column, or from the points if there is no column.

KITTI `.bin` files and many PCD files have no ring column. If points are stored ring by ring, a new
ring starts where the azimuth jumps back. Otherwise, rings can be recognized by their elevation
angles, because beams that sweep cones have few distinct elevations unless the points are
motion-compensated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats, Ints

MIN_RINGS = 4  # a sensor with fewer rings is treated as a sensor without rings
_MAX_RINGS = 512
_BACKWARD_DEG = 15.0  # a backward step in azimuth by more than this starts a new ring
_SHORT_RING = 0.02  # a run shorter than this fraction of the median run is not a ring
# Spread of the elevations in a ring as a fraction of their total range. The lines of a Livox have a
# larger spread, because they are not cones.
_MAX_CONE_SPREAD = 0.25
_MIN_IN_ORDER = 0.95  # fraction of runs whose elevations continue in the same direction
_MAX_CLUSTERS = 128  # maximum number of elevation clusters
_MIN_GAP_RATIO = 3.0  # smallest gap between clusters relative to the largest gap within a cluster
_MIN_CLUSTER = 1e-3  # fraction of points in a cluster; smaller clusters are stray points


@dataclass(frozen=True, eq=False)
class Rings:
    """Rings of a recording, sorted from the highest to the lowest.

    Attributes
    ----------
    name
        Name of the recording.
    elevation_rad
        Median elevation angles of the rings in radians, of shape (r,). Empty if the rings are
        unknown.
    numbers
        Numbers of the rings in the column `channel`, of shape (r,), or None if there is no such
        column.
    are_cones
        Whether the rings were determined from elevation angles.
    note
        Description of how the rings were determined, or of why they are unknown.
    """

    name: str
    elevation_rad: Floats = field(default_factory=lambda: np.empty(0))
    numbers: Ints | None = None
    are_cones: bool = False
    note: str = ""

    @classmethod
    def from_sweeps(cls, name: str, sweeps: Sequence[Sweep]) -> Rings:
        """Find the rings in the returns of several sweeps.

        The sweeps should not be motion-compensated.
        """
        if not sweeps:
            return cls(name)
        if all("channel" in sweep.columns for sweep in sweeps):
            return cls._from_columns(name, sweeps)
        found = [_runs_in_order(sweep.points) for sweep in sweeps]
        runs = [run for run in found if run is not None]
        if runs:
            medians = max(runs, key=len)
            note = (
                f"{name} has no ring column. Its {len(medians)} rings were determined from the "
                "order of the points."
            )
            return cls(name, np.sort(medians)[::-1], note=note)
        clusters = _clusters(np.concatenate([sweep.points for sweep in sweeps]))
        if clusters is not None:
            note = (
                f"{name} has no ring column. Its {len(clusters)} rings were determined from the "
                "elevation angles of the points."
            )
            return cls(name, clusters, are_cones=True, note=note)
        note = (
            f"{name} has no ring column, and its rings cannot be determined from the order or the "
            "elevation angles of its points. Either its points are motion-compensated, or its ray "
            "directions are not calibrated."
        )
        return cls(name, note=note)

    @classmethod
    def _from_columns(cls, name: str, sweeps: Sequence[Sweep]) -> Rings:
        rings = np.concatenate([np.asarray(sweep.columns["channel"]) for sweep in sweeps])
        elevation = np.concatenate([elevations(sweep.points) for sweep in sweeps])
        numbers, medians, spread_rad = summarize_rings(rings.astype(np.int64), elevation)
        if len(numbers) < MIN_RINGS:
            return cls(name)
        if not form_cones(medians, spread_rad):
            note = (
                f"The rings of {name} do not form cones, so its ray directions are not calibrated."
            )
            return cls(name, note=note)
        return cls(name, medians, numbers)

    def __len__(self) -> int:
        return len(self.elevation_rad)

    def ring_indices(self, sweep: Sweep) -> Ints:
        """Return the index of each point's ring in `elevation_rad`, or -1 if it is unknown.

        Raises LidarError if the sweep lacks the ring column that other sweeps have.
        """
        points = sweep.points
        if not len(self) or not len(points):
            return np.full(len(points), -1)
        if self.numbers is not None:
            return self._rows_of_column(sweep)
        if self.are_cones:
            boundaries = (self.elevation_rad[1:] + self.elevation_rad[:-1]) / 2
            return np.searchsorted(-boundaries, -elevations(points))
        starts, is_ring = _runs(points)
        lengths = np.diff(np.append(starts, len(points)))
        rows = self._rows_of_runs(_medians(elevations(points), starts), is_ring)
        return rows.repeat(lengths)

    def _rows_of_column(self, sweep: Sweep) -> Ints:
        if "channel" not in sweep.columns:
            raise LidarError(
                f"Some sweeps of {self.name} have a ring column, and others do not. Use the sweeps "
                "of a single sensor."
            )
        assert self.numbers is not None
        numbers = np.asarray(sweep.columns["channel"]).astype(np.int64)
        # The values of a column are usually consecutive, and all of them belong to a ring.
        values = np.arange(int(numbers.min()), int(numbers.max()) + 1)
        if len(values) > len(numbers):
            values, numbers = np.unique(numbers, return_inverse=True)
        else:
            numbers -= values[0]
        order = np.argsort(self.numbers)
        place = np.searchsorted(self.numbers, values, sorter=order)
        row = order[np.minimum(place, len(order) - 1)]
        return np.where(self.numbers[row] == values, row, -1)[numbers]

    def _rows_of_runs(self, medians: Floats, is_ring: Bools) -> Ints:
        """Assign a ring to each run of points, given the median elevations of the runs.

        Returns the index of the ring for each run, or -1 for runs that are not rings. Each ring is
        assigned to at most one run. Choosing the ring with the nearest elevation would be
        ambiguous, because the median elevation of a ring depends on the surfaces that it hits. It
        can change by more than the angle between neighboring rings.
        """
        rows = np.full(len(medians), -1)
        runs = np.flatnonzero(is_ring)
        chosen, assigned = assign_nearest(medians[runs], self.elevation_rad)
        rows[runs[chosen]] = assigned
        return rows


def assign_nearest(values: Floats, targets: Floats) -> tuple[Ints, Ints]:
    """Pair values with targets so that the sum of the absolute differences is as small as possible.

    Each value and each target is in one pair at most, and the pairs keep the order of the numbers,
    which no other pairs can improve. `values` has shape (n,), and `targets` has shape (m,). The
    results are the indices of the values and of their targets, each with shape (min(n, m),).
    """
    if len(values) > len(targets):
        chosen, assigned = assign_nearest(targets, values)
        return assigned, chosen
    order, target_order = np.argsort(values, kind="stable"), np.argsort(targets, kind="stable")
    cost = np.abs(values[order, None] - targets[target_order])
    # sums[j]: the smallest sum of the pairs of the values so far with some of the first j targets.
    sums = np.zeros(len(targets) + 1)
    is_paired = np.empty(cost.shape, bool)  # value i with target j, rather than with an earlier one
    for row, costs in enumerate(cost):
        paired = sums[:-1] + costs
        paired[:row] = np.inf  # the values before take as many targets
        best = np.minimum.accumulate(paired)
        sums = np.concatenate([[np.inf], best])
        is_paired[row] = paired < sums[:-1]
    pairs = np.empty(len(values), np.int64)
    last = len(targets)
    for row in range(len(values) - 1, -1, -1):
        last = int(np.flatnonzero(is_paired[row, :last])[-1])
        pairs[row] = last
    return order, target_order[pairs]


def elevations(points: Floats) -> Floats:
    """Return the elevation angles of points in the sensor frame, in radians."""
    return np.asarray(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))


def summarize_rings(rings: Ints, elevation: Floats) -> tuple[Ints, Floats, float]:
    """Summarize the elevations of rings.

    Parameters
    ----------
    rings
        Ring number of each point, with shape (n,).
    elevation
        Elevation angle of each point in radians, with shape (n,).

    Returns
    -------
    Ring numbers and median elevations, sorted from the highest to the lowest ring, and the
    deviation of the rings from cones. The deviation is the median, over all rings, of the
    interquartile range of the elevations in a ring.
    """
    numbers, index = np.unique(rings, return_inverse=True)
    parts = [elevation[index == row] for row in range(len(numbers))]
    low, medians, high = np.array([np.quantile(part, (0.25, 0.5, 0.75)) for part in parts]).T
    order = np.argsort(-medians, kind="stable")
    return numbers[order], medians[order], float(np.median(high - low))


def form_cones(elevation_rad: Floats, spread_rad: float) -> bool:
    """Return whether rings lie on cones, unlike the lines of a Livox.

    `elevation_rad` are the median elevations of the rings, and `spread_rad` is their deviation from
    cones, as `summarize_rings` returns them.
    """
    return bool(spread_rad <= _MAX_CONE_SPREAD * np.ptp(elevation_rad))


def _clusters(points: Floats) -> Floats | None:
    """Return the elevations of the cones on which points lie, from the highest to the lowest.

    Returns None unless the gaps between the clusters of elevations are larger than the widest
    cluster.
    """
    elevation = np.sort(elevations(points))
    gaps = np.diff(elevation)
    largest = np.sort(gaps)[::-1][:_MAX_CLUSTERS]
    if len(largest) < _MAX_CLUSTERS:
        return None
    ratios = largest[:-1] / np.maximum(largest[1:], 1e-9)
    ratios[: MIN_RINGS - 2] = 0
    last = int(ratios.argmax())  # index of the smallest gap between clusters
    starts = np.append(0, np.flatnonzero(gaps >= largest[last]) + 1)
    stops = np.append(starts[1:], len(elevation)) - 1
    widest = float((elevation[stops] - elevation[starts]).max())
    smallest = (stops - starts + 1).min()
    if largest[last] < max(widest, _MIN_GAP_RATIO * largest[last + 1]):
        return None
    if smallest < _MIN_CLUSTER * len(elevation):
        return None
    return _medians(elevation, starts)[::-1]


def _runs(points: Floats) -> tuple[Ints, Bools]:
    """Return the index at which each run starts, and a mask of the runs that are rings.

    The azimuths of the points in a run are monotonic.
    """
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360
    steps = np.diff(azimuth)
    direction = np.sign(np.sum(np.sign(steps)))
    starts = np.append(0, np.flatnonzero(direction * steps < -_BACKWARD_DEG) + 1)
    lengths = np.diff(np.append(starts, len(points)))
    return starts, lengths > _SHORT_RING * np.median(lengths)


def _medians(values: Floats, starts: Ints) -> Floats:
    return np.array([np.median(run) for run in np.split(values, starts[1:])])


def _runs_in_order(points: Floats) -> Floats | None:
    """Return the median elevation of each ring, or None if points are not sorted by ring."""
    if len(points) < _MAX_RINGS:
        return None
    starts, is_ring = _runs(points)
    if not MIN_RINGS <= is_ring.sum() <= _MAX_RINGS:
        return None
    medians = _medians(elevations(points), starts)[is_ring]
    steps = np.sign(np.diff(medians))
    return medians if abs(steps.mean()) > 2 * _MIN_IN_ORDER - 1 else None
