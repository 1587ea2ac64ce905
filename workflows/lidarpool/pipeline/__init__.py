"""The survey pipeline: four stages on the partitions of a cluster, and their driver."""

from .driver import RunDriver
from .failures import JobError
from .jobs import JobState
from .long_stages import LongStages
from .messages import Frame, Receipt
from .names import COLLECT, EXPORT, GENERATE, GPU, INTERSECT, LIDAR, OTHER, SORT
from .workers import CastingWorkers

__all__ = [
    "COLLECT",
    "EXPORT",
    "GENERATE",
    "GPU",
    "INTERSECT",
    "LIDAR",
    "OTHER",
    "SORT",
    "CastingWorkers",
    "Frame",
    "JobError",
    "JobState",
    "LongStages",
    "Receipt",
    "RunDriver",
]
