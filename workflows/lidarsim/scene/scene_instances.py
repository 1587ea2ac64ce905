"""Meshes in many places, each kept once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..base.arrays import Bools, Floats, Floats32, Indices, Ints, Ints32
from ..base.elementary import decade
from ..base.errors import LidarError
from ..base.validation import checked_fields
from ..base.vectors import applied, determinant, inverse, matmul, rank
from ..sensor import Pose
from .colours import Colours
from .face_materials import FaceMaterials
from .scene_mesh import Cutout, SceneMesh, Voxels, compacted
from .transform import Transform, affine

# Nothing on Earth is farther from the origin of its map; see also `sections.Coordinate`.
FARTHEST_M = 1e8
_ROUNDS = 64  # of Newton's method at most
BLOCK_POINTS = 1 << 15  # points that are placed at a time, to fit a cache


@dataclass(frozen=True, eq=False)
@checked_fields
class SceneInstance:
    """A mesh in a place; any number of instances share one.

    Parameters
    ----------
    mesh
        In its own axes.
    transform
        A pose of the mesh's axes in world coordinates. Or (4, 4), takes the mesh's coordinates to
        the world's, metres: it may turn, move, mirror and scale, also unevenly. Or a
        `lidarsim.scene.transform.Transform`.
    name
        Of the object; by default the mesh's.

    Raises
    ------
    LidarError
        If the transform is not that of a place, or flattens the mesh.
    """

    mesh: SceneMesh
    transform: ArrayLike | Transform | Pose
    name: str = ""

    def __post_init__(self) -> None:
        given = self.transform
        if isinstance(given, Pose):
            given = Transform(given.rotation_matrix, np.array(given.position))
        placed = given if isinstance(given, Transform) else Transform.from_matrix(given)
        check_near(placed.offset)
        object.__setattr__(self, "transform", affine(placed.linear, placed.offset))
        object.__setattr__(self, "name", self.name or self.mesh.name)

    @classmethod
    def several(cls, mesh: SceneMesh, transforms: Floats, name: str) -> list[SceneInstance]:
        """Instances of a mesh at (n, 4, 4), checked all at once; LidarError as of one."""
        linear = transforms[:, :3, :3]
        well = np.isfinite(transforms).all() and (np.abs(transforms[:, :3, 3]) <= FARTHEST_M).all()
        if not well or (rank(linear) < 3).any():
            for matrix in transforms:
                cls(mesh, matrix, name)
        made = [object.__new__(cls) for _ in transforms]
        for one, matrix in zip(made, transforms, strict=True):
            vars(one).update(mesh=mesh, transform=matrix, name=name)
        return made

    @property
    def matrix(self) -> Floats:
        """Its transform as a matrix, (4, 4)."""
        return np.asarray(self.transform)

    def moved(self, name: str, linear: Floats, offset: Floats) -> SceneInstance:
        """Return it under a name, its place taken through p -> linear @ p + offset."""
        place = applied(linear, self.matrix[:3, 3]) + offset
        return SceneInstance(self.mesh, affine(matmul(linear, self.matrix[:3, :3]), place), name)

    def flat(self) -> SceneMesh:
        """Its triangles where they are."""
        return self.mesh.moved(self.name, self.matrix[:3, :3], self.matrix[:3, 3])


def check_near(position: Floats) -> None:
    """Check that a place (3,) is on Earth; LidarError if it is farther than `FARTHEST_M`."""
    if not (np.abs(position) <= FARTHEST_M).all():
        raise LidarError(
            f"An instance cannot be at {np.asarray(position).tolist()}: give metres within "
            f"{FARTHEST_M:g} of zero."
        )


class MeshPart(NamedTuple):
    """Triangles that instances share, all opaque or all with one mask."""

    vertices: Floats  # (v, 3), in the axes of their mesh
    faces: Ints32  # (f, 3)
    mask: Bools | None = None  # (h, w), see `Cutout`
    uv: Floats32 | None = None  # (f, 3, 2)
    colours: Colours | None = None
    voxels: Voxels | None = None  # leaves within
    materials: FaceMaterials | None = None  # all names of their mesh


def parts_of(mesh: SceneMesh) -> Iterator[MeshPart]:
    """Divide a mesh by its masks; the triangles stay in order."""
    start = len(mesh.faces) - sum(len(cut.uv) for cut in mesh.cutouts)

    def part(first: int, stop: int, cut: Cutout | None = None) -> MeshPart:
        some = slice(first, stop)
        return MeshPart(
            *_used(mesh.vertices, mesh.faces[some]),
            mask=None if cut is None else cut.mask,
            uv=None if cut is None else cut.uv,
            colours=mesh.colours and mesh.colours.take(some),
            voxels=mesh.voxels,
            materials=mesh.materials and mesh.materials.take(some),
        )

    if start:
        yield part(0, start)
    for cut in mesh.cutouts:
        yield part(start, start + len(cut.uv), cut)
        start += len(cut.uv)


def _used(vertices: Floats, faces: Ints) -> tuple[Floats, Ints32]:
    points, corners = compacted(vertices, faces)
    return points, corners.astype(np.int32)


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

    parts: tuple[MeshPart, ...]
    part: Indices
    transforms: Floats
    owner: Ints32

    def __len__(self) -> int:
        return len(self.part)

    @cached_property
    def sizes(self) -> Ints:
        """Triangles of each instance, (n,)."""
        return np.array([len(part.faces) for part in self.parts], np.int64)[self.part]

    @property
    def triangles(self) -> int:
        """Triangles of all instances."""
        return int(self.sizes.sum())

    def owners(self, wanted: Callable[[MeshPart], bool]) -> Ints32:
        """Objects of the instances whose part is wanted."""
        some = np.array([wanted(part) for part in self.parts], np.bool_)
        return self.owner[some[self.part]]

    def placed(self) -> Iterator[tuple[Indices, Floats]]:
        """Vertices of some instances (k,) of one part, local to the scene: (k, 3, v)."""
        for number in np.unique(self.part):
            part = self.parts[number]
            rows = np.flatnonzero(self.part == number)
            step = max(1, BLOCK_POINTS // len(part.vertices))
            for begin in range(0, len(rows), step):
                some = rows[begin : begin + step]
                points = np.empty((len(some), 3, len(part.vertices)))
                x, y, z = part.vertices.T
                # Element by element, which has the same bits everywhere, unlike a product of
                # matrices, and is faster.
                for row in range(3):
                    a, b, c, d = self.transforms[some, row].T[:, :, None]
                    points[:, row] = a * x + b * y + c * z + d
                yield some, points

    @cached_property
    def bounds(self) -> Floats:
        """Lowest and highest corner of each instance, local: (n, 2, 3)."""
        out = np.empty((len(self), 2, 3))
        for rows, points in self.placed():
            out[rows] = np.stack([points.min(axis=2), points.max(axis=2)], axis=1)
        return out

    def reach(self, centres: Floats) -> Floats:
        """Farthest that each instance is from a point of its own (n, 2), seen from above: (n,)."""
        out = np.empty(len(self))
        for rows, points in self.placed():
            x, y = np.moveaxis(points[:, :2] - centres[rows, :, None], 1, 0)
            out[rows] = np.sqrt((x * x + y * y).max(axis=1))
        return out

    def moved(self, owner: int, position: Floats, turn: Floats) -> Instances:
        """Return them with those of an object in another place, at their present scale."""
        check_near(position)
        rows = np.flatnonzero(self.owner == owner)
        transforms = self.transforms.copy()
        for row in rows:
            transforms[row] = np.column_stack(
                [matmul(turn, scale_of(transforms[row, :, :3])), position]
            )
        made = copy(self)
        object.__setattr__(made, "transforms", transforms)
        if "bounds" in vars(self):  # those of all take long
            some = Instances(self.parts, self.part[rows], transforms[rows], self.owner[rows])
            bounds = vars(made)["bounds"] = self.bounds.copy()
            bounds[rows] = some.bounds
        return made


def scale_of(matrix: Floats) -> Floats:
    """Take the rotation off a matrix (3, 3), by polar decomposition: what it scales and mirrors.

    The rotation is found by Newton's method (Higham 1986).

    It is rounded to 12 digits: a factor of 1.4 stays one however often something is moved.
    """
    turn = matrix
    for _ in range(_ROUNDS):
        before = turn
        turn = (turn + inverse(turn).T) / 2
        if (turn == before).all():
            break
    scaled = matmul(turn.T, matrix)
    scaled = (scaled + scaled.T) / 2 * np.sign(determinant(turn))
    return np.asarray(np.round(scaled, 11 - decade(float(np.abs(scaled).max()))) + 0.0)
