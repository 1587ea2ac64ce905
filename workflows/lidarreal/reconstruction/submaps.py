"""Divide a drive into submaps, so that only one submap must fit in memory at a time.

A submap consists of consecutive sweeps of its own, and of surrounding sweeps that observe the same
surfaces. A surface belongs to the submap whose sensor positions are closest to it. The division
depends only on the drive, so the number of processes does not affect the result.

A stationary sensor observes the same surfaces repeatedly, so only some sweeps within each meter are
used.
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

_OWN_SWEEPS = 80  # approximate number of sweeps of a submap
_AROUND_SWEEPS = 40  # maximum number of surrounding sweeps on each side
_AROUND_M = 40.0
_METER_M = 1.0  # length of a section of the drive that is never split between submaps
_METER_SWEEPS = 80  # maximum number of sweeps that are used per section


@dataclass(frozen=True, eq=False)
class Submap:
    """Sweeps of one section of a drive, and the surrounding sweeps.

    Attributes
    ----------
    numbers
        Numbers of the sweeps, including surrounding sweeps, in ascending order. int64 array of
        shape (k,).
    own
        Slice of `numbers` that belongs to the submap itself.
    landmarks
        Those of the `numbers` that are the first of their one-meter section. int64 array of shape
        (p,).
    """

    numbers: Ints
    own: slice
    landmarks: Ints

    @property
    def own_numbers(self) -> Ints:
        """Numbers of the sweeps that belong to the submap itself, in ascending order."""
        return self.numbers[self.own]

    def owns(self, points: Floats, poses: Floats) -> Bools:
        """Return a mask of the points that belong to the submap itself.

        The points have shape (n, 3). `poses` are those of all sweeps, of shape (s, 4, 4).
        """
        from scipy.spatial import cKDTree

        own = self.own_numbers
        is_own = (self.landmarks >= own[0]) & (self.landmarks <= own[-1])
        _, nearest = cKDTree(poses[self.landmarks, :3, 3]).query(points)
        return np.asarray(is_own[nearest])


def split_into_submaps(positions: Floats) -> list[Submap]:
    """Divide a drive into submaps, given the positions of its sweeps.

    The positions have shape (s, 3).
    """
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
    """Divide a drive into one-meter sections, and choose sweeps that represent each section."""
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
    """Return how many of the sections in `beyond` belong to the surroundings of a submap.

    These sections are close enough to contain the same surfaces as the end of the submap.
    """
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
    """Alignment of the k sweeps in a submap and its surroundings.

    The fields have the same meaning as in `Alignment`.
    """

    poses: Floats  # (k, 4, 4)
    ring_offsets: Floats  # (r, 3)
    thickness_m: Floats  # (rounds,)
    plane_distance_m: Floats  # (k,)

    @classmethod
    def from_alignment(cls, alignment: Alignment) -> AlignedSubmap:
        """Extract a submap's results from an alignment."""
        return cls(
            alignment.poses,
            alignment.ring_offsets,
            np.array(alignment.thickness_m),
            alignment.plane_distance_m,
        )


def merge_alignments(
    first: Alignment, submaps: Sequence[Submap], aligned: Sequence[AlignedSubmap]
) -> Alignment:
    """Merge the alignments of all submaps.

    Where submaps overlap, poses are blended from one submap to the next. Sweeps that no submap uses
    keep their initial pose relative to the nearest sweep that is used.

    Parameters
    ----------
    first
        Initial alignment of all sweeps.
    submaps
        All submaps in order.
    aligned
        The alignments of the submaps in the same order.
    """
    count = len(first.poses)
    total = np.zeros(count)
    poses = first.poses.copy()
    twist = np.zeros((count, 6))  # weighted sums of the motions to the poses of further submaps
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
    """Return the weights of a submap's poses, which decrease toward the ends of the submap.

    An end without surrounding sweeps is an end of the drive, where the weights do not decrease.
    """
    index = np.arange(count)
    before = index + 1 if own.start else np.full(count, count)
    after = count - index if own.stop < count else np.full(count, count)
    return np.minimum(before, after) / count
