"""Find the closest intersections of rays with triangle meshes, on GPUs and CPUs."""

from ._version import __version__
from .backend import BackendUnavailable
from .caster import RayCaster
from .deforming import DeformingMesh
from .hits import Hits, ScanReturns
from .instances import Instance, Mesh
from .moving import MovingBodies
from .opacity import Opacity
from .pattern import Pattern
from .pattern_rays import pattern_rays
from .poses import PoseMotion
from .registry import available_backends
from .sub_rays import SubRays

__all__ = [
    "BackendUnavailable",
    "DeformingMesh",
    "Hits",
    "Instance",
    "Mesh",
    "MovingBodies",
    "Opacity",
    "Pattern",
    "PoseMotion",
    "RayCaster",
    "ScanReturns",
    "SubRays",
    "__version__",
    "available_backends",
    "pattern_rays",
]
