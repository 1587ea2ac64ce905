"""CustomMsg messages of livox_ros_driver2, the ROS 2 driver of Livox."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from lidarsim.columns.bags import LIVOX_PADDING, LIVOX_POINT
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import AnyArray, Records

CUSTOM_MSG = "livox_ros_driver2/msg/CustomMsg"
CUSTOM_DEFINITION = f"""std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
{80 * "="}
MSG: livox_ros_driver2/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_MAX_LINES = 256  # line numbers are stored in a byte


def check_lines(channels: int) -> None:
    """Raise LidarError if a sensor has more channels than the layout `livox` supports."""
    if channels > _MAX_LINES:
        raise LidarError(
            f"The layout livox stores line numbers in one byte, but a sensor has {channels:,} "
            "channels. Use another layout."
        )


def custom_message(
    store: Typestore, header: Any, stamp_ns: int, since_ns: AnyArray, rows: Records
) -> bytes:
    """Return a serialized CustomMsg with points.

    Parameters
    ----------
    store
        Types of messages.
    header
        Header of the message.
    stamp_ns
        Timestamp of the message in nanoseconds since 1970.
    since_ns
        Firing times of the points in nanoseconds since the timestamp.
    rows
        Points in the layout `livox`.
    """
    points = np.zeros(len(rows), LIVOX_POINT)
    points["offset_time"] = np.clip(since_ns, 0, 2**32 - 1)
    for name in ("x", "y", "z", "tag", "line"):
        points[name] = rows[name]
    points["reflectivity"] = rows["intensity"]
    reserved = np.zeros(3, np.uint8)
    message = store.types[CUSTOM_MSG](header, stamp_ns, len(rows), 0, reserved, [])
    # rosbags would require an object for each point. The message is therefore serialized without
    # points, and the number of points at its end is replaced.
    start = bytes(store.serialize_cdr(message, CUSTOM_MSG))[:-4]
    content = points.tobytes()
    return start + np.uint32(len(rows)).tobytes() + content[: len(content) - LIVOX_PADDING]
