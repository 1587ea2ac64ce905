"""Names of frames and topics of sweeps, alike in bags of ROS and in live views."""

from __future__ import annotations

from collections.abc import Sequence

from lidarsim.packets.encoders import START_NS
from lidarsim.sweeps.sweeps import Sweeps, plain_names

WORLD = "map"
CARRIER = "base_link"
INSTRUMENTS = "imu", "gnss"


def frame_names(sensors: Sequence[str], actors: Sequence[str]) -> list[str]:
    """Return the frames of sensors, then of actors, the IMU and the GNSS receiver, by names."""
    named = (*(name or "lidar" for name in sensors), *actors)
    return plain_names((WORLD, CARRIER, *named, *INSTRUMENTS))[2:]


def points_topic(name: str, frame: str) -> str:
    """Return the topic of the points of a sensor with a name, which may be empty, and a frame."""
    return f"/{frame}/points" if name else "/points"


def survey_start_ns(sweeps: Sweeps) -> int:
    """Return the start of a survey, ns since 1970-01-01 UTC, or `START_NS` without a date.

    Not 0: at time 0, tf2 would take the newest frames for all times.
    """
    return START_NS if sweeps.start_ns is None else sweeps.start_ns
