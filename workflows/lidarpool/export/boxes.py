"""Boxes of actors in single sweeps, for labels of data sets and markers."""

from __future__ import annotations

from dataclasses import dataclass
from types import EllipsisType

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Floats32, Ints, Ints32
from lidarsim.columns.cloud import Cloud
from lidarsim.sensor.trajectory import matrices
from lidarsim.sweeps.sweeps import SweepPoses, Sweeps


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of all actors in a sweep, at the time of their points.

    An actor moves during a sweep. Its box is at its pose at the mean time of its points, by their
    scans if the cloud has no times or a fault shifts some, or at the sweep's start if it has none.
    One that deforms has the box that holds it, in its own axes, from the start of the sweep to its
    end.
    """

    centres: Floats  # (a, 3): metres, world coordinates, or the sensor's after `inward`
    quaternions: Floats  # (a, 4): x, y, z, w of the rotation from the actor's axes to those
    sizes: Floats  # (a, 3): length, width and height, metres, along the actor's axes
    points: Ints  # (a,): how many points of the sweep are the actor's
    there: Bools  # (a,): whether it is in the scene

    @classmethod
    def of(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> Boxes:
        """Return the boxes of a sweep, whose points are given."""
        count = len(sweeps.actors)
        actor = points["object"].astype(np.int64) - len(sweeps.objects)
        rows = np.flatnonzero(actor >= 0)
        counts = np.bincount(actor[rows], minlength=count)
        begin = sweeps.begins_ns[sweep]
        end = sweeps.ends_ns[sweep]
        if "time" in points.columns and not any(fault.by_s for fault in sweeps.faults):
            share = (points["time"][rows] - begin) / max(end - begin, 1.0)
        else:
            first, stop = sweeps.scans[sweep : sweep + 2]
            share = (points["scan"][rows] + 0.5 - first) / (stop - first)
        share = (np.bincount(actor[rows], share, count) / np.maximum(counts, 1))[:, None]
        pair = [sweep, sweep + len(sweeps)]  # poses at its start and end
        places, turns = (
            of[:, pair] for of in (sweeps.actor_poses.positions, sweeps.actor_poses.quaternions)
        )
        turns[(turns[:, 0] * turns[:, 1]).sum(axis=1) < 0, 1] *= -1
        place, turn = ((p[:, 0] + share * (p[:, 1] - p[:, 0])) for p in (places, turns))
        turn /= np.linalg.norm(turn, axis=1, keepdims=True)
        low, high = sweeps.bounds(sweep).transpose(1, 0, 2)
        middle = (matrices(turn) @ ((low + high) / 2)[..., None])[..., 0]
        return cls(
            place + middle, turn, high - low, counts, sweeps.actor_there[:, sweep] | (counts > 0)
        )

    def inward(self, pose: SweepPoses, which: int | slice) -> Boxes:
        """Return boxes of a sweep, or of some, (n, a), in axes of the sensor as each begins."""
        turned = self.quaternions @ pose.quaternion_matrices[which]
        turned *= np.where(turned[..., 3:] < 0, -1, 1)  # w is at least 0
        centres = (self.centres - pose.positions[which][..., None, :]) @ pose.rotations[which]
        return Boxes(centres, turned, self.sizes, self.points, self.there)


@dataclass(frozen=True, eq=False)
class SweepBoxes:
    """Boxes of the actors that are in the scene during a sweep, (k) of them.

    Each is at its pose at the mean time of its points, or at the start of the sweep if it has none.
    """

    names: tuple[str, ...]
    types: tuple[str, ...]  # "Car" of "Car 1"
    objects: Ints32  # (k,): their numbers in the column `object`
    centres: Floats  # (k, 3): metres, in the sensor's axes
    quaternions: Floats  # (k, 4): x, y, z, w of the rotation from the box's axes to the sensor's
    sizes: Floats  # (k, 3): length, width and height, metres
    points: Ints  # (k,): how many points of the sweep are the actor's

    @classmethod
    def of(cls, sweeps: Sweeps, boxes: Boxes | None, which: int | EllipsisType = ...) -> SweepBoxes:
        """Take those of a sweep, or of which of some, that are in the scene; in a sensor's axes."""
        there = np.empty(0, np.intp) if boxes is None else boxes.there[which].nonzero()[0]
        if boxes is None or not len(there):
            none = np.empty(0, np.int32)
            place = np.empty((0, 3))
            return cls((), (), none, place, np.empty((0, 4)), place, none.astype(np.int64))
        actors = there.tolist()
        return cls(
            tuple(sweeps.actors[actor] for actor in actors),
            tuple(sweeps.actor_types[actor] for actor in actors),
            (len(sweeps.objects) + there).astype(np.int32),
            boxes.centres[which][there],
            boxes.quaternions[which][there],
            boxes.sizes[which][there],
            boxes.points[which][there],
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def yaw(self) -> Floats:
        """float64 (k,): angles in radians about the sensor's z axis, from x to y."""
        turns = matrices(self.quaternions)
        angles: Floats = np.arctan2(turns[:, 1, 0], turns[:, 0, 0])
        return angles

    @property
    def rows(self) -> Floats32:
        """float32 (k, 7): centre, length, width, height, yaw."""
        return np.column_stack([self.centres, self.sizes, self.yaw]).astype(np.float32)
