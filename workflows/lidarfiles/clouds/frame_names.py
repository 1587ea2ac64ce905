"""Names of frames and topics, which ROS bags and live views share."""

from __future__ import annotations

from collections.abc import Sequence

from lidarsim.packets.encoders import START_NS
from lidarsim.sweeps.sweeps import Sweeps, make_identifiers

WORLD = "map"
VEHICLE = "base_link"
INSTRUMENTS = "imu", "gnss"


def frame_names(sensors: Sequence[str], actors: Sequence[str]) -> list[str]:
    """Return unique frame names for the sensors, the actors, the IMU and the GNSS receiver.

    The frames are in this order. The name of an unnamed sensor is an empty string.
    """
    named = (*(name or "lidar" for name in sensors), *actors)
    return make_identifiers((WORLD, VEHICLE, *named, *INSTRUMENTS))[2:]


def points_topic(name: str, frame: str) -> str:
    """Return the topic for the points of a sensor, given its name and its frame.

    The name of an unnamed sensor is an empty string.
    """
    return f"/{frame}/points" if name else "/points"


def survey_start_ns(sweeps: Sweeps) -> int:
    """Return the start of a survey in nanoseconds since 1970-01-01 UTC.

    If the start is unknown, the result is `START_NS`. This default is not 0, because tf2 interprets
    time 0 as a request for the latest transform.
    """
    return START_NS if sweeps.start_ns is None else sweeps.start_ns
