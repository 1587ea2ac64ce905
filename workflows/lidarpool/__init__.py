"""Lidar surveys of triangle scenes on a partitioned Dask cluster."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ._version import __version__
from .base import ports

if TYPE_CHECKING:
    from .api.result import Result
    from .api.simulation import Campaign, simulate
    from .base.errors import LidarpoolError
    from .columns.cloud import Cloud
    from .columns.table import Column
    from .export.loader import Sweep, sweeps
    from .export.ply import read_cloud
    from .pipeline import Frame
    from .plan import Plan, Planning
    from .report.comparison import Comparison, compare
    from .run.result import CampaignRun
    from .run.store import remove_run
    from .scenario.build import Job
    from .scene.actors import Actor
    from .scene.instances import Instance
    from .scene.mesh import Mesh
    from .scene.robot import Robot
    from .scene.scene import Scene
    from .scene.urdf import load_robot
    from .sensor import (
        Beams,
        Gnss,
        Imu,
        Material,
        Mounted,
        Navigation,
        Noise,
        Optics,
        Pose,
        Returns,
        ScanSpec,
        Sensor,
        Spin,
        Survey,
    )
    from .sensor.models import datasheet, load_sensor
    from .sensor.trajectory import Track
    from .sensor.trajectory_files import load_trajectory
    from .simulator import Scanner

__all__ = [
    "Actor",
    "Beams",
    "Campaign",
    "CampaignRun",
    "Cloud",
    "Column",
    "Comparison",
    "Frame",
    "Gnss",
    "Imu",
    "Instance",
    "Job",
    "LidarpoolError",
    "Material",
    "Mesh",
    "Mounted",
    "Navigation",
    "Noise",
    "Optics",
    "Plan",
    "Planning",
    "Pose",
    "Result",
    "Returns",
    "Robot",
    "ScanSpec",
    "Scanner",
    "Scene",
    "Sensor",
    "Spin",
    "Survey",
    "Sweep",
    "Track",
    "__version__",
    "compare",
    "datasheet",
    "load_robot",
    "load_sensor",
    "load_trajectory",
    "read_cloud",
    "remove_run",
    "simulate",
    "sweeps",
]

# Where the names above are. They are imported when they are asked for, which takes a second:
# the command has to see to its signals before (`__main__.py`).
_MODULES = {
    "api.result": ("Result",),
    "api.simulation": ("Campaign", "simulate"),
    "base.errors": ("LidarpoolError",),
    "columns.cloud": ("Cloud",),
    "columns.table": ("Column",),
    "export.loader": ("Sweep", "sweeps"),
    "export.ply": ("read_cloud",),
    "pipeline": ("Frame",),
    "plan": ("Plan", "Planning"),
    "report.comparison": ("Comparison", "compare"),
    "run.result": ("CampaignRun",),
    "run.store": ("remove_run",),
    "scenario.build": ("Job",),
    "scene.actors": ("Actor",),
    "scene.instances": ("Instance",),
    "scene.mesh": ("Mesh",),
    "scene.robot": ("Robot",),
    "scene.scene": ("Scene",),
    "scene.urdf": ("load_robot",),
    "sensor.models": ("datasheet", "load_sensor"),
    "sensor": (
        "Beams",
        "Gnss",
        "Imu",
        "Material",
        "Mounted",
        "Navigation",
        "Noise",
        "Optics",
        "Pose",
        "Returns",
        "ScanSpec",
        "Sensor",
        "Spin",
        "Survey",
    ),
    "sensor.trajectory": ("Track",),
    "sensor.trajectory_files": ("load_trajectory",),
    "simulator": ("Scanner",),
}


# Imported when the first cloud is saved.
ports.save_cloud = lambda *given: import_module(".export.formats", __name__).save(*given)


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            found = getattr(import_module(f".{module}", __name__), name)
            globals()[name] = found
            return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
