"""Public classes for plug-ins that read or write point clouds.

See docs/how-to/plugins.md for an example.
"""

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.sweeps.sweeps import Sweeps

from .clouds.cloud_format import CloudFormat
from .clouds.format_options import FormatOptions
from .clouds.format_row import FormatRow
from .clouds.multi_file_format import MultiFileFormat
from .clouds.point_field import PointField
from .clouds.recording import (
    FileRecording,
    PointCloud,
    Recording,
    RecordingInfo,
    SweepsInMemory,
)
from .clouds.recording_ref import RecordingRef

__all__ = [
    "Cloud",
    "CloudFormat",
    "CloudLike",
    "FileRecording",
    "FormatOptions",
    "FormatRow",
    "MultiFileFormat",
    "PointCloud",
    "PointField",
    "Recording",
    "RecordingInfo",
    "RecordingRef",
    "Sweep",
    "Sweeps",
    "SweepsInMemory",
]
