"""Meshes in many places, each kept once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..base.arguments import checked_fields
from .mesh import Mesh
from .transform import Transform

BLOCK_POINTS = 1 << 21  # points that are placed at a time

Float = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
@checked_fields
class Instance:
    """A mesh in a place; any number of instances share one.

    Parameters
    ----------
    mesh
        In its own axes.
    transform
        (4, 4), takes the mesh's coordinates to the world's, metres. It may turn, move, mirror and
        scale, also unevenly. Or a `lidarpool.scene.transform.Transform`.
    name
        Of the object; by default the mesh's.

    Raises
    ------
    LidarpoolError
        If the transform is not that of a place, or flattens the mesh.
    """

    mesh: Mesh
    transform: ArrayLike | Transform
    name: str = ""

    def __post_init__(self) -> None:
        given = self.transform
        placed = given if isinstance(given, Transform) else Transform.from_matrix(given)
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = placed.linear, placed.offset
        object.__setattr__(self, "transform", matrix)
        object.__setattr__(self, "name", self.name or self.mesh.name)

    @property
    def matrix(self) -> Float:
        """Its transform as a matrix, (4, 4)."""
        return np.asarray(self.transform)

    def moved(self, name: str, linear: Float, offset: Float) -> Instance:
        """Return it under a name, its place taken through p -> linear @ p + offset."""
        matrix = np.eye(4)
        matrix[:3, :3] = linear @ self.matrix[:3, :3]
        matrix[:3, 3] = linear @ self.matrix[:3, 3] + offset
        return Instance(self.mesh, matrix, name)

    def flat(self) -> Mesh:
        """Its triangles where they are."""
        return self.mesh.moved(self.name, self.matrix[:3, :3], self.matrix[:3, 3])


class Part(NamedTuple):
    """Triangles that instances share, all opaque or all with one mask."""

    vertices: Float  # (v, 3), in the axes of their mesh
    faces: NDArray[np.int32]  # (f, 3)
    mask: NDArray[np.bool_] | None = None  # (h, w), see `Cutout`
    uv: NDArray[np.float32] | None = None  # (f, 3, 2)


def parts_of(mesh: Mesh) -> Iterator[Part]:
    """Divide a mesh by its masks; the triangles stay in order."""
    start = len(mesh.faces) - sum(len(cut.uv) for cut in mesh.cutouts)
    if start:
        yield Part(*_used(mesh.vertices, mesh.faces[:start]))
    for cut in mesh.cutouts:
        stop = start + len(cut.uv)
        yield Part(*_used(mesh.vertices, mesh.faces[start:stop]), cut.mask, cut.uv)
        start = stop


def _used(vertices: Float, faces: NDArray[Any]) -> tuple[Float, NDArray[np.int32]]:
    used, corners = np.unique(faces, return_inverse=True)
    return vertices[used], corners.reshape(-1, 3).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Instances:
    """Parts of meshes in their places.

    Attributes
    ----------
    parts
        Each once.
    part
        intp (n,): number of each instance's part.
    transforms
        float64 (n, 3, 4): from the axes of the part to the scene's local coordinates.
    owner
        int32 (n,): object of each instance.
    """

    parts: tuple[Part, ...]
    part: NDArray[np.intp]
    transforms: Float
    owner: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.part)

    @cached_property
    def sizes(self) -> NDArray[np.int64]:
        """Triangles of each instance, (n,)."""
        return np.array([len(part.faces) for part in self.parts], np.int64)[self.part]

    @property
    def triangles(self) -> int:
        """Triangles of all instances."""
        return int(self.sizes.sum())

    def placed(self) -> Iterator[tuple[NDArray[np.intp], Float]]:
        """Vertices of some instances (k,) of one part, local to the scene: (k, v, 3)."""
        for number, part in enumerate(self.parts):
            rows = np.flatnonzero(self.part == number)
            step = max(1, BLOCK_POINTS // len(part.vertices))
            for begin in range(0, len(rows), step):
                some = rows[begin : begin + step]
                turn, move = self.transforms[some, :, :3], self.transforms[some, :, 3]
                yield some, part.vertices @ turn.transpose(0, 2, 1) + move[:, None]

    @cached_property
    def bounds(self) -> Float:
        """Lowest and highest corner of each instance, local: (n, 2, 3)."""
        out = np.empty((len(self), 2, 3))
        for rows, points in self.placed():
            out[rows] = np.stack([points.min(axis=1), points.max(axis=1)], axis=1)
        return out

    def reach(self, centres: Float) -> Float:
        """Farthest that each instance is from a point of its own (n, 2), seen from above: (n,)."""
        out = np.empty(len(self))
        for rows, points in self.placed():
            out[rows] = np.linalg.norm(points[..., :2] - centres[rows, None], axis=2).max(axis=1)
        return out

    def moved(self, owner: int, position: Float, rotation: Float | None) -> Instances:
        """Return them with the instances of an object in another place, at their present scale."""
        transforms = self.transforms.copy()
        turn = np.eye(3) if rotation is None else rotation
        for row in np.flatnonzero(self.owner == owner):
            # What is left of a transform when its rotation is taken away (polar decomposition).
            left, lengths, right = np.linalg.svd(transforms[row, :, :3])
            scaled = (right.T * lengths) @ right * np.sign(np.linalg.det(left @ right))
            transforms[row] = np.column_stack([turn @ scaled, position])
        return replace(self, transforms=transforms)
