"""Lidar surveys of triangle scenes on a partitioned Dask cluster."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import lidarview  # noqa: F401 - draws the pictures in notebooks
from lidarsim._version import __version__

if TYPE_CHECKING:
    from lidarfiles.clouds.open3d_cloud import to_open3d
    from lidarfiles.clouds.ply import read_cloud
    from lidarfiles.clouds.recording import Recording
    from lidarfiles.clouds.writing import save_cloud
    from lidarfiles.datasets.loader import sweeps
    from lidarfiles.recordings.opening import open_recording
    from lidarlive.playback.live import play
    from lidarlive.viewers.scanner_view import Foxglove, Rerun
    from lidarreal.augmentation.effects import Effects, Insertion
    from lidarreal.augmentation.transform import Augment, augment
    from lidarreal.comparing.comparison import Comparison
    from lidarreal.comparing.fit.fitting import Fit, fit
    from lidarreal.comparing.surveys import SurveyComparison, compare_strips, compare_surveys
    from lidarreal.comparing.two_clouds import compare
    from lidarreal.reconstruction.building import twin
    from lidarreal.reconstruction.twin import Twin
    from lidarreal.scan_patterns import PatternFit, fit_pattern
    from lidarscenario.job import Job
    from lidarscenario.plan import Plan, Planning
    from lidarscenes.robots.robot import Robot
    from lidarscenes.robots.urdf import load_robot
    from lidarsim.columns.cloud import Cloud
    from lidarsim.columns.sweep import Sweep
    from lidarsim.columns.table import Column
    from lidarsim.errors import LidarError
    from lidarsim.media.materials import Material
    from lidarsim.motion.navigation import Gnss, Imu, Navigation
    from lidarsim.motion.trajectory import Pose, Track
    from lidarsim.motion.trajectory_files import load_trajectory
    from lidarsim.packets.sweep_packets import Packets
    from lidarsim.scene.actors import Actor, box
    from lidarsim.scene.scene import Scene
    from lidarsim.scene.scene_instances import SceneInstance
    from lidarsim.scene.scene_mesh import SceneMesh
    from lidarsim.sensor import Beams, Noise, Optics, Returns, Sensor, Spin
    from lidarsim.sensor.models import load_sensor
    from lidarsim.simulator import Scanner
    from lidarsim.survey.faults import Fault
    from lidarsim.survey.survey import Mounted, ScanSpec, Survey
    from lidarsim.worlds import MujocoScanner, NewtonScanner
    from lidarsim.worlds.follower import Follower

    from .api.dask_frames import to_dask
    from .api.result import Result
    from .api.simulation import Campaign, simulate
    from .pages.scanner_page import show
    from .report.merging import merge
    from .run.pipeline.stage_messages import ScanFrame
    from .run.run_result import CampaignRun
    from .run.store.run_store import remove_run

__all__ = [
    "Actor",
    "Augment",
    "Beams",
    "Campaign",
    "CampaignRun",
    "Cloud",
    "Column",
    "Comparison",
    "Effects",
    "Fault",
    "Fit",
    "Follower",
    "Foxglove",
    "Gnss",
    "Imu",
    "Insertion",
    "Job",
    "LidarError",
    "Material",
    "Mounted",
    "MujocoScanner",
    "Navigation",
    "NewtonScanner",
    "Noise",
    "Optics",
    "Packets",
    "PatternFit",
    "Plan",
    "Planning",
    "Pose",
    "Recording",
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
    "SurveyComparison",
    "Sweep",
    "Track",
    "Twin",
    "__version__",
    "augment",
    "box",
    "compare",
    "compare_strips",
    "compare_surveys",
    "fit",
    "fit_pattern",
    "load_robot",
    "load_sensor",
    "load_trajectory",
    "merge",
    "open_recording",
    "play",
    "read_cloud",
    "remove_run",
    "save_cloud",
    "show",
    "simulate",
    "sweeps",
    "to_dask",
    "to_open3d",
    "twin",
]

# Modules that define the names above, except names that come from lidarsim. Modules are imported
# lazily, because importing all of them takes a second, and the command-line interface must install
# its signal handlers before that (`__main__.py`).
_MODULES = {
    ".api.dask_frames": ("to_dask",),
    ".api.result": ("Result",),
    ".api.simulation": ("Campaign", "simulate"),
    ".augmentation.effects": ("Effects", "Insertion"),
    ".augmentation.transform": ("Augment", "augment"),
    ".datasets.loader": ("sweeps",),
    ".clouds.writing": ("save_cloud",),
    ".clouds.open3d_cloud": ("to_open3d",),
    ".clouds.ply": ("read_cloud",),
    ".run.pipeline.stage_messages": ("ScanFrame",),
    ".pages.scanner_page": ("show",),
    ".plan": ("Plan", "Planning"),
    ".playback.live": ("play",),
    ".report.merging": ("merge",),
    ".comparing.comparison": ("Comparison",),
    ".comparing.surveys": ("SurveyComparison", "compare_strips", "compare_surveys"),
    ".comparing.two_clouds": ("compare",),
    ".comparing.fit.fitting": ("Fit", "fit"),
    ".scan_patterns": ("PatternFit", "fit_pattern"),
    ".reconstruction.building": ("twin",),
    ".reconstruction.twin": ("Twin",),
    ".run.run_result": ("CampaignRun",),
    ".run.store.run_store": ("remove_run",),
    ".scenario.job": ("Job",),
    ".viewers.scanner_view": ("Foxglove", "Rerun"),
    ".clouds.recording": ("Recording",),
    ".recordings.opening": ("open_recording",),
    "lidarscenes.robots.robot": ("Robot",),
    "lidarscenes.robots.urdf": ("load_robot",),
    "lidarsim.columns.sweep": ("Sweep",),
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = next((module for module, names in _MODULES.items() if name in names), "lidarsim")
    value = getattr(import_module(module, __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
