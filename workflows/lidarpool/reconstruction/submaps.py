"""Stretches of a drive: a place is rebuilt submap by submap, so its memory is that of a submap.

A submap has consecutive sweeps of its own, and looks at sweeps before and after, which see the
same surfaces. A surface belongs to the submap whose sensor came nearest. So submaps depend on
nothing but the drive, and any number of processes makes the same place.

A sensor that stands sees the same again and again: of the sweeps within a meter some count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.numerics.even_samples import even_indices

from .alignment import Alignment
from .motion import MotionStep

_OWN_SWEEPS = 80  # of a submap, about
_AROUND_SWEEPS = 40  # before and after, at most
_AROUND_M = 40.0
_METER_M = 1.0  # length of the drive of which all or no sweeps belong to a submap
_METER_SWEEPS = 80  # of a meter that count


@dataclass(frozen=True, eq=False)
class Submap:
    """Sweeps of a part of a drive, and of those around.

    Attributes
    ----------
    numbers
        int64 (k,): sweeps, with those around, ascending.
    own
        Which of the `numbers` are of the submap itself.
    landmarks
        int64 (p,): those of the `numbers` that are the first of their meter.
    """

    numbers: Ints
    own: slice
    landmarks: Ints

    @property
    def own_numbers(self) -> Ints:
        """Numbers (k,) of the sweeps of the submap itself, ascending."""
        return self.numbers[self.own]

    def owns(self, points: Floats, poses: Floats) -> Bools:
        """Return which points (n, 3) belong to the submap, at poses (s, 4, 4) of all sweeps."""
        from scipy.spatial import cKDTree

        own = self.own_numbers
        is_own = (self.landmarks >= own[0]) & (self.landmarks <= own[-1])
        _, nearest = cKDTree(poses[self.landmarks, :3, 3]).query(points)
        return np.asarray(is_own[nearest])


def split_into_submaps(positions: Floats) -> list[Submap]:
    """Divide a drive with positions (s, 3) of its sweeps into submaps."""
    meters = _meters(positions)
    counts = np.array([len(meter) for meter in meters])
    before = np.cumsum(counts) - counts
    submap_count = max(1, round(int(counts.sum()) / _OWN_SWEEPS))
    of_meter = before * submap_count // int(counts.sum())
    starts = np.flatnonzero(np.diff(of_meter, prepend=-1)).tolist()
    submaps = []
    for start, stop in zip(starts, [*starts[1:], len(meters)], strict=True):
        first = _reach(meters, positions, range(start - 1, -1, -1), meters[start][0])
        last = _reach(meters, positions, range(stop, len(meters)), meters[stop - 1][-1])
        lead = int(counts[start - first : start].sum())
        submaps.append(
            Submap(
                np.concatenate(meters[start - first : stop + last]),
                slice(lead, lead + int(counts[start:stop].sum())),
                np.array([meter[0] for meter in meters[start - first : stop + last]]),
            )
        )
    return submaps


def _meters(positions: Floats) -> list[Ints]:
    """Return the sweeps that count of each meter of a drive."""
    starts = [0]
    for number, position in enumerate(positions):
        if np.linalg.norm(position - positions[starts[-1]]) >= _METER_M:
            starts.append(number)
    stops = [*starts[1:], len(positions)]
    return [
        start + even_indices(stop - start, _METER_SWEEPS)
        for start, stop in zip(starts, stops, strict=True)
    ]


def _reach(meters: Sequence[Ints], positions: Floats, beyond: range, end: int) -> int:
    """Return how many meters `beyond` the end of a submap see the same surfaces."""
    count = 0
    sweeps = 0
    for meter in beyond:
        sweeps += len(meters[meter])
        distance_m = np.linalg.norm(positions[meters[meter][0]] - positions[end])
        if sweeps > _AROUND_SWEEPS or distance_m > _AROUND_M:
            break
        count += 1
    return count


class AlignedSubmap(NamedTuple):
    """Alignment of the k sweeps of a submap, with those around, as of `Alignment`."""

    poses: Floats  # (k, 4, 4)
    ring_offsets: Floats  # (r, 3)
    thickness_m: Floats  # (rounds,)
    plane_distance_m: Floats  # (k,)

    @classmethod
    def from_alignment(cls, alignment: Alignment) -> AlignedSubmap:
        """Return what is known of a submap that was aligned."""
        return cls(
            alignment.poses,
            alignment.ring_offsets,
            np.array(alignment.thickness_m),
            alignment.plane_distance_m,
        )


def merge_alignments(
    first: Alignment, submaps: Sequence[Submap], aligned: Sequence[AlignedSubmap]
) -> Alignment:
    """Join the alignments of submaps, each of its own sweeps and of those around.

    Where submaps overlap, a pose goes over from one to the other. Sweeps that do not count move
    with the nearest that does.

    Parameters
    ----------
    first
        Of all sweeps, before they were aligned.
    submaps
        All submaps, in order.
    aligned
        The same submaps, aligned.
    """
    count = len(first.poses)
    total = np.zeros(count)
    poses = first.poses.copy()
    twist = np.zeros((count, 6))  # weighted sums of the motions to poses of further submaps
    distance_m = np.full(count, np.nan)
    for submap, one in zip(submaps, aligned, strict=True):
        weights = _weights(len(submap.numbers), submap.own).tolist()
        for number, pose, weight in zip(submap.numbers.tolist(), one.poses, weights, strict=True):
            if total[number]:
                twist[number] += weight * np.concatenate(MotionStep.between(poses[number], pose))
            else:
                poses[number] = pose
            total[number] += weight
        distance_m[submap.own_numbers] = one.plane_distance_m[submap.own]
    for number in np.flatnonzero(twist.any(axis=1)).tolist():
        mean = twist[number] / total[number]
        poses[number] = poses[number] @ MotionStep(mean[:3], mean[3:]).fraction(1.0)
    counting = np.flatnonzero(total)
    for number in np.flatnonzero(total == 0).tolist():
        nearest = counting[np.abs(counting - number).argmin()]
        moved = np.linalg.inv(first.poses[nearest]) @ first.poses[number]
        poses[number] = poses[nearest] @ moved
    return replace(
        first,
        poses=poses,
        ring_offsets=np.mean([one.ring_offsets for one in aligned], axis=0),
        thickness_m=tuple(np.mean([one.thickness_m for one in aligned], axis=0).tolist()),
        plane_distance_m=distance_m,
    )


def _weights(count: int, own: slice) -> Floats:
    """Return the weights (count,) of the poses of a submap, which fall towards its ends.

    An end without sweeps around is an end of the drive.
    """
    index = np.arange(count)
    before = index + 1 if own.start else np.full(count, count)
    after = count - index if own.stop < count else np.full(count, count)
    return np.minimum(before, after) / count
