"""Closest hits of rays with triangle meshes, on CUDA, Embree or NumPy."""

from .backend import BackendUnavailable
from .caster import RayCaster
from .hits import Hits, ScanReturns
from .instances import Instance, Mesh
from .opacity import Opacity
from .pattern import Pattern
from .poses import Motion
from .registry import available_backends, backend_build

__all__ = [
    "BackendUnavailable",
    "Hits",
    "Instance",
    "Mesh",
    "Motion",
    "Opacity",
    "Pattern",
    "RayCaster",
    "ScanReturns",
    "available_backends",
    "backend_build",
]
