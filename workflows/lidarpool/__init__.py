"""Lidar surveys of triangle scenes on a partitioned Dask cluster."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import lidarview  # noqa: F401 - which draws the pictures of notebooks
from lidarsim._version import __version__

if TYPE_CHECKING:
    from lidarscenes.robots.robot import Robot
    from lidarscenes.robots.urdf import load_robot
    from lidarsim.base.errors import LidarError
    from lidarsim.columns.cloud import Cloud
    from lidarsim.columns.table import Column
    from lidarsim.follower import Follower
    from lidarsim.mujoco import MujocoScanner
    from lidarsim.packets.sweep_packets import Packets
    from lidarsim.scene.actors import Actor
    from lidarsim.scene.scene import Scene
    from lidarsim.scene.scene_instances import SceneInstance
    from lidarsim.scene.scene_mesh import SceneMesh
    from lidarsim.sensor import (
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
    from lidarsim.sensor.models import load_sensor
    from lidarsim.sensor.trajectory import Track
    from lidarsim.sensor.trajectory_files import load_trajectory
    from lidarsim.simulator import Scanner

    from .api.dask_frames import to_dask
    from .api.result import Result
    from .api.simulation import Campaign, simulate
    from .clouds.formats import save_cloud
    from .clouds.open3d_cloud import to_open3d
    from .clouds.ply import read_cloud
    from .compare.comparison import Comparison, compare
    from .compare.fit import Fit, fit
    from .datasets.loader import sweeps
    from .datasets.sweep_data import Sweep
    from .live.scanner_page import show
    from .plan import Plan, Planning
    from .playback.live import play
    from .report.merging import merge
    from .run.pipeline.messages import ScanFrame
    from .run.run_result import CampaignRun
    from .run.store.run_store import remove_run
    from .scenario.build import Job
    from .viewers.scanner_view import Foxglove, Rerun

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
    "Follower",
    "Foxglove",
    "Gnss",
    "Imu",
    "Job",
    "LidarError",
    "Material",
    "Mounted",
    "MujocoScanner",
    "Navigation",
    "Noise",
    "Optics",
    "Packets",
    "Plan",
    "Planning",
    "Pose",
    "Rerun",
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
    "play",
    "read_cloud",
    "remove_run",
    "save_cloud",
    "show",
    "simulate",
    "sweeps",
    "to_dask",
    "to_open3d",
]

# Modules of the names above, except names of lidarsim. A module is imported when one of its names
# is asked for: importing all takes a second, and the command sees to its signals before that
# (`__main__.py`).
_MODULES = {
    ".api.dask_frames": ("to_dask",),
    ".api.result": ("Result",),
    ".api.simulation": ("Campaign", "simulate"),
    ".datasets.loader": ("sweeps",),
    ".datasets.sweep_data": ("Sweep",),
    ".clouds.formats": ("save_cloud",),
    ".clouds.open3d_cloud": ("to_open3d",),
    ".clouds.ply": ("read_cloud",),
    ".run.pipeline.messages": ("ScanFrame",),
    ".live.scanner_page": ("show",),
    ".plan": ("Plan", "Planning"),
    ".playback.live": ("play",),
    ".report.merging": ("merge",),
    ".compare.comparison": ("Comparison", "compare"),
    ".compare.fit": ("Fit", "fit"),
    ".run.run_result": ("CampaignRun",),
    ".run.store.run_store": ("remove_run",),
    ".scenario.build": ("Job",),
    ".viewers.scanner_view": ("Foxglove", "Rerun"),
    "lidarscenes.robots.robot": ("Robot",),
    "lidarscenes.robots.urdf": ("load_robot",),
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = next((module for module, names in _MODULES.items() if name in names), "lidarsim")
    value = getattr(import_module(module, __name__), name)
    # Importing a module of the folder compare puts the folder in the function's place.
    if module.startswith(".compare."):
        comparison = import_module(".compare.comparison", __name__)
        globals()["compare"] = comparison.compare
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
