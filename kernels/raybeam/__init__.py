"""Closest hits of rays with triangle meshes, on CUDA, Embree or NumPy."""

from .backend import BackendUnavailable
from .caster import RayCaster
from .hits import Hits, ScanReturns
from .pattern import Pattern
from .poses import Motion
from .registry import available_backends, backend_build

__all__ = [
    "BackendUnavailable",
    "Hits",
    "Motion",
    "Pattern",
    "RayCaster",
    "ScanReturns",
    "available_backends",
    "backend_build",
]
