"""The imports of plug-ins that write and read clouds, with an example in docs/how-to/plugins.md."""

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.sweeps.sweeps import Sweeps

from .clouds.file_points import FilePoints
from .clouds.format_table import FormatRow
from .clouds.pieces import Pieces
from .clouds.recording import Recording, RecordingSource

__all__ = [
    "Cloud",
    "CloudLike",
    "FilePoints",
    "FormatRow",
    "Pieces",
    "Recording",
    "RecordingSource",
    "Sweeps",
]
