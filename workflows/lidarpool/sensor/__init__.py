"""Sensors: beams, the head that moves them, where they are, and what a survey scans."""

from .beams import Beams, Head, Spin
from .sensor import Sensor
from .survey import ScanSpec, Survey
from .trajectory import Pose, Stations, Trajectory

__all__ = [
    "Beams",
    "Head",
    "Pose",
    "ScanSpec",
    "Sensor",
    "Spin",
    "Stations",
    "Survey",
    "Trajectory",
]
