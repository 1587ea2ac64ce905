"""Poses of the platform and of a sensor at the start of a sweep."""

from __future__ import annotations

import numpy as np

from ..motion.trajectory import full_poses
from ..numerics.arrays import Floats
from ..numerics.vectors import matmul, matvec
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
    sweeps = survey.sweeps_each[sensor]
    station = sweep // (len(sweeps.firsts) // survey.path.stations)
    since_ns = sweeps.starts_ns[[sweep]] - station * survey.station_ns
    positions, rotations = full_poses(survey.path, station, since_ns)
    return positions[0], rotations[0]


def sensor_pose(survey: Survey, sensor: int, sweep: int) -> tuple[Floats, Floats]:
    """Return the pose of the sensor at the start of a sweep, as `platform_pose` does."""
    position, rotation = platform_pose(survey, sensor, sweep)
    mount = survey.mounted_sensors[sensor].mount
    position = position + matvec(rotation, np.array(mount.position))
    return position, matmul(rotation, mount.rotation_matrix)
