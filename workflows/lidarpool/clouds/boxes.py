"""Boxes of actors in single sweeps, for labels of data sets and markers."""

from __future__ import annotations

from dataclasses import dataclass
from types import EllipsisType

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Floats32, Ints, Ints32
from lidarsim.base.vectors import matvec
from lidarsim.columns.cloud import Cloud
from lidarsim.motion.rotations import matrices
from lidarsim.sweeps.sweeps import SweepPoses, Sweeps


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of all actors in a sweep, at its start, which is the stamp of the sweep.

    Points are at their own times, so that they lie outside the box of an actor that moves. The size
    of a box is the same in all sweeps: the box of an actor that deforms contains all its poses, in
    the actor's axes. An actor that appears during the sweep has the box that it would have if it
    had come at the speed of its appearance. If a frozen sensor repeats points of an actor that
    has left, the box is missing.
    """

    centers: Floats  # (a, 3): meters, world coordinates, or the sensor frame after `inward`
    quaternions: Floats  # (a, 4): x, y, z, w of the rotation from the actor's axes to that frame
    sizes: Floats  # (a, 3): length, width and height, meters, along the actor's axes
    points: Ints  # (a,): number of points of the sweep that belong to the actor
    present: Bools  # (a,): True if the actor is in the scene, or appears later and has points

    @classmethod
    def from_points(cls, sweeps: Sweeps, sweep: int, points: Cloud) -> Boxes:
        """Return the boxes of a sweep with its points."""
        actor = points["object"].astype(np.int64) - len(sweeps.objects)
        counts = np.bincount(actor[actor >= 0], minlength=len(sweeps.actors))
        position = sweeps.actor_poses.positions[:, sweep]
        quaternion = sweeps.actor_poses.quaternions[:, sweep]
        lower, upper = sweeps.actor_bounds.transpose(1, 0, 2)
        middle = matvec(matrices(quaternion), (lower + upper) / 2)
        present = sweeps.actor_there[:, sweep] | (sweeps.actor_comes[:, sweep] & (counts > 0))
        return cls(position + middle, quaternion, upper - lower, counts, present)

    def inward(self, pose: SweepPoses, index: int | slice) -> Boxes:
        """Return boxes of a sweep or several, (n, a), in the sensor frame at the start of each."""
        quaternions = self.quaternions @ pose.quaternion_matrices[index]
        quaternions *= np.where(quaternions[..., 3:] < 0, -1, 1)  # w is at least 0
        centers = (self.centers - pose.positions[index][..., None, :]) @ pose.rotations[index]
        return Boxes(centers, quaternions, self.sizes, self.points, self.present)


@dataclass(frozen=True, eq=False)
class SweepBoxes:
    """Boxes of the actors present during a sweep, k in number, at its start, as in `Boxes`."""

    names: tuple[str, ...]
    types: tuple[str, ...]  # "Car" of "Car 1"
    objects: Ints32  # (k,): numbers of the actors in the column `object`
    centers: Floats  # (k, 3): meters, sensor frame
    quaternions: (
        Floats  # (k, 4): x, y, z, w of the rotation from the box's axes to the sensor frame
    )
    sizes: Floats  # (k, 3): length, width and height, meters
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
                centers=vectors,
                quaternions=np.empty((0, 4)),
                sizes=vectors,
                points=np.empty(0, np.int64),
            )
        actors = rows.tolist()
        return cls(
            names=tuple(sweeps.actors[actor] for actor in actors),
            types=tuple(sweeps.actor_types[actor] for actor in actors),
            objects=(len(sweeps.objects) + rows).astype(np.int32),
            centers=boxes.centers[index][rows],
            quaternions=boxes.quaternions[index][rows],
            sizes=boxes.sizes[index][rows],
            points=boxes.points[index][rows],
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
        """Center, length, width, height and yaw, float32 (k, 7)."""
        return np.column_stack([self.centers, self.sizes, self.yaw]).astype(np.float32)
