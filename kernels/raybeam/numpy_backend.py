"""Ray casting in NumPy: the reference that works wherever Python does."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from .backend import Backend, Found
from .crossings import Crossings
from .memory import require
from .mesh import LocalMesh
from .rays import Rays
from .tree import build_tree

_WIDTH = 8
_LEAF_SIZE = 4
_BYTES = 290  # a triangle, at the peak of a build, the mesh apart


class NumpyBackend(Backend):
    """Bounding volume hierarchy, walked by many rays at a time on one thread."""

    name: ClassVar[str] = "numpy"
    chunk: ClassVar[int] = 1 << 16

    @classmethod
    def missing(cls) -> str:
        """See `Backend.missing`."""
        return ""

    def __init__(
        self, mesh: LocalMesh, threads: int | None = None, device: int | None = None
    ) -> None:
        super().__init__(mesh, threads, device)
        n = len(mesh.corners)
        require(_BYTES * n, f"The tree over {n:,} triangles", "use a smaller mesh")
        self._walker = Crossings(mesh, build_tree(mesh.corners, _WIDTH, _LEAF_SIZE))

    def closest(self, rays: Rays, weights: bool) -> Found:
        """See `Backend.closest`."""
        origins = np.broadcast_to(self._mesh.to_local(rays.origins), rays.directions.shape)
        scale = self._mesh.scale
        return self._walker.closest(
            origins, rays.directions, rays.t_min * scale, rays.t_max * scale
        )

    def along(self, rays: Rays) -> NDArray[np.int32]:
        """See `Backend.along`."""
        origins = np.broadcast_to(self._mesh.to_local(rays.origins), rays.directions.shape)
        scale = self._mesh.scale
        return self._walker.along(origins, rays.directions, rays.t_min * scale, rays.t_max * scale)
