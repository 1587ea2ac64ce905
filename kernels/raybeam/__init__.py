"""Closest hits of rays with triangle meshes, on GPUs and on CPUs."""

from .backend import BackendUnavailable
from .caster import RayCaster
from .deforming import Deforming
from .device import DeviceHits, OtherHits, Outbox
from .hits import Hits, ScanReturns
from .instances import Instance, Mesh
from .moving import Moving, hits_on, listed_hits_on
from .opacity import Opacity
from .pattern import Pattern
from .pattern_rays import pattern_rays
from .poses import PoseMotion
from .registry import available_backends, backend_build
from .scan import Scan, check_scan
from .sub_rays import SubRays, any_axes

__all__ = [
    "BackendUnavailable",
    "Deforming",
    "DeviceHits",
    "Hits",
    "Instance",
    "Mesh",
    "Moving",
    "Opacity",
    "OtherHits",
    "Outbox",
    "Pattern",
    "PoseMotion",
    "RayCaster",
    "Scan",
    "ScanReturns",
    "SubRays",
    "any_axes",
    "available_backends",
    "backend_build",
    "check_scan",
    "hits_on",
    "listed_hits_on",
    "pattern_rays",
]
