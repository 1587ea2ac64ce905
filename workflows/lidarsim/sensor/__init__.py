"""Sensors: beams, heads, trajectories, and surveys."""

from .beams import Beams, Head, Mirror, Spin
from .faults import Fault
from .materials import Material
from .navigation import Gnss, Imu, Navigation
from .noise import Noise
from .optics import Optics, Returns
from .ray_sensors import ListedSensor, Prism, PrismSensor
from .sensor import LineSensor, Sensor
from .survey import Mounted, ScanSpec, Survey
from .trajectory import Pose, StaticPose, Stations, Track, Trajectory
from .trajectory_files import load_trajectory

__all__ = [
    "Beams",
    "Fault",
    "Gnss",
    "Head",
    "Imu",
    "LineSensor",
    "ListedSensor",
    "Material",
    "Mirror",
    "Mounted",
    "Navigation",
    "Noise",
    "Optics",
    "Pose",
    "Prism",
    "PrismSensor",
    "Returns",
    "ScanSpec",
    "Sensor",
    "Spin",
    "StaticPose",
    "Stations",
    "Survey",
    "Track",
    "Trajectory",
    "load_trajectory",
]
