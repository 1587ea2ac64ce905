"""The survey pipeline: four stages on the partitions of a cluster, and their driver."""

from .crew import Crew
from .driver import SurveyDriver
from .failures import JobError
from .long_stages import LongStages
from .messages import Frame, Receipt
from .names import COLLECT, EXPORT, GENERATE, GPU, INTERSECT, LIDAR, OTHER, SORT
from .rigs import RigPlan
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
    "Crew",
    "Frame",
    "JobError",
    "LongStages",
    "Receipt",
    "RigPlan",
    "SurveyDriver",
]
