"""Clusters of points on moving objects, and their association over time.

The points of a sweep that moved are linked to clusters in the horizontal plane. Clusters of
consecutive sweeps are then associated with a constant-velocity model. What moves is neither
classified nor compared with a shape, so any object is found that moves far enough.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

from .voxel_planes import cell_keys, smallest_by_cell

_CELL_M = 0.15  # edge length of the cells that are linked
_LINK_M = 0.7  # maximum distance between cells of points that moved in a cluster
_SURFACE_M = 0.4  # maximum distance between other cells of a cluster
_CONNECTED_M = 4.0  # maximum distance of these cells from the points that moved
_HEIGHT_M = 2.0  # maximum height of these cells above the points that moved
_BOTTOM_M = 0.1  # Points closer to the lowest point that moved may be on the ground.
_MIN_MOVED = 0.15  # minimum share of points that moved among connected points
_GROUND_CELL_M = 1.0  # edge length of the cells in which the lowest points are sought
_GROUND_M = 0.25  # maximum height of points on the ground above the lowest points
_MIN_POINTS = 5
_MAX_SIZE_M = 20.0  # Larger clusters are not single objects.
_MAX_MISSING = 5.5  # maximum time between two observations, in sweeps
_MAX_SPEED_M_S = 40.0
_GATE_M = 1.5  # maximum distance from the predicted position, as a constant and per second
_GATE_M_S = 2.0
_FIRST_GATE_M = 0.6  # maximum cost of the second observation of an object
_SPEED_COST = 0.25  # cost of the distance to the second observation
_SIZE_COST = 0.1  # cost of a change of the bounding box
_FITTED = 4  # observations that determine the velocity
MIN_SWEEPS = 4
MIN_PATH_M = 1.0  # Objects that move less count as stationary.
_MIN_STRAIGHTNESS = 0.6  # minimum ratio of the distance to the length of the path
_IMPOSSIBLE = 1e3


class PointCluster(NamedTuple):
    """Axis-aligned bounding box of a cluster of points."""

    low: Floats  # (3,), meters, world frame
    high: Floats  # (3,), meters, world frame
    points: int  # number of points

    @property
    def center(self) -> Floats:
        """Center of the box."""
        return np.asarray((self.low + self.high) / 2)

    def offset_from(self, other: PointCluster) -> Floats:
        """Return the displacement from another cluster of the same object. Shape (3,).

        Different parts of the object may be visible, so the corner of the boxes that moved least is
        used, or their center.
        """
        offsets = np.stack(
            [self.center - other.center, self.low - other.low, self.high - other.high]
        )
        return np.asarray(offsets[np.hypot(offsets[:, 0], offsets[:, 1]).argmin()])

    def distance_m(self, other: PointCluster) -> float:
        """Return the horizontal distance between the centers of two boxes."""
        return float(np.hypot(*(self.center - other.center)[:2]))


def find_clusters(points: Floats, moved: Bools) -> Ints:
    """Assign points to clusters of points that moved, and of other points connected to them.

    The middle of a long vehicle does not appear to move, because other parts of the vehicle were at
    the same position shortly before and after. Points that connect parts that moved therefore
    belong to their cluster.

    Parameters
    ----------
    points
        Points of a sweep in the world frame, of shape (n, 3), in meters.
    moved
        Whether rays of other sweeps passed through the points. Shape (n,).

    Returns
    -------
    Index of the cluster of each point, or -1. Shape (n,).
    """
    found = np.full(len(points), -1)
    rows = np.flatnonzero(moved)
    rows = rows[~_are_on_ground(points[rows], points[~moved])]
    if len(rows) < _MIN_POINTS:
        return found
    seeds = _components(points[rows], _LINK_M)
    for seed in np.flatnonzero(np.bincount(seeds) >= _MIN_POINTS).tolist():
        members = rows[seeds == seed]
        if np.ptp(points[members, :2], axis=0).max() > _MAX_SIZE_M:
            continue
        connected = _connected(points, moved, members)
        known = np.unique(found[np.union1d(members, connected)])
        number = known[known >= 0].min(initial=found.max() + 1)
        found[np.isin(found, known[known >= 0])] = number  # parts of the same vehicle
        found[members] = number
        found[connected] = number
    return found


def _are_on_ground(points: Floats, still: Floats) -> Bools:
    """Mark the points that are at most `_GROUND_M` above the lowest stationary points nearby.

    Rays at a small angle to the ground seem to pass through points on it. `still` are the
    stationary points. All points are in the world frame.
    """
    if not len(points) or not len(still):
        return np.zeros(len(points), bool)
    around_m = np.full(len(points), np.inf)
    level = np.array([1.0, 1.0, 0.0])
    cells, lowest_m = smallest_by_cell(cell_keys(level * still, _GROUND_CELL_M), still[:, 2])
    for along, across in product((-1, 0, 1), repeat=2):
        beside = level * points + _GROUND_CELL_M * np.array([along, across, 0])
        keys = cell_keys(beside, _GROUND_CELL_M)
        row = np.searchsorted(cells, keys).clip(max=len(cells) - 1)
        is_known = cells[row] == keys
        around_m[is_known] = np.minimum(around_m, lowest_m[row])[is_known]
    return np.asarray(points[:, 2] < around_m + _GROUND_M)


def _connected(points: Floats, moved: Bools, members: Ints) -> Ints:
    """Return the points that are connected to the members of a cluster.

    If only few of the connected points moved, for example on a wall, they are not used.
    """
    margin = np.array([_CONNECTED_M, _CONNECTED_M, 0.0])
    low = points[members].min(axis=0) - margin + (0.0, 0.0, _BOTTOM_M)
    high = points[members].max(axis=0) + margin + (0.0, 0.0, _HEIGHT_M)
    near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
    near = np.union1d(near, members)
    component = _components(points[near], _SURFACE_M)
    sizes = np.bincount(component)
    flagged = np.bincount(component, moved[near], len(sizes))
    seeded = np.bincount(component, np.isin(near, members), len(sizes))
    kept = (seeded > 0) & (flagged > _MIN_MOVED * sizes)
    return np.asarray(near[kept[component]])


def _components(points: Floats, link_m: float) -> Ints:
    """Return the index of the connected component of each point, in the horizontal plane."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    cells, cell = np.unique(
        np.floor(points[:, :2] / _CELL_M).astype(np.int64), axis=0, return_inverse=True
    )
    pairs = cKDTree(cells * _CELL_M).query_pairs(link_m, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cells),) * 2)
    _, component = connected_components(links, directed=False)
    return np.asarray(component[cell.ravel()])


def bounding_boxes(points: Floats, cluster: Ints) -> dict[int, PointCluster]:
    """Return the bounding box of each cluster, keyed by its index."""
    rows = np.flatnonzero(cluster >= 0)
    rows = rows[np.argsort(cluster[rows], kind="stable")]
    groups = np.split(rows, np.flatnonzero(np.diff(cluster[rows])) + 1) if len(rows) else []
    return {
        int(cluster[group[0]]): PointCluster(
            points[group].min(axis=0), points[group].max(axis=0), len(group)
        )
        for group in groups
    }


@dataclass(eq=False)
class ClusterTrack:
    """Clusters of an object in several sweeps."""

    sweeps: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    clusters: list[PointCluster] = field(default_factory=list)
    indices: list[int] = field(default_factory=list)  # indices of the clusters in their sweeps
    _path: list[Floats] = field(default_factory=list)

    def append(self, sweep: int, time_s: float, cluster: PointCluster, index: int) -> None:
        """Add the cluster of the object in a later sweep."""
        position = cluster.center
        if self.clusters:
            position = self._path[-1] + cluster.offset_from(self.clusters[-1])
        self._path.append(position)
        self.sweeps.append(sweep)
        self.times_s.append(time_s)
        self.clusters.append(cluster)
        self.indices.append(index)

    @property
    def points(self) -> int:
        """Number of points of all clusters."""
        return sum(cluster.points for cluster in self.clusters)

    @property
    def is_moving(self) -> bool:
        """Whether the object moved far enough, and consistently."""
        if len(self.clusters) < MIN_SWEEPS:
            return False
        path = self.path[:, :2]
        distance_m = np.hypot(*(path[-1] - path[0]))
        length_m = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        return bool(distance_m > MIN_PATH_M and distance_m > _MIN_STRAIGHTNESS * length_m)

    @property
    def path(self) -> Floats:
        """Positions of a point of the object in meters. Shape (k, 3)."""
        return np.array(self._path)

    def cost(self, time_s: float, cluster: PointCluster) -> float:
        """Return the cost of a further observation, which is high if it is implausible."""
        last = self.clusters[-1]
        step_s = time_s - self.times_s[-1]
        growth_m = np.abs((cluster.high - cluster.low) - (last.high - last.low)).sum()
        cost = _SIZE_COST * growth_m
        offset = cluster.offset_from(last)[:2]
        if len(self.clusters) == 1:
            cost += _SPEED_COST * np.hypot(*offset)
            limit = _SPEED_COST * _MAX_SPEED_M_S * step_s + _FIRST_GATE_M
        else:
            recent = np.array(self._path[-_FITTED:])[:, :2]
            velocity = (recent[-1] - recent[0]) / (self.times_s[-1] - self.times_s[-len(recent)])
            cost += np.hypot(*(offset - velocity * step_s))
            limit = _GATE_M + _GATE_M_S * step_s
        return float(cost) if cost < limit else _IMPOSSIBLE


def track_clusters(
    observed: Sequence[tuple[int, float, Mapping[int, PointCluster]]], sweep_s: float
) -> list[ClusterTrack]:
    """Associate clusters over time, and return the tracks of objects that move.

    Parameters
    ----------
    observed
        Number, time in seconds and clusters of each sweep, in ascending order. The clusters are
        keyed by their index.
    sweep_s
        Typical time between sweeps in seconds.
    """
    from scipy.optimize import linear_sum_assignment

    active: list[ClusterTrack] = []
    ended: list[ClusterTrack] = []
    for number, time_s, clusters in observed:
        is_old = [time_s - track.times_s[-1] > _MAX_MISSING * sweep_s for track in active]
        ended += [track for track, old in zip(active, is_old, strict=True) if old]
        active = [track for track, old in zip(active, is_old, strict=True) if not old]
        costs = np.array(
            [[track.cost(time_s, one) for one in clusters.values()] for track in active]
        )
        pairs = {}
        if costs.size:
            rows, columns = linear_sum_assignment(costs)
            pairs = {
                column: active[row]
                for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
                if costs[row, column] < _IMPOSSIBLE
            }
        for column, (index, cluster) in enumerate(clusters.items()):
            track = pairs.get(column)
            if track is None:
                track = ClusterTrack()
                active.append(track)
            track.append(number, time_s, cluster, index)
    return [track for track in [*ended, *active] if track.is_moving]
