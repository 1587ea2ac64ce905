"""Public classes for plug-ins that read or write point clouds.

See docs/how-to/plugins.md for an example.
"""

from lidarfiles.plugins import (
    Cloud,
    CloudFormat,
    CloudLike,
    ExportSpec,
    FormatRow,
    MultiFileFormat,
    PointField,
    Recording,
    RecordingSource,
    Sweep,
    Sweeps,
)

__all__ = [
    "Cloud",
    "CloudFormat",
    "CloudLike",
    "ExportSpec",
    "FormatRow",
    "MultiFileFormat",
    "PointField",
    "Recording",
    "RecordingSource",
    "Sweep",
    "Sweeps",
]
