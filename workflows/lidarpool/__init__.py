"""Lidar surveys of triangle scenes on a partitioned Dask cluster."""

from ._version import __version__
from .cloud import Cloud
from .errors import LidarpoolError
from .plan import Plan, Planning
from .ply import read_cloud, save_cloud, write_cloud
from .result import Result
from .scan import Frame
from .scene import Scene
from .sensor import Sensor
from .simulate import simulate
from .survey import Pose, ScanSpec, Survey

__all__ = [
    "Cloud",
    "Frame",
    "LidarpoolError",
    "Plan",
    "Planning",
    "Pose",
    "Result",
    "ScanSpec",
    "Scene",
    "Sensor",
    "Survey",
    "__version__",
    "read_cloud",
    "save_cloud",
    "simulate",
    "write_cloud",
]
