"""A stand-in for a simulator with ros_gz, which publishes /clock and /tf through cyclonedds."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

from lidarfiles.clouds.ros.messages import RosMessage, message_store

Position = tuple[float, float, float]
# Frame, parent, position and yaw in degrees.
Placed = tuple[str, str, Position, float]


def stamp(time_s: float) -> Any:
    nanoseconds = round(time_s * 1e9)
    return message_store().types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 10**9))


def message(topic: str, content: Any) -> RosMessage:
    kind = content.__msgtype__
    return RosMessage(topic, kind, 0, message_store().serialize_cdr(content, kind))


def clock(time_s: float) -> RosMessage:
    return message("/clock", message_store().types["rosgraph_msgs/msg/Clock"](stamp(time_s)))


def transforms(time_s: float, frames: Iterable[Placed], topic: str = "/tf") -> RosMessage:
    types = message_store().types
    return message(
        topic,
        types["tf2_msgs/msg/TFMessage"]([
            types["geometry_msgs/msg/TransformStamped"](
                types["std_msgs/msg/Header"](stamp(time_s), parent),
                frame,
                types["geometry_msgs/msg/Transform"](
                    types["geometry_msgs/msg/Vector3"](*map(float, position)),
                    quaternion(yaw_deg),
                ),
            )
            for frame, parent, position, yaw_deg in frames
        ]),
    )  # fmt: skip


def quaternion(yaw_deg: float) -> Any:
    half = math.radians(yaw_deg) / 2
    kind = message_store().types["geometry_msgs/msg/Quaternion"]
    return kind(0.0, 0.0, math.sin(half), math.cos(half))


def joint_states(time_s: float, values: dict[str, float]) -> RosMessage:
    import numpy as np

    types = message_store().types
    none = np.zeros(0)
    header = types["std_msgs/msg/Header"](stamp(time_s), "")
    positions = np.array([*values.values()], float)
    state = types["sensor_msgs/msg/JointState"](header, [*values], positions, none, none)
    return message("/joint_states", state)


class Simulator:
    """Publishes the clock and poses at a fixed rate.

    Parameters
    ----------
    domain
        Domain of ROS 2.
    frames
        Function that returns the frames at a time in seconds.
    rate_hz
        Rate of both topics in simulation time.
    """

    def __init__(
        self, domain: int, frames: Callable[[float], Iterable[Placed]], rate_hz: float = 50.0
    ) -> None:
        from lidarlive.playback import dds

        self.publisher = dds.RosPublisher(dds.Network(domain=domain))
        self.frames = frames
        self.step_s = 1 / rate_hz

    def step(self, time_s: float) -> None:
        self.publisher.publish(transforms(time_s, self.frames(time_s)))
        self.publisher.publish(clock(time_s))

    def run(self, start_s: float, stop_s: float, *, speed: float = 1.0) -> None:
        """Publish in real time, or `speed` times as fast."""
        begin_s = time.monotonic()
        for number in range(round((stop_s - start_s) / self.step_s) + 1):
            since_s = number * self.step_s
            time.sleep(max(0.0, begin_s + since_s / speed - time.monotonic()))
            self.step(start_s + since_s)

    def close(self) -> None:
        self.publisher.__exit__()


def crate_drive(time_s: float) -> list[Placed]:
    """A robot that stands, and a crate that moves at 1 m/s."""
    return [
        ("robot", "room", (0, 0, 0.2), 0),
        ("robot/lidar", "robot", (0, 0, 0.3), 0),
        ("crate", "room", (3 + (time_s - 10), 0, 0.5), 0),
    ]


if __name__ == "__main__":  # a simulator that runs until it is killed
    simulator = Simulator(int(sys.argv[1]), crate_drive, rate_hz=float(sys.argv[3]))
    simulator.run(float(sys.argv[2]), 1e6)
