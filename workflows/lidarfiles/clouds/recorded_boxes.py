"""Bounding boxes of labeled objects in the sweeps of a recording."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from lidarsim.motion.rotations import matrices
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.transform import affine
from lidarsim.sweeps.sweeps import Sweeps


class RecordedBoxes(NamedTuple):
    """Bounding boxes of labeled objects at the timestamps of sweeps, as arrays of k boxes."""

    sweep: Ints  # (k,), sweep numbers
    object: Ints  # (k,), numbers of the objects, which are the same in all sweeps
    kinds: tuple[str, ...]  # (k,), types of the objects, such as "Car"
    poses: Floats  # (k, 4, 4), from the center of the box to the sensor frame, with x forward
    sizes: Floats  # (k, 3), length, width and height in meters

    @classmethod
    def from_rows(
        cls, rows: Iterable[tuple[int, int, str, Floats, Sequence[float]]]
    ) -> RecordedBoxes:
        """Create boxes from rows with the values of the attributes.

        Raises
        ------
        ValueError
            If a size is negative or not finite, or if a pose is not finite.
        """
        listed = list(rows)
        for sweep_number, box, kind, pose, size in listed:
            if not np.isfinite(pose).all():
                raise ValueError(
                    f"the pose of box {box} ({kind or 'without a type'}) in sweep {sweep_number} "
                    "is not finite"
                )
            if not all(0 <= side < np.inf for side in size):
                raise ValueError(
                    f"the size of box {box} ({kind or 'without a type'}) must be positive, but is "
                    f"{' x '.join(f'{side:g}' for side in size)} m"
                )
        sweep, number, kinds, poses, sizes = zip(*listed, strict=True) if listed else ((),) * 5
        return cls(
            np.array(sweep, np.int64),
            np.array(number, np.int64),
            tuple(kinds),
            np.array(poses, np.float64).reshape(-1, 4, 4),
            np.array(sizes, np.float64).reshape(-1, 3),
        )

    @classmethod
    def from_sweeps(cls, sweeps: Sweeps, indices: Sequence[int]) -> RecordedBoxes:
        """Return the boxes of the actors that are present in some sweeps of a survey."""
        rows = []
        middles = sweeps.actor_bounds.mean(axis=1)
        sizes = sweeps.actor_bounds[:, 1] - sweeps.actor_bounds[:, 0]
        for number, index in enumerate(indices):
            from_world = np.linalg.inv(sweeps.pose.matrix(index))
            for actor in np.flatnonzero(sweeps.actor_there[:, index]).tolist():
                (rotation,) = matrices(sweeps.actor_poses.quaternions[actor, [index]])
                center = sweeps.actor_poses.positions[actor, index] + rotation @ middles[actor]
                pose = from_world @ affine(rotation, center)
                kind = sweeps.actor_types[actor]
                rows.append((number, len(sweeps.objects) + actor, kind, pose, sizes[actor]))
        return cls.from_rows(rows)

    @property
    def are_tracked(self) -> bool:
        """Whether objects are identified, so that an object has boxes in several sweeps."""
        return len(np.unique(self.object)) < len(self.object)

    def section(self, first: int, count: int) -> RecordedBoxes:
        """Return the boxes of consecutive sweeps, which are numbered from 0."""
        rows = np.flatnonzero((self.sweep >= first) & (self.sweep < first + count))
        return RecordedBoxes(
            self.sweep[rows] - first,
            self.object[rows],
            tuple(self.kinds[row] for row in rows.tolist()),
            self.poses[rows],
            self.sizes[rows],
        )


def upright_pose(center: Floats, forward: Floats, up: Floats) -> Floats:
    """Return the pose of a box, given its center, its direction and the upward direction.

    All three have shape (3,). The result has shape (4, 4).
    """
    axis = up / np.linalg.norm(up)
    leftward = np.cross(axis, forward)
    leftward /= np.linalg.norm(leftward)
    return affine(np.column_stack([np.cross(leftward, axis), leftward, axis]), center)
