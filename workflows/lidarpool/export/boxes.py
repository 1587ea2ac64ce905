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
    scans if the cloud has no times or a fault shifts some, or at the sweep's start if it has no
    point. An actor that deforms has the box, in the actor's axes, that contains its shapes from the
    start of the sweep to its end.
    """

    centres: Floats  # (a, 3): metres, world coordinates, or the sensor frame after `inward`
    quaternions: Floats  # (a, 4): x, y, z, w of the rotation from the actor's axes to that frame
    sizes: Floats  # (a, 3): length, width and height, metres, along the actor's axes
    points: Ints  # (a,): number of points of the sweep that belong to the actor
    present: Bools  # (a,): True if the actor is in the scene

    @classmethod
    def from_points(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> Boxes:
        """Return the boxes of a sweep with its points."""
        count = len(sweeps.actors)
        actor = points["object"].astype(np.int64) - len(sweeps.objects)
        rows = np.flatnonzero(actor >= 0)
        counts = np.bincount(actor[rows], minlength=count)
        sums = np.bincount(actor[rows], _time_shares(sweeps, sweep, points, rows), count)
        position, quaternion = _actor_poses(sweeps, sweep, sums / np.maximum(counts, 1))
        lower, upper = sweeps.bounds(sweep).transpose(1, 0, 2)
        centre = (matrices(quaternion) @ ((lower + upper) / 2)[..., None])[..., 0]
        present = sweeps.actor_there[:, sweep] | (counts > 0)
        return cls(position + centre, quaternion, upper - lower, counts, present)

    def inward(self, pose: SweepPoses, index: int | slice) -> Boxes:
        """Return boxes of a sweep or several, (n, a), in the sensor frame at the start of each."""
        quaternions = self.quaternions @ pose.quaternion_matrices[index]
        quaternions *= np.where(quaternions[..., 3:] < 0, -1, 1)  # w is at least 0
        centres = (self.centres - pose.positions[index][..., None, :]) @ pose.rotations[index]
        return Boxes(centres, quaternions, self.sizes, self.points, self.present)


def _time_shares(sweeps: Sweeps, sweep: int, points: Cloud, rows: Ints) -> Floats:
    """Return the times of points as shares of a sweep's duration, (n,), 0 to 1."""
    if "time" in points.columns and not any(fault.by_s for fault in sweeps.faults):
        start_ns = sweeps.begins_ns[sweep]
        stop_ns = sweeps.ends_ns[sweep]
        return np.asarray((points["time"][rows] - start_ns) / max(stop_ns - start_ns, 1.0))
    first, stop = sweeps.scans[sweep : sweep + 2]
    return np.asarray((points["scan"][rows] + 0.5 - first) / (stop - first))


def _actor_poses(sweeps: Sweeps, sweep: int, shares: Floats) -> tuple[Floats, Floats]:
    """Return positions (a, 3) and quaternions (a, 4) of actors at shares (a,) of a sweep."""
    start_and_stop = [sweep, sweep + len(sweeps)]  # indices of the poses
    positions = sweeps.actor_poses.positions[:, start_and_stop]
    quaternions = sweeps.actor_poses.quaternions[:, start_and_stop]
    quaternions[(quaternions[:, 0] * quaternions[:, 1]).sum(axis=1) < 0, 1] *= -1
    weights = shares[:, None]
    position = positions[:, 0] + weights * (positions[:, 1] - positions[:, 0])
    quaternion = quaternions[:, 0] + weights * (quaternions[:, 1] - quaternions[:, 0])
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return position, quaternion


@dataclass(frozen=True, eq=False)
class SweepBoxes:
    """Boxes of the actors present during a sweep, k in number.

    Each is at its actor's pose at the mean time of its points, or at the start of the sweep without
    points.
    """

    names: tuple[str, ...]
    types: tuple[str, ...]  # "Car" of "Car 1"
    objects: Ints32  # (k,): numbers of the actors in the column `object`
    centres: Floats  # (k, 3): metres, sensor frame
    quaternions: (
        Floats  # (k, 4): x, y, z, w of the rotation from the box's axes to the sensor frame
    )
    sizes: Floats  # (k, 3): length, width and height, metres
    points: Ints  # (k,): number of points of the sweep that belong to the actor

    @classmethod
    def select(
        cls, sweeps: Sweeps, boxes: Boxes | None, index: int | EllipsisType = ...
    ) -> SweepBoxes:
        """Return the boxes of the actors present during a sweep, in the sensor frame.

        `boxes` are of a sweep, or of several with the `index` of a sweep; None gives no boxes.
        """
        rows = np.empty(0, np.intp) if boxes is None else boxes.present[index].nonzero()[0]
        if boxes is None or not len(rows):
            vectors = np.empty((0, 3))
            return cls(
                names=(),
                types=(),
                objects=np.empty(0, np.int32),
                centres=vectors,
                quaternions=np.empty((0, 4)),
                sizes=vectors,
                points=np.empty(0, np.int64),
            )
        actors = rows.tolist()
        return cls(
            tuple(sweeps.actors[actor] for actor in actors),
            tuple(sweeps.actor_types[actor] for actor in actors),
            (len(sweeps.objects) + rows).astype(np.int32),
            boxes.centres[index][rows],
            boxes.quaternions[index][rows],
            boxes.sizes[index][rows],
            boxes.points[index][rows],
        )

    def __len__(self) -> int:
        return len(self.names)

    @property
    def yaw(self) -> Floats:
        """Angles about the sensor's z axis, from x to y, float64 (k,), radians."""
        rotations = matrices(self.quaternions)
        angles: Floats = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
        return angles

    @property
    def rows(self) -> Floats32:
        """Centre, length, width, height and yaw, float32 (k, 7)."""
        return np.column_stack([self.centres, self.sizes, self.yaw]).astype(np.float32)
