from lidarfiles import PointCloud as PointCloud
from lidarfiles import Recording as Recording
from lidarfiles import RecordingInfo as RecordingInfo
from lidarfiles import SweepsInMemory as SweepsInMemory
from lidarfiles import open_recording as open_recording
from lidarfiles import read_cloud as read_cloud
from lidarfiles import save_cloud as save_cloud
from lidarfiles import sweeps as sweeps
from lidarfiles import to_open3d as to_open3d
from lidarlive import Foxglove as Foxglove
from lidarlive import Rerun as Rerun
from lidarlive import play as play
from lidarreal import Augment as Augment
from lidarreal import Comparison as Comparison
from lidarreal import Effects as Effects
from lidarreal import Fit as Fit
from lidarreal import Insertion as Insertion
from lidarreal import PatternFit as PatternFit
from lidarreal import SurveyComparison as SurveyComparison
from lidarreal import Twin as Twin
from lidarreal import augment as augment
from lidarreal import compare as compare
from lidarreal import compare_strips as compare_strips
from lidarreal import compare_surveys as compare_surveys
from lidarreal import fit as fit
from lidarreal import fit_pattern as fit_pattern
from lidarreal import twin as twin
from lidarscenario import Job as Job
from lidarscenario import Plan as Plan
from lidarscenario import Planning as Planning
from lidarscenes import Robot as Robot
from lidarscenes import load_robot as load_robot
from lidarsim import Actor as Actor
from lidarsim import Beams as Beams
from lidarsim import Cloud as Cloud
from lidarsim import Column as Column
from lidarsim import Fault as Fault
from lidarsim import Follower as Follower
from lidarsim import Gnss as Gnss
from lidarsim import Imu as Imu
from lidarsim import LidarError as LidarError
from lidarsim import Material as Material
from lidarsim import Mounted as Mounted
from lidarsim import MujocoScanner as MujocoScanner
from lidarsim import Navigation as Navigation
from lidarsim import NewtonScanner as NewtonScanner
from lidarsim import Noise as Noise
from lidarsim import Optics as Optics
from lidarsim import Packets as Packets
from lidarsim import Pose as Pose
from lidarsim import Returns as Returns
from lidarsim import ScanSpec as ScanSpec
from lidarsim import Scanner as Scanner
from lidarsim import Scene as Scene
from lidarsim import SceneInstance as SceneInstance
from lidarsim import SceneMesh as SceneMesh
from lidarsim import Sensor as Sensor
from lidarsim import Spin as Spin
from lidarsim import Survey as Survey
from lidarsim import Track as Track
from lidarsim import __version__ as __version__
from lidarsim import box as box
from lidarsim import load_sensor as load_sensor
from lidarsim import load_trajectory as load_trajectory
from lidarsim.columns.sweep import Sweep as Sweep
from .api.dask_frames import to_dask as to_dask
from .api.result import Result as Result
from .api.simulation import Campaign as Campaign
from .api.simulation import simulate as simulate
from .pages.scanner_page import show as show
from .report.merging import merge as merge
from .run.pipeline.stage_messages import ScanFrame as ScanFrame
from .run.run_result import CampaignRun as CampaignRun
from .run.store.run_store import remove_run as remove_run

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
    "PointCloud",
    "Pose",
    "Recording",
    "RecordingInfo",
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
    "SweepsInMemory",
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
