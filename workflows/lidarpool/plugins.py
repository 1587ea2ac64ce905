"""The imports of plug-ins that write and read clouds, with an example in docs/how-to/plugins.md."""

from lidarsim.columns.cloud import Cloud, CloudLike
from lidarsim.columns.sweep import Sweep
from lidarsim.sweeps.sweeps import Sweeps

from .clouds.format_table import FormatRow
from .clouds.pieces import Pieces
from .clouds.recording import Recording, RecordingSource

__all__ = [
    "Cloud",
    "CloudLike",
    "FormatRow",
    "Pieces",
    "Recording",
    "RecordingSource",
    "Sweep",
    "Sweeps",
]
