"""The survey pipeline: four stages on the partitions of a cluster, and their driver."""

from .driver import SurveyDriver, SurveyOptions
from .messages import Frame, Receipt
from .names import COLLECT, GENERATE, GPU, INTERSECT, LIDAR, OTHER, SORT
from .rig import RigPlan
from .watch import PATIENCE_S, WAIT_S, Watch

__all__ = [
    "COLLECT",
    "GENERATE",
    "GPU",
    "INTERSECT",
    "LIDAR",
    "OTHER",
    "PATIENCE_S",
    "SORT",
    "WAIT_S",
    "Frame",
    "Receipt",
    "RigPlan",
    "SurveyDriver",
    "SurveyOptions",
    "Watch",
]
