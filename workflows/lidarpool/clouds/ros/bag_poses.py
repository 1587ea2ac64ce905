"""Poses of the sweeps of a bag in the world, by its topics of frames."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lidarsim.base.arrays import Floats
from lidarsim.base.errors import LidarError
from lidarsim.motion.bag_trajectories import read_bag
from lidarsim.motion.trajectory import Track

_MAX_DISTANCE_NS = (
    2e8  # from a sweep to the nearest pose in time, before the first and after the last
)


def header_of(data: bytes) -> tuple[int, str]:
    """Return the stamp, ns, and the frame of a message that begins with a header of ROS 2."""
    order = "<u4" if data[1] & 1 else ">u4"
    seconds, nanoseconds, length = np.frombuffer(data, order, 3, 4).tolist()
    return seconds * 10**9 + nanoseconds, bytes(data[16 : 15 + length]).decode(errors="replace")


def sweep_poses(path: Path, messages: Iterable[bytes]) -> Floats | None:
    """Return the poses (n, 4, 4) of the frame of sweeps in the root of its tree of frames.

    `messages` are those of the sweeps of a sensor. None if the bag has no poses of the frame at the
    times of all sweeps.
    """
    headers = [header_of(message) for message in messages]
    frames = {frame.lstrip("/") for _, frame in headers}
    if len(frames) != 1:
        return None
    try:
        seconds, positions, quaternions = read_bag(path, f"/tf:{frames.pop()}", None)
    except LidarError:  # no frame of this name, or a frame that stands still
        return None
    times_ns = 1e9 * (seconds - seconds[0])
    stamps_ns = np.array([stamp for stamp, _ in headers]) - 1e9 * seconds[0]
    within_ns = stamps_ns.clip(times_ns[0], times_ns[-1])
    if np.abs(stamps_ns - within_ns).max() > _MAX_DISTANCE_NS:
        return None
    track = Track(seconds - seconds[0], positions, quaternions)
    poses = np.tile(np.eye(4), (len(headers), 1, 1))
    poses[:, :3, 3], poses[:, :3, :3] = track.poses(0, within_ns)
    return poses
