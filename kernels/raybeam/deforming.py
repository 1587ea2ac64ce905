"""Meshes whose vertices move: each ray meets the mesh as it is at the ray's own time.

A tree over the triangles, made once, serves for all times: between two frames each vertex moves
straight, so the boxes around the triangles at both hold them in between, too. All backends cast
these meshes in one loop on the CPU (deforming_loops.py), with the test of triangle.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from .arrays import Floats, Ints
from .crossing import Crossing, Nearest
from .tree import build_tree

_PAD = 1e-6  # of the mesh's size, around boxes: far more than rounding to float32
_LEAF_SIZE = 4


@dataclass(frozen=True, eq=False)
class Deforming:
    """A mesh whose vertices move straight from frame to frame: a shape of `Moving`.

    Frame 1.5 is half way from the second. Before the first and after the last it stays as it is.

    Attributes
    ----------
    vertices
        float64 (f, v, 3), metres: at least two frames.
    faces
        int64 (t, 3).
    """

    vertices: Floats
    faces: Ints
    on_device: ClassVar[bool] = False  # as of `RayCaster`

    @property
    def box(self) -> Floats:
        """Low and high corner of all frames: (2, 3)."""
        return np.stack([self.vertices.min(axis=(0, 1)), self.vertices.max(axis=(0, 1))])

    def strike(self, crossing: Crossing, nearest: Nearest) -> None:
        """See `RayCaster.strike`; of equally close triangles the lowest is hit."""
        from . import deforming_loops as loops

        given = map(np.ascontiguousarray, (crossing.row, crossing.body, crossing.number))
        frames = crossing.poses, crossing.frame, np.array(crossing.limits, np.float64)
        loops.strike(crossing.rays, *given, *frames, *self._tables, *nearest)

    @cached_property
    def _tables(self) -> tuple[Any, ...]:
        """Vertices, faces and the tree, see `deforming_loops.strike`."""
        from . import deforming_loops as loops

        vertices = np.ascontiguousarray(self.vertices)
        faces = np.ascontiguousarray(self.faces)
        box = self.box
        local = (vertices[0] - box.mean(axis=0)) / max(float(np.ptp(box, axis=0).max()), 1e-300)
        tree = build_tree(local[faces], loops.WIDTH, _LEAF_SIZE)
        boxes = np.empty((len(vertices) - 1, len(tree.child), 6, loops.WIDTH), np.float32)
        pad = _PAD * float(np.abs(box).max())
        loops.fit(vertices, faces, tree.order, tree.child, pad, boxes)
        return vertices, faces, tree.order, tree.child, boxes
