"""Meshes whose vertices move between frames.

A ray hits such a mesh in the shape that the mesh has when the ray is fired. One tree over the
triangles, which is built once, serves all times: each vertex moves along a straight line between
two frames, so a box that encloses a triangle at both frames also encloses it in between. All
backends cast rays at these meshes with a compiled loop on the CPU (deforming_loops.py), which uses
the intersection test in triangle.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from .arrays import Floats, Ints
from .body_rays import NearestHits, RayBodyPairs
from .tree import build_tree

if TYPE_CHECKING:
    from .deforming_loops import DeformingTree

_PAD = 1e-6  # padding of boxes relative to the mesh's size, much more than float32 rounding errors
_LEAF_SIZE = 4


@dataclass(frozen=True, eq=False)
class DeformingMesh:
    """A mesh whose vertices move linearly between frames, used as a shape in `MovingBodies`.

    Frame numbers start at 0, and frame 1.5 is halfway between the second and the third frame. The
    mesh keeps its shape before the first and after the last frame.

    Attributes
    ----------
    vertices
        float64 (f, v, 3): vertices at each of at least two frames, in meters.
    faces
        int64 (t, 3): indices of the vertices of each triangle.
    """

    vertices: Floats
    faces: Ints
    on_device: ClassVar[bool] = False  # as `RayCaster.on_device`

    @property
    def box(self) -> Floats:
        """Lower and upper corners of a bounding box around all frames, in meters. Shape (2, 3)."""
        return np.stack([self.vertices.min(axis=(0, 1)), self.vertices.max(axis=(0, 1))])

    def cast_pairs(self, pairs: RayBodyPairs, nearest: NearestHits) -> None:
        """Cast rays at bodies that have this shape, and record closer hits in `nearest`.

        Ties are resolved in favor of the lowest triangle index.
        """
        from . import deforming_loops as loops

        loops.cast_pairs(pairs.contiguous(), self._tree, nearest)

    @cached_property
    def _tree(self) -> DeformingTree:
        """The mesh and its tree, as required by the compiled loop."""
        from . import deforming_loops as loops

        vertices = np.ascontiguousarray(self.vertices)
        faces = np.ascontiguousarray(self.faces)
        box = self.box
        local = (vertices[0] - box.mean(axis=0)) / max(float(np.ptp(box, axis=0).max()), 1e-300)
        tree = build_tree(local[faces], loops.WIDTH, _LEAF_SIZE)
        boxes = np.empty((len(vertices) - 1, len(tree.child), 6, loops.WIDTH), np.float32)
        pad = _PAD * float(np.abs(box).max())
        loops.fit_boxes(vertices, faces, tree.order, tree.child, pad, boxes)
        return loops.DeformingTree(vertices, faces, tree.order, tree.child, boxes)
