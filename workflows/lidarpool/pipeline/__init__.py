"""The survey pipeline: four stages on the partitions of a cluster, and their driver."""

from .driver import SurveyDriver
from .messages import Frame, Receipt
from .names import COLLECT, EXPORT, GENERATE, GPU, INTERSECT, LIDAR, OTHER, SORT
from .rigs import RigPlan
from .watch import Watch

__all__ = [
    "COLLECT",
    "EXPORT",
    "GENERATE",
    "GPU",
    "INTERSECT",
    "LIDAR",
    "OTHER",
    "SORT",
    "Frame",
    "Receipt",
    "RigPlan",
    "SurveyDriver",
    "Watch",
]
