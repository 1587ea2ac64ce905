from ._version import __version__ as __version__
from .columns.cloud import Cloud as Cloud
from .columns.table import Column as Column
from .errors import LidarError as LidarError
from .media.materials import Material as Material
from .motion.navigation import Gnss as Gnss
from .motion.navigation import Imu as Imu
from .motion.navigation import Navigation as Navigation
from .motion.trajectory import Pose as Pose
from .motion.trajectory import Track as Track
from .motion.trajectory_files import load_trajectory as load_trajectory
from .packets.sweep_packets import Packets as Packets
from .scene.actors import Actor as Actor
from .scene.actors import box as box
from .scene.scene import Scene as Scene
from .scene.scene_instances import SceneInstance as SceneInstance
from .scene.scene_mesh import SceneMesh as SceneMesh
from .sensor import Beams as Beams
from .sensor import Noise as Noise
from .sensor import Optics as Optics
from .sensor import Returns as Returns
from .sensor import Sensor as Sensor
from .sensor import Spin as Spin
from .sensor.export import export_sensor as export_sensor
from .sensor.models import load_sensor as load_sensor
from .simulator import Scanner as Scanner
from .survey.faults import Fault as Fault
from .survey.survey import Mounted as Mounted
from .survey.survey import ScanSpec as ScanSpec
from .survey.survey import Survey as Survey
from .worlds import MujocoScanner as MujocoScanner
from .worlds import NewtonScanner as NewtonScanner
from .worlds.follower import Follower as Follower

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
