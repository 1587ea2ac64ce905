"""The imports of plug-ins that write and read clouds, with an example in docs/how-to/plugins.md."""

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.sweeps.sweeps import Sweeps

from .clouds.cloud_format import CloudFormat
from .clouds.format_table import FormatRow
from .clouds.multi_file_format import MultiFileFormat
from .clouds.recording import Recording, RecordingSource
from .clouds.writing import ExportSpec

__all__ = [
    "Cloud",
    "CloudFormat",
    "CloudLike",
    "ExportSpec",
    "FormatRow",
    "MultiFileFormat",
    "Recording",
    "RecordingSource",
    "Sweep",
    "Sweeps",
]
