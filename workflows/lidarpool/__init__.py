"""Lidar surveys of triangle scenes on a partitioned Dask cluster."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ._version import __version__

if TYPE_CHECKING:
    from .cloud import Cloud
    from .errors import LidarpoolError
    from .journal_folder import remove_journal
    from .plan import Plan, Planning
    from .ply import read_cloud, save_cloud, write_cloud
    from .result import Result
    from .scan import Frame
    from .scene import Scene
    from .sensor import Sensor
    from .simulation import simulate
    from .survey import Pose, ScanSpec, Survey

__all__ = [
    "Cloud",
    "Frame",
    "LidarpoolError",
    "Plan",
    "Planning",
    "Pose",
    "Result",
    "ScanSpec",
    "Scene",
    "Sensor",
    "Survey",
    "__version__",
    "read_cloud",
    "remove_journal",
    "save_cloud",
    "simulate",
    "write_cloud",
]

# Where the names above are. They are imported when they are asked for, which takes a second:
# the command has to see to its signals before (`__main__.py`).
_MODULES = {
    "cloud": ("Cloud",),
    "errors": ("LidarpoolError",),
    "journal_folder": ("remove_journal",),
    "plan": ("Plan", "Planning"),
    "ply": ("read_cloud", "save_cloud", "write_cloud"),
    "result": ("Result",),
    "scan": ("Frame",),
    "scene": ("Scene",),
    "sensor": ("Sensor",),
    "simulation": ("simulate",),
    "survey": ("Pose", "ScanSpec", "Survey"),
}


def __getattr__(name: str) -> Any:
    for module, names in _MODULES.items():
        if name in names:
            found = getattr(import_module(f".{module}", __name__), name)
            globals()[name] = found
            return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
