"""Rays that end on moving objects or pass close to them, from which the objects are reconstructed.

Rays that pass an object belong to its reconstruction, because they limit its silhouette. An object
that starts or stops is not recognized as moving while it is stationary. Rays through its position
are therefore also collected from the sweeps before it starts and after it stops.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Bytes, Floats, Ints

from .alignment import AlignedSweep, AlignedSweeps
from .object_clusters import PointCluster, bounding_boxes, find_clusters
from .object_tracks import ObjectTrack

_MARGIN_M = (0.5, 0.5, 0.3)  # margin around a cluster, within which rays are collected
_SAME_M = 2.0  # maximum distance between clusters of an object in consecutive sweeps
_BEYOND_SWEEPS = 15  # sweeps before an object starts or after it stops
_MAX_RAYS = 3000  # maximum number of rays per object and sweep
_SWEEP_S = 0.1  # typical duration of a sweep, in which a labeled object moves
_LASER_M = 1.0  # maximum distance of a laser from the mean position of all lasers
_MIN_DISTANCE = 1.5  # Boxes that are closer, in multiples of their radius, surround the sensor.
_TURN = 2 * np.pi
_BEHIND_M = 0.1  # A ray that ends this close to the front of a box belongs to it.


class MovingRays(NamedTuple):
    """Rays near moving objects in the world frame, as arrays of n rays."""

    sweep: Ints  # (n,), sweep numbers in ascending order
    time_s: Floats  # (n,), firing times, seconds
    origins: Floats  # (n, 3), positions of the lasers, meters
    ends: Floats  # (n, 3), returns, or points one meter from the lasers for lost pulses
    returned: Bools  # (n,), whether the pulse returned
    moved: Bools  # (n,), whether rays of other sweeps passed through the return
    ring: Ints  # (n,)
    intensity: Floats  # (n,), NaN if unknown
    label: Ints  # (n,), class and object, 0 if unknown
    cluster: Ints  # (n,), index of the cluster of points that moved in the sweep, or -1

    @classmethod
    def concatenate(cls, parts: Sequence[MovingRays]) -> MovingRays:
        """Concatenate rays of consecutive sweeps."""
        columns: list[Any] = [*map(np.concatenate, zip(*parts, strict=True))]
        return cls(*columns)

    @classmethod
    def from_sweep(
        cls, number: int, pulses: TimedPulses, moved: Bools, cluster: Ints, chosen: Bools
    ) -> MovingRays:
        """Select rays of a sweep. `chosen` refers to the returns, followed by the lost pulses.

        `moved` and `cluster` refer to the returns.
        """
        rows = np.flatnonzero(chosen)
        returns, lost = pulses.returns, pulses.lost
        count = len(returns.world)
        unknown = np.full(len(lost.world), np.nan)
        known = np.full(count, np.nan) if returns.intensities is None else returns.intensities
        labels = np.zeros(count, np.int64) if returns.labels is None else returns.labels
        return cls(
            np.full(len(rows), number),
            pulses.times_s[rows],
            pulses.origins[rows],
            pulses.ends[rows],
            rows < count,
            np.append(moved, np.zeros(len(lost.world), bool))[rows],
            np.concatenate([returns.ring, lost.ring])[rows],
            np.concatenate([known, unknown])[rows],
            np.append(labels, np.zeros(len(lost.world), np.int64))[rows],
            np.append(cluster, np.full(len(lost.world), -1))[rows],
        )

    def select(self, rays: Bools | Ints | slice) -> MovingRays:
        """Select rays with a mask, indices or a slice."""
        columns: list[Any] = [values[rays] for values in self]
        return MovingRays(*columns)

    def slices(self) -> dict[int, slice]:
        """Return the rows of each sweep, keyed by sweep number."""
        numbers, starts = np.unique(self.sweep, return_index=True)
        stops = np.append(starts, len(self.sweep))[1:]
        bounds = zip(numbers.tolist(), starts.tolist(), stops.tolist(), strict=True)
        return {number: slice(start, stop) for number, start, stop in bounds}


class SweepMasks(NamedTuple):
    """Masks of the points of k sweeps, with one bit per point."""

    numbers: Ints  # (k,), sweep numbers
    counts: Ints  # (k,), points in each sweep
    bits: Bytes  # packed masks, one after the other

    @classmethod
    def from_masks(cls, masks: Mapping[int, Bools]) -> SweepMasks:
        """Pack the masks, which are keyed by sweep number."""
        counts = np.array([len(mask) for mask in masks.values()], np.int64)
        bits = np.packbits(np.concatenate([np.empty(0, bool), *masks.values()]))
        return cls(np.array([*masks], np.int64), counts, bits)

    def masks(self) -> dict[int, Bools]:
        """Return the masks, keyed by sweep number."""
        joined = np.unpackbits(self.bits, count=int(self.counts.sum())).astype(bool)
        parts = np.split(joined, np.cumsum(self.counts))[:-1]
        return dict(zip(self.numbers.tolist(), parts, strict=True))


class TimedPulses(NamedTuple):
    """Returns and lost pulses of a sweep, with their firing times."""

    returns: AlignedSweep
    lost: AlignedSweep
    times_s: Floats  # (n,), of the returns, followed by the lost pulses

    @classmethod
    def read(cls, sweeps: AlignedSweeps, number: int) -> TimedPulses:
        """Read a sweep. Without known times, all pulses have the timestamp of the sweep."""
        returns, lost = sweeps.read_with_lost(number)
        return cls(returns, lost, pulse_times_s(sweeps, number, returns, lost))

    @property
    def origins(self) -> Floats:
        """Positions of the lasers in the world frame, of shape (n, 3)."""
        return np.concatenate([self.returns.origins, self.lost.origins])

    @property
    def ends(self) -> Floats:
        """Ends of the rays in the world frame, of shape (n, 3)."""
        return np.concatenate([self.returns.world, self.lost.world])


def return_times_s(sweeps: AlignedSweeps, number: int) -> Floats:
    """Return the firing times of the returns of a sweep in seconds.

    The times are on the clock of the timestamps. If they are unknown, they are the timestamp of the
    sweep.
    """
    alignment = sweeps.alignment
    sweep = sweeps.recorded.read(number)
    times_s = alignment.motion.times_s(sweep, alignment.sweep_s)
    for name in ("time_s", "fired_s"):  # of motion-compensated points
        times_s = sweep.columns.get(name) if times_s is None else times_s
    return float(alignment.times_s[number]) + (np.zeros(len(sweep)) if times_s is None else times_s)


def pulse_times_s(
    sweeps: AlignedSweeps, number: int, returns: AlignedSweep, lost: AlignedSweep
) -> Floats:
    """Return the firing times of the returns and of the lost pulses of a sweep, in seconds.

    The times are on the clock of the timestamps. A lost pulse has the time of the return with the
    closest azimuth.
    """
    times_s = return_times_s(sweeps, number)
    if not len(times_s):
        return np.full(len(lost.world), float(sweeps.alignment.times_s[number]))
    rotation = sweeps.alignment.poses[number][:3, :3]
    azimuths = []
    for part in (returns, lost):
        directions = (part.world - part.origins) @ rotation
        azimuths.append(np.arctan2(directions[:, 1], directions[:, 0]))
    order = np.argsort(azimuths[0])
    nearest = np.searchsorted(azimuths[0][order], azimuths[1]).clip(max=len(order) - 1)
    return np.append(times_s, times_s[order[nearest]])


def collect_moving_rays(
    sweeps: AlignedSweeps,
    stationary: Mapping[int, Bools],
    numbers: Sequence[int],
    labeled: Sequence[ObjectTrack],
) -> MovingRays:
    """Collect the rays near moving objects.

    Parameters
    ----------
    sweeps
        All sweeps.
    stationary
        Masks of the stationary points, by sweep number.
    numbers
        Numbers of those sweeps whose rays are collected, in ascending order.
    labeled
        Boxes of moving objects that are known from the recording.
    """
    members = {}
    clusters = {}
    for number, mask in stationary.items():
        world = sweeps.read(number).world
        members[number] = find_clusters(world, ~mask)
        clusters[number] = [*bounding_boxes(world, members[number]).values()]
    parts = []
    for number in numbers:
        pulses = TimedPulses.read(sweeps, number)
        moved = ~stationary[number]
        boxes = [*clusters[number], *_beyond(clusters, number)]
        boxes += _labeled_boxes(labeled, float(sweeps.alignment.times_s[number]))
        chosen = _rays_near(boxes, pulses.origins, pulses.ends, members[number])
        parts.append(MovingRays.from_sweep(number, pulses, moved, members[number], chosen))
    return MovingRays.concatenate(parts)


def _beyond(clusters: Mapping[int, Sequence[PointCluster]], number: int) -> list[PointCluster]:
    """Return the clusters of objects that start moving after a sweep, or stopped before it."""
    order = sorted(clusters)
    index = order.index(number)
    found = []
    for step in (1, -1):
        for distance in range(1, _BEYOND_SWEEPS + 1):
            if not 0 <= index + step * distance < len(order):
                break
            nearer = clusters[order[index + step * (distance - 1)]]
            found += [
                one
                for one in clusters[order[index + step * distance]]
                if not any(one.distance_m(other) < _SAME_M for other in nearer)
            ]
    return found


def _labeled_boxes(labeled: Sequence[ObjectTrack], time_s: float) -> list[PointCluster]:
    """Return the bounding boxes of labeled objects, in axes of the world."""
    found = []
    times_s = np.array([time_s])
    for track in labeled:
        if not track.is_present(times_s)[0]:
            continue
        (position,), _ = track.poses(times_s)
        radius_m = float(np.hypot(*track.size[:2])) / 2
        speed_m = track.speed_m_s(time_s) * _SWEEP_S
        reach = np.array([radius_m + speed_m, radius_m + speed_m, 0.0])
        found.append(
            PointCluster(position - reach, position + reach + (0, 0, float(track.size[2])), 0)
        )
    return found


def _rays_near(
    boxes: Sequence[PointCluster], origins: Floats, ends: Floats, cluster: Ints
) -> Bools:
    """Mark the rays that end in a box or pass through it.

    `cluster` has the clusters of the returns, which precede the lost pulses.
    """
    chosen = np.zeros(len(ends), bool)
    if not boxes or not len(ends):
        return chosen
    vectors = ends - origins
    range_m = np.linalg.norm(vectors, axis=1)
    directions = vectors / np.maximum(range_m, 1e-9)[:, None]
    range_m[len(cluster) :] = np.inf
    in_cluster = np.append(cluster >= 0, np.zeros(len(ends) - len(cluster), bool))
    sorted_rays = _SortedRays.from_rays(origins, directions)
    for box in boxes:
        low, high = box.low - _MARGIN_M, box.high + _MARGIN_M
        rows = sorted_rays.rows_toward(low, high)
        enter_m, leave_m = box_distances(low, high, origins[rows], directions[rows])
        rows = rows[(leave_m >= np.maximum(enter_m, 0)) & (range_m[rows] > enter_m - _BEHIND_M)]
        if len(rows) > _MAX_RAYS:
            stride = -(-len(rows) // _MAX_RAYS)
            members = np.flatnonzero(in_cluster[rows])
            rows = rows[np.union1d(np.arange(0, len(rows), stride), members[::stride])]
        chosen[rows] = True
    return chosen


class _SortedRays(NamedTuple):
    """Rays of a sweep, sorted by azimuth."""

    center: Floats  # (3,), mean position of the lasers, meters
    order: Ints  # (n,), original indices of the rays
    azimuth: Floats  # (n,), radians, ascending
    directions: Floats  # (n, 3)

    @classmethod
    def from_rays(cls, origins: Floats, directions: Floats) -> _SortedRays:
        """Sort rays by azimuth."""
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        order = np.argsort(azimuth)
        return cls(origins.mean(axis=0), order, azimuth[order], directions[order])

    def rows_toward(self, low: Floats, high: Floats) -> Ints:
        """Return the original indices of the rays that may pass through a box, in ascending order.

        The box is given by two corners.
        """
        toward = (low + high) / 2 - self.center
        distance_m = float(np.linalg.norm(toward))
        level_m = float(np.hypot(toward[0], toward[1]))
        radius_m = float(np.linalg.norm(high - low)) / 2 + _LASER_M
        if level_m < _MIN_DISTANCE * radius_m:
            return np.arange(len(self.order))
        middle = float(np.arctan2(toward[1], toward[0]))
        half = float(np.arcsin(radius_m / level_m))
        cosine = np.sqrt(1 - (radius_m / distance_m) ** 2)
        found = []
        for turn in (-_TURN, 0, _TURN):  # The sector of the box may extend beyond -pi or pi.
            bounds = middle - half + turn, middle + half + turn
            sector = slice(*np.searchsorted(self.azimuth, bounds))
            near = self.directions[sector] @ (toward / distance_m) > cosine
            found.append(self.order[sector][near])
        return np.sort(np.concatenate(found))


def box_distances(
    low: Floats, high: Floats, origins: Floats, directions: Floats
) -> tuple[Floats, Floats]:
    """Return the distances at which rays enter and leave a box.

    They are multiples of the lengths of the directions. A ray passes the box if it enters it before
    it leaves it. The box is given by two corners, and the rays by arrays of shape (n, 3).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (low - origins) / directions
        second = (high - origins) / directions
    return np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
