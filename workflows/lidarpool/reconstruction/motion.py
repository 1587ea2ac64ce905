"""Motion of the sensor within a sweep: what the points of a recording need to be compensated by.

Points are stored as they were fired, each in the sensor frame of its own time, or compensated: all
in the sensor frame of the start of the sweep. Files do not say which. As fired, a point has a share
of the motion from its sweep to the next, or from the sweep before: by its time relative to the
stamp of the sweep or, without times, by its azimuth. The pose of a sweep holds at its stamp.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Floats


class Motion(StrEnum):
    """How the points of a recording were stored."""

    COMPENSATED = "compensated"
    TIMED = "as fired, with point times"
    COUNTERCLOCKWISE = "as fired, counterclockwise"
    CLOCKWISE = "as fired, clockwise"

    @property
    def is_turning(self) -> bool:
        """Whether points are compensated by their azimuths."""
        return self in (Motion.COUNTERCLOCKWISE, Motion.CLOCKWISE)

    def times_s(self, sweep: Sweep, sweep_s: float) -> Floats | None:
        """Return the times of points (n,) relative to the stamp of their sweep.

        `sweep_s` is the duration of a sweep. Returns None if points are compensated.
        """
        if self is Motion.TIMED:
            return sweep.columns.get("time_s")
        if self is Motion.COMPENSATED:
            return None
        azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
        turn: Floats = ((azimuth - sweep.columns["start_rad"]) / (2 * np.pi)) % 1
        if self is Motion.CLOCKWISE:
            turn = -turn % 1  # the first points are at 0, and not at 1
        return turn * sweep_s


class MotionStep(NamedTuple):
    """Motion of the sensor from the stamp of a sweep to that of another, in the sensor frame."""

    rotation: Floats  # (3,): rotation vector, radians
    translation: Floats  # (3,): meters

    @classmethod
    def between(cls, pose: Floats, following: Floats) -> MotionStep:
        """Return the step from a pose (4, 4) to another."""
        from scipy.spatial.transform import Rotation

        turned = pose[:3, :3].T @ following[:3, :3]
        return cls(
            Rotation.from_matrix(turned).as_rotvec(),
            pose[:3, :3].T @ (following[:3, 3] - pose[:3, 3]),
        )

    def fraction(self, share: float) -> Floats:
        """Return the motion (4, 4) of a share of the step."""
        from scipy.spatial.transform import Rotation

        moved = np.eye(4)
        moved[:3, :3] = Rotation.from_rotvec(share * self.rotation).as_matrix()
        moved[:3, 3] = share * self.translation
        return moved

    def compensate(self, points: Floats, shares: Floats) -> Floats:
        """Return points (n, 3), fired at shares (n,) of the step, in its first frame."""
        from scipy.spatial.transform import Rotation

        turned = Rotation.from_rotvec(shares[:, None] * self.rotation).apply(points)
        return np.asarray(turned + shares[:, None] * self.translation)
