from .clouds.open3d_cloud import to_open3d as to_open3d
from .clouds.ply import read_cloud as read_cloud
from .clouds.recording import PointCloud as PointCloud
from .clouds.recording import Recording as Recording
from .clouds.recording import RecordingInfo as RecordingInfo
from .clouds.recording import SweepsInMemory as SweepsInMemory
from .clouds.writing import save_cloud as save_cloud
from .datasets.loader import sweeps as sweeps
from .recordings.opening import open_recording as open_recording

__all__ = [
    "PointCloud",
    "Recording",
    "RecordingInfo",
    "SweepsInMemory",
    "open_recording",
    "read_cloud",
    "save_cloud",
    "sweeps",
    "to_open3d",
]
