"""Lidar simulation in the calling process.

A `Survey` describes sensors, poses, noise and weather, and a `Scanner` simulates individual sweeps.
This package imports neither Dask nor Open3D. To run thousands of surveys on a Dask cluster, use the
`lidarpool` package.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ._version import __version__

if TYPE_CHECKING:
    from .columns.cloud import Cloud
    from .columns.table import Column
    from .errors import LidarError
    from .media.materials import Material
    from .motion.navigation import Gnss, Imu, Navigation
    from .motion.trajectory import Pose, Track
    from .motion.trajectory_files import load_trajectory
    from .packets.sweep_packets import Packets
    from .scene.actors import Actor, box
    from .scene.scene import Scene
    from .scene.scene_instances import SceneInstance
    from .scene.scene_mesh import SceneMesh
    from .sensor import Beams, Noise, Optics, Returns, Sensor, Spin
    from .sensor.export import export_sensor
    from .sensor.models import load_sensor
    from .simulator import Scanner
    from .survey.faults import Fault
    from .survey.survey import Mounted, ScanSpec, Survey
    from .worlds import MujocoScanner, NewtonScanner
    from .worlds.follower import Follower

__all__ = [
    "Actor",
    "Beams",
    "Cloud",
    "Column",
    "Fault",
    "Follower",
    "Gnss",
    "Imu",
    "LidarError",
    "Material",
    "Mounted",
    "MujocoScanner",
    "Navigation",
    "NewtonScanner",
    "Noise",
    "Optics",
    "Packets",
    "Pose",
    "Returns",
    "ScanSpec",
    "Scanner",
    "Scene",
    "SceneInstance",
    "SceneMesh",
    "Sensor",
    "Spin",
    "Survey",
    "Track",
    "__version__",
    "box",
    "export_sensor",
    "load_sensor",
    "load_trajectory",
]

# Modules that define the names above; names that are not listed here are defined in `sensor`. A
# module is imported on first access to one of its names, because importing all of them takes half a
# second.
_MODULES = {
    "errors": ("LidarError",),
    "columns.cloud": ("Cloud",),
    "columns.table": ("Column",),
    "media.materials": ("Material",),
    "motion.navigation": ("Gnss", "Imu", "Navigation"),
    "motion.trajectory": ("Pose", "Track"),
    "motion.trajectory_files": ("load_trajectory",),
    "packets.sweep_packets": ("Packets",),
    "scene.actors": ("Actor", "box"),
    "scene.scene": ("Scene",),
    "scene.scene_instances": ("SceneInstance",),
    "scene.scene_mesh": ("SceneMesh",),
    "sensor.export": ("export_sensor",),
    "sensor.models": ("load_sensor",),
    "simulator": ("Scanner",),
    "survey.faults": ("Fault",),
    "survey.survey": ("Mounted", "ScanSpec", "Survey"),
    "worlds": ("MujocoScanner", "NewtonScanner"),
    "worlds.follower": ("Follower",),
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = next((module for module, names in _MODULES.items() if name in names), "sensor")
    value = getattr(import_module(f".{module}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
