"""Lidar sensors: beams, heads, optics and noise."""

from .beams import Beams, Head, Mirror, Spin
from .noise import Noise
from .optics import Optics, Returns
from .ray_sensors import ListedSensor, Prism, PrismSensor
from .sensor import LineSensor, Sensor

__all__ = [
    "Beams",
    "Head",
    "LineSensor",
    "ListedSensor",
    "Mirror",
    "Noise",
    "Optics",
    "Prism",
    "PrismSensor",
    "Returns",
    "Sensor",
    "Spin",
]
