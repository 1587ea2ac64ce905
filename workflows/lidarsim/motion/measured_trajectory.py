"""The trajectory that a navigation system measures, with which points can be georeferenced.

The measured trajectory is the true trajectory with the errors of the GNSS receiver and of the
measured attitude. Both are always computed from the first sample, so all processes obtain the same
poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats, Ints
from ..numerics.vectors import matmul, rotate, rotate_into_frames
from .navigation import AttitudeErrors, GnssErrors, InstrumentedDrive, Navigation
from .rotations import rotations_of
from .trajectory import Pose, Trajectory, full_poses

ATTITUDE_HZ = 10.0  # rate of the attitude errors, which are interpolated linearly


@dataclass(frozen=True, eq=False)
class ErrorSeries:
    """Errors at evenly spaced times from the start of a survey, which are interpolated linearly."""

    values: Floats  # (k, 3)
    rate_hz: float

    @classmethod
    def compute(
        cls, next_errors: Callable[[Ints], Floats], duration_ns: float, rate_hz: float
    ) -> ErrorSeries:
        """Compute the errors of a survey, including the first error after its end."""
        count = math.floor(duration_ns * rate_hz / 1e9 + 1e-6) + 2
        return cls(next_errors(np.arange(count)), rate_hz)

    def at(self, times_ns: Floats) -> Floats:
        """Return the errors at times of shape (k,) as an array of shape (k, 3)."""
        place = np.clip(times_ns / 1e9 * self.rate_hz, 0, len(self.values) - 1)
        first = np.minimum(place.astype(np.int64), len(self.values) - 2)
        fraction = (place - first)[:, None]
        earlier = self.values[first]
        return np.asarray(earlier + fraction * (self.values[first + 1] - earlier))


@dataclass(frozen=True, eq=False)
class MeasuredTrajectory:
    """A trajectory with the errors of a navigation system. It has a single station.

    Parameters
    ----------
    path
        The true trajectory.
    position_errors
        Position errors to the east, north and up, in meters, or None.
    attitude_errors
        Roll, pitch and heading errors about the platform axes, in degrees, or None.
    """

    path: Trajectory
    position_errors: ErrorSeries | None = None
    attitude_errors: ErrorSeries | None = None
    stations: ClassVar[int] = 1
    moves: ClassVar[bool] = True

    @classmethod
    def from_drive(cls, drive: InstrumentedDrive) -> MeasuredTrajectory:
        """Return the trajectory that the instruments of a drive measure."""
        navigation = drive.navigation or Navigation()
        position_errors = attitude_errors = None
        if navigation.gnss is not None:
            gnss = GnssErrors(navigation, drive.platform_name)
            position_errors = ErrorSeries.compute(
                gnss.next_errors, drive.duration_ns, navigation.gnss.rate_hz
            )
        imu = navigation.imu
        if imu is not None and (imu.roll_pitch_deg or imu.heading_deg):
            attitude = AttitudeErrors(navigation, drive.platform_name, ATTITUDE_HZ)
            attitude_errors = ErrorSeries.compute(
                attitude.next_errors, drive.duration_ns, ATTITUDE_HZ
            )
        return cls(drive.path, position_errors, attitude_errors)

    @property
    def duration_ns(self) -> float:
        """Duration of the true trajectory in nanoseconds, which may be infinite."""
        return self.path.duration_ns

    def pose(self, station: int, time_ns: float = 0.0) -> Pose:
        """Return the measured pose at a time in nanoseconds since the start of the survey."""
        positions, rotations = self.poses(station, np.array([time_ns], np.float64))
        return Pose.from_rotation(positions[0], rotations[0])

    def poses(self, station: int, times_ns: Floats) -> tuple[Floats, Floats]:
        """Return the measured positions and rotations at the given times.

        For `times_ns` of shape (k,), the positions have shape (k, 3) and the rotations have shape
        (k, 3, 3).
        """
        return self._with_errors(times_ns, *full_poses(self.path, station, times_ns))

    def georeference(
        self, points: Floats, times_ns: Floats, mount: Pose, measured_mount: Pose
    ) -> Floats:
        """Transform points from the true trajectory to the measured trajectory.

        Parameters
        ----------
        points
            Points of a sensor in the scene frame, in meters. Shape (n, 3).
        times_ns
            Firing times of the points in nanoseconds since the start of the survey. Shape (n,).
        mount, measured_mount
            True and calibrated pose of the sensor in the platform frame.

        Returns
        -------
        array
            Points in the scene frame, in meters. Shape (n, 3).
        """
        times = np.minimum(times_ns, self.duration_ns)
        positions, rotations = full_poses(self.path, 0, times)
        measured_positions, measured_rotations = self._with_errors(times, positions, rotations)
        in_platform = rotate_into_frames(points - positions, rotations)
        if measured_mount != mount:
            in_sensor = rotate(in_platform - mount.position, mount.rotation_matrix.T)
            in_platform = rotate(in_sensor, measured_mount.rotation_matrix)
            in_platform += measured_mount.position
        from_platform = measured_rotations.transpose(0, 2, 1)
        return rotate_into_frames(in_platform, from_platform) + measured_positions

    def _with_errors(
        self, times_ns: Floats, positions: Floats, rotations: Floats
    ) -> tuple[Floats, Floats]:
        """Add the errors at the given times to true positions and rotations."""
        if self.position_errors is not None:
            positions = positions + self.position_errors.at(times_ns)
        if self.attitude_errors is not None:
            angles_deg = self.attitude_errors.at(times_ns)[:, ::-1]
            rotations = matmul(rotations, rotations_of(angles_deg))
        return positions, rotations


def measured_mount(mount: Pose, error: Pose) -> Pose:
    """Return the calibrated pose of a sensor whose true pose in the platform frame is `mount`.

    The boresight errors rotate the sensor about its own position.
    """
    position = np.add(mount.position, error.position)
    if error.rotation is None:
        return replace(mount, position=tuple(position.tolist()))
    return Pose.from_rotation(position, matmul(error.rotation, mount.rotation_matrix))


def check_measurable(navigation: Navigation | None) -> None:
    """Check that points can be georeferenced by a measured trajectory.

    Raises
    ------
    LidarError
        If there is no navigation system, or if positions are missing during outages.
    """
    if navigation is None:
        raise LidarError(
            "`georeferencing: measured` requires the errors of the trajectory. Set `navigation`, "
            "for example `navigation: {gnss: {drift_horizontal_m: 0.02}}`."
        )
    if navigation.gnss is not None and navigation.gnss.outages and navigation.imu is None:
        raise LidarError(
            "`georeferencing: measured` requires an IMU to bridge `navigation.gnss.outages`. Set "
            "`navigation.imu`, or remove the outages."
        )
