"""Poses of frames, as received from a simulator."""

from __future__ import annotations

import math
import re
import struct
import time
from collections.abc import Sequence
from typing import Any

from rosbags.serde import SerdeError

from lidarfiles.clouds.ros.messages import CLOCK_TOPIC, RosMessage, message_store
from lidarscenes.robots.robot_world import joint_matrix
from lidarsim.words import format_rounded
from lidarsim.worlds.frame_tree import FrameTree, pose_of
from lidarsim.worlds.world import WORLD

from .notices import Notices
from .world_files import RobotFrames

CLOCK = "rosgraph_msgs/msg/Clock"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_JOINTS = "sensor_msgs/msg/JointState"
_STAMPED_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_STAMPED_POSE = "geometry_msgs/msg/PoseStamped"
_POSE = "geometry_msgs/msg/Pose"
_MODEL_POSE = re.compile(r"/model/(.+)/pose(_static)?")
_TOPICS = {
    CLOCK_TOPIC: CLOCK,
    "/tf": _TRANSFORMS,
    "/tf_static": _TRANSFORMS,
    "/joint_states": _JOINTS,
}
_MODEL_POSES = (_TRANSFORMS, _STAMPED_TRANSFORM, _STAMPED_POSE, _POSE)
# Poses are ignored if their time is further ahead of or behind the clock.
_MAX_AHEAD_NS = 1_000_000_000
_MAX_BEHIND_NS = 10_000_000_000
_MAX_FRAMES = 10_000
# Poses whose time differs from the clock are reported after this number of further clock messages,
# unless one of them shows that the clock has jumped.
_MIN_CLOCKS = 2
_SETTLE_S = 1.0  # how long poses from before a jump of the clock may still arrive


def is_wanted(topic: str, kind: str) -> bool:
    """Return whether messages of a topic contain the time or poses."""
    if topic in _TOPICS:
        return kind == _TOPICS[topic]
    return kind in _MODEL_POSES and _MODEL_POSE.fullmatch(topic) is not None


def nanoseconds(stamp: Any) -> int:
    """Convert a time message to nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def frame_name(name: str) -> str:
    """Convert a frame name to the form in which worlds state it.

    Examples
    --------
    >>> frame_name("/robot::base_link")
    'robot/base_link'
    """
    return name.replace("::", "/").strip("/")


class PoseInput:
    """Adds the poses in messages to a frame tree.

    Parameters
    ----------
    tree
        Frame tree to which poses are added.
    notices
        Notices about messages that cannot be used.
    """

    def __init__(self, tree: FrameTree, notices: Notices) -> None:
        self._tree = tree
        self._notices = notices
        self._robots: list[RobotFrames] = []
        self.clock_ns: int | None = None  # last time that was received
        self.last_ns: int | None = None  # time of the last pose over time, since the last jump
        # Frame of an ignored pose, and its time relative to the clock in nanoseconds
        self._off_clock: tuple[str, int] | None = None
        self._clocks = 0  # clock messages since the pose was ignored
        self._jumped_s = -_SETTLE_S  # when the clock last jumped, as `time.monotonic`

    def add_robots(self, robots: Sequence[RobotFrames]) -> None:
        """Let joint values control the links of further robots."""
        self._robots += robots

    def restart(self) -> None:
        """Forget when the last pose was received, because the clock has jumped."""
        self.last_ns = None
        self._off_clock = None
        self._jumped_s = time.monotonic()

    def set_clock(self, time_ns: int) -> None:
        """Set the simulation time. If it continues and poses were ignored, show a notice."""
        self.clock_ns = time_ns
        if self._off_clock is None:
            return
        self._clocks += 1
        if self._clocks < _MIN_CLOCKS:
            return
        frame, difference_ns = self._off_clock
        self._off_clock = None
        self._notices.show_event(
            "clock",
            f"Poses of {frame} are ignored, because their time differs from /clock by "
            f"{format_rounded(difference_ns / 1e9)} s. Set use_sim_time in the node that "
            "publishes them.",
        )

    def read(self, message: RosMessage) -> int | None:
        """Add the poses in a message. Return the time if it is a clock message.

        Messages that cannot be read cause a notice.
        """
        content: Any
        try:
            content = message_store().deserialize_cdr(message.cdr, message.kind)
        except (SerdeError, struct.error, ValueError, IndexError) as error:
            self._notices.show(
                ("damaged", message.topic),
                f"A message on {message.topic} is damaged and was ignored ({error}).",
            )
            return None
        if message.kind == CLOCK:
            return nanoseconds(content.clock)
        model = _MODEL_POSE.fullmatch(message.topic)
        is_static = message.topic.endswith("_static")
        if message.kind == _JOINTS:
            self._add_joints(content)
        elif message.kind == _TRANSFORMS:
            for transform in content.transforms:
                self._add_transform(transform, message.topic, "", is_static=is_static)
        elif message.kind == _STAMPED_TRANSFORM and model is not None:
            self._add_transform(content, message.topic, model[1], is_static=is_static)
        elif model is not None:
            header = content.header if message.kind == _STAMPED_POSE else None
            pose = content if header is None else content.pose
            parent = WORLD if header is None else frame_name(header.frame_id)
            time_ns = 0 if header is None else nanoseconds(header.stamp)
            values = _values(pose.position, pose.orientation)
            self._add(frame_name(model[1]), parent, time_ns, values, is_static=is_static)
        return None

    def _add_transform(
        self, stamped: Any, topic: str, default: str, *, is_static: bool = False
    ) -> None:
        """Add the pose in a TransformStamped."""
        frame = frame_name(stamped.child_frame_id or default)
        if not frame:
            self._notices.show(
                ("unnamed", topic),
                f"Transforms on {topic} have no child_frame_id and are ignored. Bridge a topic of "
                "Gazebo's PosePublisher, because pose/info contains no frame names.",
            )
            return
        transform = stamped.transform
        self._add(
            frame,
            frame_name(stamped.header.frame_id),
            nanoseconds(stamped.header.stamp),
            _values(transform.translation, transform.rotation),
            is_static=is_static,
        )

    def _add_joints(self, state: Any) -> None:
        """Convert joint values to poses of links."""
        values = dict(zip(state.name, state.position, strict=False))
        known = set()
        for robot, prefix in ((item.robot, item.prefix) for item in self._robots):
            joints = {joint.name: joint for joint in robot.joints.values()}
            for link, joint in robot.joints.items():
                source, factor, offset = joint.name, 1.0, 0.0
                while source not in values and (mimic := joints[source].mimic) is not None:
                    source = mimic[0]
                    offset += factor * mimic[2]
                    factor *= mimic[1]
                if source not in values or not joint.is_movable:
                    continue
                known.add(source)
                value = factor * float(values[source]) + offset
                if not math.isfinite(value):
                    self._notices.show_event(
                        "joint", f"A value of the joint {source} is ignored, because it is {value}."
                    )
                    continue
                matrix = joint_matrix(joint, value)
                time_ns = nanoseconds(state.header.stamp)
                self._add(prefix + link, prefix + joint.parent, time_ns, pose_of(matrix))
        self._notices.show_names(
            "joints",
            [name for name in values if name not in known],
            "These joints on /joint_states belong to no robot in a .urdf file, so they are "
            "ignored: {names}.",
        )

    def _add(
        self,
        frame: str,
        parent: str,
        time_ns: int,
        pose: Sequence[float],
        *,
        is_static: bool = False,
    ) -> None:
        """Add a pose, and show a notice if it is invalid or if the frame jumps."""
        clock_ns = self.clock_ns
        if not is_static and clock_ns is not None:
            time_ns = time_ns or clock_ns
            if not clock_ns - _MAX_BEHIND_NS <= time_ns <= clock_ns + _MAX_AHEAD_NS:
                is_settled = time.monotonic() - self._jumped_s > _SETTLE_S
                if is_settled and self._off_clock is None:
                    # The simulator may have restarted, and its clock may arrive after its poses.
                    self._off_clock = frame, time_ns - clock_ns
                    self._clocks = 0
                return
        if len(self._tree.received) >= _MAX_FRAMES and frame not in self._tree.received:
            self._notices.show(
                "frames", f"More than {_MAX_FRAMES:,} frames were received. Others are ignored."
            )
            return
        try:
            jump = self._tree.add(frame, parent, time_ns, pose, is_static=is_static)
        except ValueError as error:
            self._notices.show_event("invalid", f"A pose of {frame} is ignored, because {error}.")
            return
        if not is_static:
            self.last_ns = time_ns
        if jump is not None:
            self._notices.show_event(
                "jump",
                f"{frame} jumped by {format_rounded(jump.distance_m)} m within "
                f"{format_rounded(jump.duration_s)} s. Its motion in between is not interpolated.",
            )


def _values(position: Any, rotation: Any) -> tuple[float, ...]:
    """Return a position and a quaternion as seven numbers."""
    return (
        position.x,
        position.y,
        position.z,
        rotation.x,
        rotation.y,
        rotation.z,
        rotation.w,
    )
