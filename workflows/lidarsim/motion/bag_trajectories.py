"""Reader for trajectories in ROS 2 bags, from pose, GNSS, IMU and tf topics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..columns.bags import opened_bag, read_messages
from ..errors import LidarError
from ..numerics.arrays import Floats, Ints
from ..numerics.vectors import matmul, matvec, norm
from ..words import did_you_mean, join_names, plural
from .navigation import from_geodetic
from .rotations import quaternions_of
from .trajectory import QUATERNION_SLACK, Track

if TYPE_CHECKING:
    from rosbags.rosbag2 import Reader

Origin = Sequence[float] | None
# Functions that return the pose in a message, by message type.
_POSES: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "geometry_msgs/msg/TransformStamped": lambda message: message.transform,
}
_GNSS = "sensor_msgs/msg/NavSatFix"
_IMU = "sensor_msgs/msg/Imu"
_FRAMES = "tf2_msgs/msg/TFMessage"
_STATIC = "/tf_static"
_SECOND_NS = 1_000_000_000
_MAX_LISTED = 3  # maximum number of times in a message
_MAX_DIFFERENCE = 1e-6  # maximum difference between two copies of a pose that was sent twice
_READABLE_TYPES = ", ".join([*_POSES, _GNSS, _FRAMES])


class TimedPoses(NamedTuple):
    """Timed poses of a platform.

    Attributes
    ----------
    seconds
        Times in seconds, on the clock of the bag. Shape (k,).
    positions
        Positions in meters. Shape (k, 3).
    quaternions
        Quaternions (x, y, z, w), or None if the bag has no orientations. Shape (k, 4).
    skipped
        Description of invalid transforms that were skipped, as the end of a sentence about the bag.
        Empty if there are none.
    """

    seconds: Floats
    positions: Floats
    quaternions: Floats | None
    skipped: str = ""


@dataclass
class _Edge:
    """Timed poses of a frame relative to its parent frame."""

    parent: str
    times_ns: list[int] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)  # x, y, z and the quaternion
    invalid_ns: list[int] = field(default_factory=list)  # times of invalid transforms

    def add(self, time_ns: int, row: list[float]) -> None:
        """Add a pose. Invalid poses are skipped, as in tf2."""
        length = float(norm(np.asarray(row[3:])))
        if np.isfinite(row).all() and abs(length - 1) <= QUATERNION_SLACK:
            self.times_ns.append(time_ns)
            self.rows.append(row)
        else:
            self.invalid_ns.append(time_ns)

    @property
    def is_moving(self) -> bool:
        """Whether there are several poses that differ."""
        return self.is_repeated and any(row != self.rows[0] for row in self.rows)

    @property
    def is_repeated(self) -> bool:
        """Whether there are poses at several times."""
        return len(set(self.times_ns)) > 1


def read_bag(path: Path, topic: str | None, origin: Origin) -> TimedPoses:
    """Read a trajectory from a ROS 2 bag.

    Parameters
    ----------
    path
        Path of an .mcap or .db3 file, or of the folder of a bag.
    topic
        Topic with Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped or NavSatFix
        messages, a NavSatFix topic and an Imu topic separated by a space, or "/tf:FRAME" for a
        frame. With None, the bag must contain poses of a single topic or frame.
    origin
        For NavSatFix messages, the world origin as latitude and longitude in degrees, and height in
        meters. The default is the first fix.

    Raises
    ------
    LidarError
        If the bag cannot be read, or if the topic does not exist or is ambiguous.
    """
    with opened_bag(path, "the bag") as bag:
        message_types = _message_types(bag)
        base_topic, _, frame = (topic or "").partition(":")
        base_topic, _, imu = base_topic.partition(" ")
        pose_topics = [
            name for name, message_type in message_types.items() if message_type in (*_POSES, _GNSS)
        ]
        if base_topic in pose_topics:
            chosen = base_topic
        else:
            edges = _edges_of(bag, message_types)
            if base_topic == "/tf" and frame in edges:  # even if only an ancestor frame moves
                return _frame_poses(edges, frame)
            labels = [*pose_topics, *(f"/tf:{name}" for name in _moving_frames(edges))]
            chosen = _choose_label(labels, topic)
            if chosen.startswith("/tf:"):
                return _frame_poses(edges, chosen.removeprefix("/tf:"))
        if message_types[chosen] == _GNSS:
            return _gnss_poses(bag, message_types, chosen, imu, origin)
        return _topic_poses(bag, chosen, _POSES[message_types[chosen]])


def read_frame(path: Path, frame: str) -> TimedPoses | None:
    """Read the poses of a frame in a ROS 2 bag from its tf topics.

    Returns None if the bag does not contain the frame, or if neither the frame nor one of its
    ancestors moves. Raises LidarError if the bag cannot be read, or if its frames are inconsistent.
    """
    with opened_bag(path, "the bag") as bag:
        edges = _edges_of(bag, _message_types(bag))
    chain = _chain(edges, frame)
    if not any(edge.is_repeated or edge.invalid_ns for edge in chain):
        return None
    return _frame_poses(edges, frame)


def _message_types(bag: Reader) -> dict[str, str]:
    """Return the message type of each topic."""
    return {connection.topic: connection.msgtype for connection in bag.connections}


def _choose_label(labels: Sequence[str], topic: str | None) -> str:
    """Choose a topic or frame to read if none was requested by its exact name.

    The result is the only label, or the only frame if the topic is /tf. Raise LidarError if there
    is no unique match.
    """
    frames = [label for label in labels if label.startswith("/tf:")]
    if topic == "/tf" and len(frames) == 1:
        return frames[0]
    if topic is None and len(labels) == 1:
        return labels[0]
    if not labels:
        raise LidarError(f"it has no poses. Supported topics are {_READABLE_TYPES}.")
    available = f"The topics with poses are {join_names(labels)}"
    if topic is None:
        raise LidarError(
            f"it has several topics with poses. {available}. Set topic to one of them."
        )
    raise LidarError(
        f"it has no topic {topic!r} with poses.{did_you_mean(topic, labels)} {available}."
    )


def _row_of(pose: Any) -> list[float]:
    """Return the position and the quaternion (x, y, z, w) in a Pose or Transform message."""
    position = pose.position if hasattr(pose, "position") else pose.translation
    orientation = pose.orientation if hasattr(pose, "orientation") else pose.rotation
    return [
        position.x,
        position.y,
        position.z,
        orientation.x,
        orientation.y,
        orientation.z,
        orientation.w,
    ]


def _stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _in_order(times_ns: Sequence[int], rows: Sequence[Sequence[float]]) -> tuple[Ints, Floats]:
    """Sort rows by time, and drop rows that were sent twice.

    The times have shape (k,), and the rows have shape (k, n).
    """
    times = np.array(times_ns, np.int64)
    table = np.array(rows, np.float64)
    order = np.argsort(times, kind="stable")
    times = times[order]
    table = table[order]
    equal = np.abs(table[1:] - table[:-1]).max(axis=1) <= _MAX_DIFFERENCE
    repeated = np.append(False, (np.diff(times) == 0) & equal)
    return times[~repeated], table[~repeated]


def _topic_poses(bag: Reader, topic: str, get_pose: Callable[[Any], Any]) -> TimedPoses:
    """Return the poses on a topic, with the timestamps in their message headers."""
    stamps = []
    times = []
    rows = []
    frames = set()
    for _, time_ns, message in read_messages(bag, [topic]):
        stamps.append(_stamp_ns(message.header))
        times.append(time_ns)
        rows.append(_row_of(get_pose(message)))
        frames.add(message.header.frame_id)
    if not rows:
        raise LidarError(f"topic {topic} has no messages.")
    if len(frames) > 1:
        raise LidarError(f"topic {topic} has poses in several frames: {', '.join(sorted(frames))}.")
    # Programs that do not set the timestamps leave zeros.
    times_ns, table = _in_order(stamps if any(stamps) else times, rows)
    return TimedPoses(times_ns / 1e9, table[:, :3], table[:, 3:])


def _gnss_poses(
    bag: Reader, kinds: Mapping[str, str], topic: str, imu: str, origin: Origin
) -> TimedPoses:
    """Return the positions of a GNSS receiver, with an IMU's orientations if the bag has any."""
    times_ns = []
    fixes = []
    for _, _, fix in read_messages(bag, [topic]):
        geodetic = [fix.latitude, fix.longitude, fix.altitude]
        if fix.status.status >= 0 and np.isfinite(geodetic).all():
            times_ns.append(_stamp_ns(fix.header))
            fixes.append(geodetic)
    if len(fixes) < 2:
        raise LidarError(
            f"topic {topic} has {plural(len(fixes), 'fix', 'fixes')}, but a trajectory requires at "
            "least two."
        )
    times, table = _in_order(times_ns, fixes)
    origin_row = table[0] if origin is None else np.asarray(origin, np.float64)
    latitude, longitude, height = origin_row.tolist()
    positions = from_geodetic(table, (latitude, longitude, height))
    orientations = _orientations(bag, kinds, imu)
    if orientations is None:
        return TimedPoses(times / 1e9, positions, None)
    within = (times >= orientations[0][0]) & (times <= orientations[0][-1])
    if within.sum() < 2:
        raise LidarError(f"topic {topic} and the orientations of its IMU do not overlap in time.")
    _, rotations = _edge_poses(*orientations, times[within])
    return TimedPoses(times[within] / 1e9, positions[within], quaternions_of(rotations))


def _orientations(bag: Reader, kinds: Mapping[str, str], imu: str) -> tuple[Ints, Floats] | None:
    """Return the times (in nanoseconds) and orientations of an IMU, or None without an IMU.

    The times have shape (k,). The rows have shape (k, 7) and contain zero positions.
    """
    topics = [topic for topic, kind in kinds.items() if kind == _IMU]
    if imu and imu not in topics:
        raise LidarError(f"it has no IMU topic {imu!r}.{did_you_mean(imu, topics)}")
    measured: dict[str, tuple[list[int], list[list[float]]]] = {}
    for topic, _, message in read_messages(bag, [imu] if imu else topics):
        if message.orientation_covariance[0] != -1:  # -1 marks an IMU without orientation
            orientation = message.orientation
            times, rows = measured.setdefault(topic, ([], []))
            times.append(_stamp_ns(message.header))
            rows.append([0.0, 0.0, 0.0, orientation.x, orientation.y, orientation.z, orientation.w])
    if len(measured) > 1:
        raise LidarError(
            f"it has several IMU topics with orientations: {join_names([*measured])}. Set topic to "
            "the names of the NavSatFix and the Imu topic, separated by a space."
        )
    if not measured:
        if imu:
            raise LidarError(f"topic {imu} has no orientations.")
        return None
    return _in_order(*next(iter(measured.values())))


def _edges_of(bag: Reader, kinds: Mapping[str, str]) -> dict[str, _Edge]:
    """Read the poses of all frames relative to their parent frames from the tf topics."""
    edges: dict[str, _Edge] = {}
    topics = [topic for topic, kind in kinds.items() if kind == _FRAMES]
    for topic, _, message in read_messages(bag, topics):
        for stamped in message.transforms:
            parent, child = (
                frame.lstrip("/") for frame in (stamped.header.frame_id, stamped.child_frame_id)
            )
            edge = edges.setdefault(child, _Edge(parent))
            if edge.parent != parent:
                raise LidarError(
                    f"its frame {child!r} has two parent frames, {edge.parent!r} and {parent!r}."
                )
            if topic.endswith(_STATIC):
                edge.times_ns.clear()
                edge.rows.clear()
            edge.add(_stamp_ns(stamped.header), _row_of(stamped.transform))
    return edges


def _chain(edges: Mapping[str, _Edge], frame: str) -> list[_Edge]:
    """Return the edges that lead from a frame to the root of its tree."""
    chain = []
    visited = set[str]()
    while frame in edges:
        if frame in visited:
            raise LidarError(f"its frame {frame!r} is its own ancestor.")
        visited.add(frame)
        chain.append(edges[frame])
        frame = edges[frame].parent
    return chain


def _moving_frames(edges: Mapping[str, _Edge]) -> list[str]:
    """Return the frames that move relative to their parent frame.

    If no frame moves, return the frames with several poses.
    """
    repeated = [frame for frame, edge in edges.items() if edge.is_repeated]
    return [frame for frame in repeated if edges[frame].is_moving] or repeated


def _frame_poses(edges: Mapping[str, _Edge], frame: str) -> TimedPoses:
    """Return the poses of a frame in the root frame of its tree.

    The times are those of the first moving frame on the way to the root, limited to the interval in
    which all its moving ancestors have poses.
    """
    chain = _chain(edges, frame)
    skipped = _skipped_transforms(chain)
    if not all(edge.rows for edge in chain):
        raise LidarError(f"no transform of its frame {frame!r} can be used. The bag {skipped}.")
    tables = [_in_order(edge.times_ns, edge.rows) for edge in chain]
    moving = [times for times, _ in tables if len(times) > 1]
    if not moving:
        raise LidarError(
            f"its frame {frame!r} has one pose, but a trajectory requires at least two."
        )
    first = max(times[0] for times in moving)
    last = min(times[-1] for times in moving)
    times = moving[0][(moving[0] >= first) & (moving[0] <= last)]
    if len(times) < 2:
        raise LidarError(f"the parent frames of {frame!r} have no poses at a common time.")
    positions = np.zeros((len(times), 3))
    rotations = np.broadcast_to(np.eye(3), (len(times), 3, 3))
    for edge_times, rows in tables:
        edge_positions, edge_rotations = _edge_poses(edge_times, rows, times)
        positions = edge_positions + matvec(edge_rotations, positions)
        rotations = matmul(edge_rotations, rotations)
    return TimedPoses(times / 1e9, positions, quaternions_of(rotations), skipped)


def _skipped_transforms(chain: Sequence[_Edge]) -> str:
    """Describe the invalid transforms in a chain, or return an empty string if there are none."""
    times_ns = sorted(time for edge in chain for time in edge.invalid_ns)
    if not times_ns:
        return ""
    listed = ", ".join(
        f"{time // _SECOND_NS}.{time % _SECOND_NS:09}" for time in times_ns[:_MAX_LISTED]
    )
    others = len(times_ns) - _MAX_LISTED
    more = f" and {others:,} more times" if others > 0 else ""
    return (
        f"has invalid transforms on its tf topics at {listed} s{more}. They contain NaN or a "
        "quaternion whose length is not 1"
    )


def _edge_poses(edge_times: Ints, rows: Floats, times: Ints) -> tuple[Floats, Floats]:
    """Interpolate the poses of a frame relative to its parent at the requested times.

    Parameters
    ----------
    edge_times
        Times of the rows in nanoseconds. Shape (n,).
    rows
        Positions and quaternions. Shape (n, 7).
    times
        Requested times in nanoseconds. Shape (k,).

    Returns
    -------
    tuple
        Positions (k, 3) and rotation matrices (k, 3, 3).
    """
    if len(edge_times) == 1:  # a static frame
        edge_times = edge_times + np.arange(2)
        rows = rows.repeat(2, axis=0)
        times = np.broadcast_to(edge_times[0], len(times))
    seconds = (edge_times - edge_times[0]) / 1e9
    track = Track(seconds, rows[:, :3], rows[:, 3:])
    return track.poses(0, (times - edge_times[0]).astype(np.float64))
