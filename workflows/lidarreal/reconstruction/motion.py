"""Sensor motion during a sweep, for which points are compensated.

Recordings store points either as fired, in the sensor frame at the time of each firing, or
motion-compensated, in the sensor frame at the start of the sweep. If a recording does not state
which, the alignment determines it. The compensation of a point as fired is a fraction of the motion
to the next or from the previous sweep. The fraction follows from the time of the point relative to
the timestamp of the sweep or, without point times, from its azimuth. The pose of a sweep is valid
at its timestamp.

The timestamp is that of the first point, or that of the middle of the sweep, as in KITTI: a camera
is triggered when the sensor faces forward, and the points are sorted from this azimuth on, although
the sweep begins and ends at the back.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.numerics.arrays import Floats


class Motion(StrEnum):
    """Whether stored points are motion-compensated, and how their firing times are known."""

    COMPENSATED = "compensated"
    TIMED = "as fired, with point times"
    COUNTERCLOCKWISE = "as fired, counterclockwise"
    CLOCKWISE = "as fired, clockwise"
    CENTERED_COUNTERCLOCKWISE = "as fired, counterclockwise, timestamps in the middle of sweeps"
    CENTERED_CLOCKWISE = "as fired, clockwise, timestamps in the middle of sweeps"

    @property
    def is_turning(self) -> bool:
        """Whether firing times are derived from azimuths."""
        return self not in (Motion.COMPENSATED, Motion.TIMED)

    @property
    def is_clockwise(self) -> bool:
        """Whether firing times are derived from azimuths, assuming a clockwise rotation."""
        return self in (Motion.CLOCKWISE, Motion.CENTERED_CLOCKWISE)

    @property
    def is_centered(self) -> bool:
        """Whether the timestamps are those of the middle of the sweeps."""
        return self in (Motion.CENTERED_COUNTERCLOCKWISE, Motion.CENTERED_CLOCKWISE)

    def times_s(self, sweep: Sweep, sweep_s: float) -> Floats | None:
        """Return the time of each point in seconds, relative to the sweep's timestamp.

        `sweep_s` is the duration of a sweep. Return None if the points are motion-compensated.
        """
        if self is Motion.TIMED:
            return sweep.columns.get("time_s")
        if self is Motion.COMPENSATED:
            return None
        azimuth = sweep.columns.get("azimuth_rad")  # of lost pulses, which have no position
        if azimuth is None:
            azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
        turn: Floats = ((azimuth - sweep.columns["start_rad"]) / (2 * np.pi)) % 1
        if self.is_clockwise:
            turn = -turn % 1  # The first points are at 0, not at 1.
        if self.is_centered:
            turn = (turn + 0.5) % 1 - 0.5
        return turn * sweep_s


class MotionStep(NamedTuple):
    """Sensor motion between the timestamps of two sweeps, in the sensor frame of the first."""

    rotation: Floats  # (3,), rotation vector, radians
    translation: Floats  # (3,), meters

    @classmethod
    def between(cls, pose: Floats, following: Floats) -> MotionStep:
        """Return the motion between two poses.

        Both poses have shape (4, 4).
        """
        from scipy.spatial.transform import Rotation

        turned = pose[:3, :3].T @ following[:3, :3]
        return cls(
            Rotation.from_matrix(turned).as_rotvec(),
            pose[:3, :3].T @ (following[:3, 3] - pose[:3, 3]),
        )

    def fraction(self, share: float) -> Floats:
        """Return a fraction of the motion as a transformation matrix.

        The matrix has shape (4, 4).
        """
        from scipy.spatial.transform import Rotation

        moved = np.eye(4)
        moved[:3, :3] = Rotation.from_rotvec(share * self.rotation).as_matrix()
        moved[:3, 3] = share * self.translation
        return moved

    def compensate(self, shares: Floats, *groups: Floats) -> list[Floats]:
        """Transform several groups of points to the first sensor frame of the step.

        Each group has shape (n, 3), and its points were fired at the given fractions of the step,
        of shape (n,).
        """
        moved = shares[:, None] * self.translation
        turn_rad = float(np.linalg.norm(self.rotation))
        if not turn_rad:
            return [points + moved for points in groups]
        # Rodrigues' formula for the rotation of points about a common axis
        x, y, z = self.rotation / turn_rad
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        sine = np.sin(turn_rad * shares)[:, None]
        versine = 2 * np.square(np.sin(turn_rad / 2 * shares))[:, None]
        return [
            points + moved + sine * (points @ cross.T) + versine * (points @ (cross @ cross).T)
            for points in groups
        ]
