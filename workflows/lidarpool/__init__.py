"""Lidar surveys of triangle scenes on a partitioned Dask cluster."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ._version import __version__

if TYPE_CHECKING:
    from .api.result import Result
    from .api.simulation import Campaign, simulate
    from .base.errors import LidarpoolError
    from .columns.cloud import Cloud
    from .columns.table import Column
    from .compare.comparison import Comparison, compare
    from .compare.fit import Fit, fit
    from .datasets.loader import sweeps
    from .datasets.sweep_data import Sweep
    from .export.formats import save_cloud
    from .export.open3d_cloud import to_open3d
    from .export.ply import read_cloud
    from .pipeline.messages import ScanFrame
    from .plan import Plan, Planning
    from .report.merging import merge
    from .run.run_result import CampaignRun
    from .run.store import remove_run
    from .scenario.build import Job
    from .scene.actors import Actor
    from .scene.files.urdf import load_robot
    from .scene.robot import Robot
    from .scene.scene import Scene
    from .scene.scene_instances import SceneInstance
    from .scene.scene_mesh import SceneMesh
    from .sensor import (
        Beams,
        Fault,
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
    from .sensor.models import load_sensor
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
    "Fault",
    "Fit",
    "Gnss",
    "Imu",
    "Job",
    "LidarpoolError",
    "Material",
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
    "ScanFrame",
    "ScanSpec",
    "Scanner",
    "Scene",
    "SceneInstance",
    "SceneMesh",
    "Sensor",
    "Spin",
    "Survey",
    "Sweep",
    "Track",
    "__version__",
    "compare",
    "fit",
    "load_robot",
    "load_sensor",
    "load_trajectory",
    "merge",
    "read_cloud",
    "remove_run",
    "save_cloud",
    "simulate",
    "sweeps",
    "to_open3d",
]

# Where the names above are, but for those of `sensor`. They are imported when they are asked for,
# which takes a second: the command has to see to its signals before (`__main__.py`).
_MODULES = {
    "api.result": ("Result",),
    "api.simulation": ("Campaign", "simulate"),
    "base.errors": ("LidarpoolError",),
    "columns.cloud": ("Cloud",),
    "columns.table": ("Column",),
    "datasets.loader": ("sweeps",),
    "datasets.sweep_data": ("Sweep",),
    "export.formats": ("save_cloud",),
    "export.open3d_cloud": ("to_open3d",),
    "export.ply": ("read_cloud",),
    "pipeline.messages": ("ScanFrame",),
    "plan": ("Plan", "Planning"),
    "report.merging": ("merge",),
    "compare.comparison": ("Comparison", "compare"),
    "compare.fit": ("Fit", "fit"),
    "run.run_result": ("CampaignRun",),
    "run.store": ("remove_run",),
    "scenario.build": ("Job",),
    "scene.actors": ("Actor",),
    "scene.scene_instances": ("SceneInstance",),
    "scene.scene_mesh": ("SceneMesh",),
    "scene.robot": ("Robot",),
    "scene.scene": ("Scene",),
    "scene.files.urdf": ("load_robot",),
    "sensor.models": ("load_sensor",),
    "sensor.trajectory": ("Track",),
    "sensor.trajectory_files": ("load_trajectory",),
    "simulator": ("Scanner",),
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = next((module for module, names in _MODULES.items() if name in names), "sensor")
    found = getattr(import_module(f".{module}", __name__), name)
    # Importing a module of the folder compare puts the folder in the function's place.
    if module.startswith("compare."):
        comparison = import_module(".compare.comparison", __name__)
        globals()["compare"] = comparison.compare
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
