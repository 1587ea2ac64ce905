"""Poses of the platform and of a sensor at the start of a sweep."""

from __future__ import annotations

from ..motion.trajectory import CENTER, Pose, mounted_poses
from ..numerics.arrays import Floats
from .survey import Survey


def platform_pose(survey: Survey, sensor: int, sweep: int) -> tuple[Floats, Floats]:
    """Return the pose of the platform at the start of a sweep.

    Parameters
    ----------
    survey
        The survey.
    sensor, sweep
        Numbers of the sensor and of its sweep.

    Returns
    -------
    tuple of arrays
        Position (3,) in meters and rotation matrix (3, 3), in the scene frame.
    """
    return _pose_at_start(survey, sensor, sweep, CENTER)


def sensor_pose(survey: Survey, sensor: int, sweep: int) -> tuple[Floats, Floats]:
    """Return the pose of the sensor at the start of a sweep, as `platform_pose` does."""
    mount = survey.mounted_sensors[sensor].mount
    return _pose_at_start(survey, sensor, sweep, mount)


def _pose_at_start(survey: Survey, sensor: int, sweep: int, mount: Pose) -> tuple[Floats, Floats]:
    """Return the pose of an instrument on the platform at the start of a sweep."""
    sweeps = survey.sweeps_each[sensor]
    station = sweep // (len(sweeps.firsts) // survey.path.stations)
    since_ns = sweeps.starts_ns[[sweep]] - station * survey.station_ns
    positions, rotations = mounted_poses(survey.path, station, mount, since_ns)
    return positions[0], rotations[0]
