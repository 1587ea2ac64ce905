"""Convert messages of the sensor service to requests, and points to messages."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.motion.trajectory import QUATERNION_SLACK
from lidarsim.numerics.vectors import norm
from lidarsim.words import printable

from .messages import message_class
from .served_scene import Drive, FramePoses, SensorPoints, SweepRequest

MAX_OBJECTS = 10_000  # maximum number of objects in a request
_MAX_LETTERS = 256  # maximum length of an object name


def sweep_request(message: Any) -> SweepRequest:
    """Convert a LidarRenderRequest.

    Raises
    ------
    LidarError
        If a value is missing or invalid. The message names the field.
    """
    start_us, end_us = message.frame_start_us, message.frame_end_us
    if not start_us < end_us:
        raise LidarError(
            f"frame_end_us must be greater than frame_start_us, but they are {end_us} and "
            f"{start_us}. Both are times in microseconds."
        )
    if len(message.dynamic_objects) > MAX_OBJECTS:
        raise LidarError(
            f"dynamic_objects has {len(message.dynamic_objects):,} entries. The limit is "
            f"{MAX_OBJECTS:,}."
        )
    objects: dict[str, FramePoses] = {}
    for entry in message.dynamic_objects:
        name = entry.track_id
        if len(name) > _MAX_LETTERS:
            raise LidarError(f"A track_id has more than {_MAX_LETTERS} characters.")
        if name in objects:
            raise LidarError(f"dynamic_objects contains {printable(name)!r} twice.")
        objects[name] = _pose_pair(entry, "pose_pair", f"object {printable(name)!r}")
    return SweepRequest(start_us, end_us, _pose_pair(message, "sensor_pose", "the sensor"), objects)


def points_message(points: SensorPoints) -> Any:
    """Convert points to a LidarRenderReturn, which contains them both as lists and as buffers."""
    positions = points.positions.astype("<f4").tobytes()
    intensities = points.intensities.astype("<f4").tobytes()
    return message_class("LidarRenderReturn")(
        point_xyzs=positions,
        point_intensities=intensities,
        num_points=len(points.intensities),
        point_xyzs_buffer=positions,
        point_intensities_buffer=intensities,
    )


def trajectory_message(drive: Drive) -> Any:
    """Convert the trajectory of a scenario to a Trajectory."""
    message = message_class("Trajectory")()
    rows = np.column_stack([drive.times_ns / 1e3, drive.positions, drive.quaternions])
    for time_us, x, y, z, qx, qy, qz, qw in rows.tolist():
        entry = message.poses.add(timestamp_us=round(time_us))
        for target, values in (
            (entry.pose.vec, {"x": x, "y": y, "z": z}),
            (entry.pose.quat, {"x": qx, "y": qy, "z": qz, "w": qw}),
        ):
            for name, value in values.items():
                setattr(target, name, value)
    return message


def _pose_pair(owner: Any, field: str, subject: str) -> FramePoses:
    """Return the poses at the start and the end of the frame."""
    if not owner.HasField(field):
        raise LidarError(f"{field} of {subject} is missing.")
    pair = getattr(owner, field)
    poses = FramePoses(np.empty((2, 3)), np.empty((2, 4)))
    for row, name in enumerate(("start_pose", "end_pose")):
        pose = getattr(pair, name)
        poses.positions[row] = [pose.vec.x, pose.vec.y, pose.vec.z]
        poses.quaternions[row] = [pose.quat.x, pose.quat.y, pose.quat.z, pose.quat.w]
        if not np.isfinite(poses.positions[row]).all():
            raise LidarError(f"{field}.{name}.vec of {subject} is not finite.")
        length = float(norm(poses.quaternions[row : row + 1])[0])
        if not abs(length - 1) <= QUATERNION_SLACK:
            raise LidarError(
                f"{field}.{name}.quat of {subject} has the norm {length:.6g}. It must be a unit "
                "quaternion; without a rotation, w is 1."
            )
    return poses
