"""The survey pipeline: four stages on the partitions of a cluster."""

from .builder import CloudBuilder
from .merged import StoredCloud
from .messages import Frame
from .pump import SurveyPump
from .setup import SurveySetup
from .stage_names import COLLECT, GENERATE, GPU, INTERSECT, LIDAR, OTHER, SORT

__all__ = [
    "COLLECT",
    "GENERATE",
    "GPU",
    "INTERSECT",
    "LIDAR",
    "OTHER",
    "SORT",
    "CloudBuilder",
    "Frame",
    "StoredCloud",
    "SurveyPump",
    "SurveySetup",
]
