"""Placeholder."""

from __future__ import annotations

import importlib.util
from typing import ClassVar

from .backend import Backend, Found
from .rays import Rays


class CudaBackend(Backend):
    """CUDA."""

    name: ClassVar[str] = "cuda"
    chunk: ClassVar[int] = 1 << 22

    @classmethod
    def missing(cls) -> str:
        """See `Backend.missing`."""
        if importlib.util.find_spec("cupy") is None:
            return "CuPy is not installed: pip install cupy-cuda12x or cupy-cuda13x"
        return "not ready"

    def closest(self, rays: Rays) -> Found:
        """See `Backend.closest`."""
        raise NotImplementedError
