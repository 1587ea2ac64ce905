"""Sensors: beams, the head that moves them, where they are, and what a survey scans."""

from .beams import Beams, Head, Mirror, Spin
from .rays import ListedSensor, PrismSensor
from .sensor import LineSensor, Sensor
from .survey import ScanSpec, Survey
from .trajectory import Pose, Stations, Trajectory

__all__ = [
    "Beams",
    "Head",
    "LineSensor",
    "ListedSensor",
    "Mirror",
    "Pose",
    "PrismSensor",
    "ScanSpec",
    "Sensor",
    "Spin",
    "Stations",
    "Survey",
    "Trajectory",
]
