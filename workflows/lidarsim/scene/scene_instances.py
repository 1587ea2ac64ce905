"""Instances, which place the same mesh in a scene several times."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import LidarError
from ..motion.trajectory import Pose
from ..numerics.arrays import Bools, Floats, Floats32, Indices, Integers, Ints, Ints32
from ..numerics.elementary import decade
from ..numerics.vectors import determinant, inverse, matmul, matvec, rank
from ..schema.checks import check_fields
from ..schema.value_texts import one_line
from .colors import Colors
from .face_materials import FaceMaterials
from .scene_mesh import Cutout, SceneMesh, Voxels, drop_unused_vertices
from .transform import Transform, affine

# No point on Earth is farther from the origin of its map. `sections.Coordinate` has the same limit.
MAX_COORDINATE_M = 1e8
_MAX_ITERATIONS = 64  # of Newton's method
BLOCK_POINTS = 1 << 15  # points that are transformed at a time, so that they fit in the CPU cache


@dataclass(frozen=True, eq=False)
class SceneInstance:
    """A placement of a mesh in the world.

    Any number of instances can share a mesh.

    Parameters
    ----------
    mesh
        The mesh in its own frame.
    transform
        Pose of the mesh frame in world coordinates, a matrix of shape (4, 4), or a
        `lidarsim.scene.transform.Transform`. A matrix transforms mesh coordinates to world
        coordinates in meters. It can rotate, translate, mirror and scale the mesh, also
        non-uniformly.
    name
        Name of the object. The default is the name of the mesh.

    Raises
    ------
    LidarError
        If the transform is not affine, not finite, or not invertible.
    """

    mesh: SceneMesh
    transform: ArrayLike | Transform | Pose
    name: str = ""

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        transform = self.transform
        if isinstance(transform, Pose):
            transform = Transform(transform.rotation_matrix, np.array(transform.position))
        if not isinstance(transform, Transform):
            transform = Transform.from_matrix(transform)
        check_coordinate(transform.offset)
        object.__setattr__(self, "transform", affine(transform.linear, transform.offset))
        object.__setattr__(self, "name", self.name or self.mesh.name)

    @classmethod
    def from_matrices(cls, mesh: SceneMesh, transforms: Floats, name: str) -> list[SceneInstance]:
        """Create one instance of a mesh for each transformation matrix.

        Validating the matrices together is faster than creating the instances one by one.

        Parameters
        ----------
        mesh
            The mesh in its own frame.
        transforms
            Matrices as in `SceneInstance`. Shape (n, 4, 4).
        name
            Name of the instances.

        Raises
        ------
        LidarError
            If a matrix is not valid for a `SceneInstance`.
        """
        linear = transforms[:, :3, :3]
        offsets = transforms[:, :3, 3]
        valid = np.isfinite(transforms).all() and (np.abs(offsets) <= MAX_COORDINATE_M).all()
        if not valid or (rank(linear) < 3).any():
            for matrix in transforms:
                cls(mesh, matrix, name)
        instances = [object.__new__(cls) for _ in transforms]
        for instance, matrix in zip(instances, transforms, strict=True):
            vars(instance).update(mesh=mesh, transform=matrix, name=name)
        return instances

    @property
    def matrix(self) -> Floats:
        """The transform as a matrix of shape (4, 4)."""
        return np.asarray(self.transform)

    def affine_transform(self, name: str, linear: Floats, offset: Floats) -> SceneInstance:
        """Return a renamed instance that is transformed by p -> linear @ p + offset."""
        position = matvec(linear, self.matrix[:3, 3]) + offset
        return SceneInstance(self.mesh, affine(matmul(linear, self.matrix[:3, :3]), position), name)

    def flat(self) -> SceneMesh:
        """Return a copy of the mesh in world coordinates."""
        return self.mesh.affine_transform(self.name, self.matrix[:3, :3], self.matrix[:3, 3])


def check_coordinate(position: Floats) -> None:
    """Raise LidarError if a coordinate of a position exceeds `MAX_COORDINATE_M`."""
    if not (np.abs(position) <= MAX_COORDINATE_M).all():
        raise LidarError(
            f"The position of an instance must be in meters and within {MAX_COORDINATE_M:g} of "
            f"zero, but is {np.asarray(position).tolist()}."
        )


class MeshPart(NamedTuple):
    """Triangles shared by instances.

    They are either all opaque or have the same mask.
    """

    vertices: Floats  # (v, 3), in the frame of the mesh
    faces: Ints32  # (f, 3)
    mask: Bools | None = None  # (h, w), as in `Cutout`
    uv: Floats32 | None = None  # (f, 3, 2)
    colors: Colors | None = None
    voxels: Voxels | None = None  # leaves within the surface
    materials: FaceMaterials | None = None  # with the names of all materials in the mesh


def split_by_masks(mesh: SceneMesh) -> Iterator[MeshPart]:
    """Divide a mesh by its masks and yield the parts in triangle order."""
    start = len(mesh.faces) - sum(len(cut.uv) for cut in mesh.cutouts)

    def part(first: int, stop: int, cut: Cutout | None = None) -> MeshPart:
        rows = slice(first, stop)
        return MeshPart(
            *_drop_unused_vertices(mesh.vertices, mesh.faces[rows]),
            mask=None if cut is None else cut.mask,
            uv=None if cut is None else cut.uv,
            colors=mesh.colors and mesh.colors.take(rows),
            voxels=mesh.voxels,
            materials=mesh.materials and mesh.materials.take(rows),
        )

    if start:
        yield part(0, start)
    for cut in mesh.cutouts:
        yield part(start, start + len(cut.uv), cut)
        start += len(cut.uv)


def _drop_unused_vertices(vertices: Floats, faces: Ints) -> tuple[Floats, Ints32]:
    """Remove unused vertices and return the renumbered faces as int32."""
    points, corners = drop_unused_vertices(vertices, faces)
    return points, corners.astype(np.int32)


@dataclass(frozen=True, eq=False)
class Instances:
    """Mesh parts and their instances in a scene.

    Attributes
    ----------
    mesh_parts
        Mesh parts, each of which is stored once.
    part
        Index of the mesh part of each instance. Shape (n,), intp.
    transforms
        Transforms from the frame of the part to the local coordinates of the scene. Shape
        (n, 3, 4), float64.
    owner
        Index of the object to which each instance belongs. Shape (n,), int32.
    """

    mesh_parts: tuple[MeshPart, ...]
    part: Indices
    transforms: Floats
    owner: Ints32
    # Earlier bounds, (n, 2, 3), and whether each instance has moved since they were computed, (n,)
    _earlier_bounds: tuple[Floats, Bools] | None = field(default=None, init=False)

    def __len__(self) -> int:
        return len(self.part)

    @cached_property
    def _by_owner(self) -> tuple[Indices, Ints32]:
        """Instance indices sorted by object, and the sorted object indices.

        Both have shape (n,).
        """
        order = np.argsort(self.owner, kind="stable")
        return order, self.owner[order]

    def rows_of(self, owners: Integers) -> tuple[Indices, Indices]:
        """Return the indices of all instances of the given objects.

        `owners` contains unique object indices and has shape (k,). The instances are in the order
        of `owners`. The second array contains the index into `owners` for each instance. Both
        arrays have shape (m,).
        """
        order, sorted_owners = self._by_owner
        starts = np.searchsorted(sorted_owners, owners, "left")
        counts = np.searchsorted(sorted_owners, owners, "right") - starts
        index = np.repeat(np.arange(len(owners)), counts)
        offset = np.arange(len(index)) - (np.cumsum(counts) - counts)[index]
        return order[starts[index] + offset], index

    @cached_property
    def sizes(self) -> Ints:
        """Number of triangles of each instance.

        The shape is (n,).
        """
        return np.array([len(part.faces) for part in self.mesh_parts], np.int64)[self.part]

    @property
    def triangles(self) -> int:
        """Total number of triangles of all instances."""
        return int(self.sizes.sum())

    def owners(self, condition: Callable[[MeshPart], bool]) -> Ints32:
        """Return the object indices of the instances whose parts satisfy a condition.

        Indices are repeated if several of these instances belong to the same object.
        """
        fulfilled = np.array([condition(part) for part in self.mesh_parts], np.bool_)
        return self.owner[fulfilled[self.part]]

    def vertex_blocks(self) -> Iterator[tuple[Indices, Floats]]:
        """Yield the instances of each part in blocks, with their vertices in local coordinates.

        Instance indices have shape (k,), and vertices have shape (k, 3, v).
        """
        for number in np.unique(self.part):
            part = self.mesh_parts[number]
            rows = np.flatnonzero(self.part == number)
            step = max(1, BLOCK_POINTS // len(part.vertices))
            for start in range(0, len(rows), step):
                block = rows[start : start + step]
                points = np.empty((len(block), 3, len(part.vertices)))
                x, y, z = part.vertices.T
                # Unlike a matrix product, elementwise operations have the same result on all
                # machines. They are also faster.
                for row in range(3):
                    a, b, c, d = self.transforms[block, row].T[:, :, None]
                    points[:, row] = a * x + b * y + c * z + d
                yield block, points

    @cached_property
    def bounds(self) -> Floats:
        """Bounding box of each instance in local coordinates, in meters.

        The shape is (n, 2, 3).
        """
        if self._earlier_bounds is not None:
            earlier, changed = self._earlier_bounds
            corners = earlier.copy()
            rows = np.flatnonzero(changed)
            corners[rows] = replace(
                self,
                part=self.part[rows],
                transforms=self.transforms[rows],
                owner=self.owner[rows],
            ).bounds
            return corners
        corners = np.empty((len(self), 2, 3))
        for rows, points in self.vertex_blocks():
            corners[rows] = np.stack([points.min(axis=2), points.max(axis=2)], axis=1)
        return corners

    def reach(self, centers: Floats) -> Floats:
        """Return each instance's horizontal radius around the given center.

        `centers` has shape (n, 2), and the result has shape (n,).
        """
        radii = np.empty(len(self))
        for rows, points in self.vertex_blocks():
            x, y = np.moveaxis(points[:, :2] - centers[rows, :, None], 1, 0)
            radii[rows] = np.sqrt((x * x + y * y).max(axis=1))
        return radii

    def relative_to(self, origin: Floats) -> Instances:
        """Return the instances in coordinates relative to an origin."""
        bounds = self.bounds - origin
        shift = np.pad(origin[:, None], ((0, 0), (3, 0)))
        instances = replace(self, transforms=self.transforms - shift)
        vars(instances)["bounds"] = bounds  # faster than computing them from the vertices again
        return instances

    @cached_property
    def _scales(self) -> _Scales:
        """Cache of the scales of moved instances.

        All copies of the instances share the cache, since moving an instance does not change its
        scale.
        """
        return _Scales(np.zeros((len(self), 3, 3)), np.zeros(len(self), np.bool_))

    def _scales_of(self, instance_indices: Indices) -> Floats:
        scales, is_known = self._scales
        unknown = instance_indices[~is_known[instance_indices]]
        if len(unknown):
            scales[unknown] = polar_scales(self.transforms[unknown, :, :3])
            is_known[unknown] = True
        return np.asarray(scales[instance_indices])

    def with_poses(
        self, instance_indices: Indices, positions: Floats, rotations: Floats
    ) -> Instances:
        """Return the instances with some of them moved to new poses.

        Moved instances keep their scales.

        Parameters
        ----------
        instance_indices
            Unique indices of the instances to move. Shape (m,).
        positions
            New positions in local coordinates, in meters. Shape (m, 3).
        rotations
            New rotation matrices. Shape (m, 3, 3).

        Raises
        ------
        LidarError
            If a position is too far from zero.
        """
        if not (np.abs(positions) <= MAX_COORDINATE_M).all():
            for position in positions:
                check_coordinate(position)
        linear = matmul(rotations, self._scales_of(instance_indices))
        transforms = self.transforms.copy()
        transforms[instance_indices] = np.concatenate([linear, positions[:, :, None]], axis=2)
        instances = copy(self)
        object.__setattr__(instances, "transforms", transforms)
        earlier_bounds = self._earlier_bounds
        # Computing bounds is expensive, so only the bounds of moved instances are computed again,
        # and only when they are needed.
        bounds = vars(instances).pop("bounds", None)
        if bounds is not None:
            earlier_bounds = bounds, np.zeros(len(self), np.bool_)
        if earlier_bounds is not None:
            bounds, changed = earlier_bounds
            changed = changed.copy()
            changed[instance_indices] = True
            earlier_bounds = bounds, changed
        object.__setattr__(instances, "_earlier_bounds", earlier_bounds)
        return instances


class _Scales(NamedTuple):
    """A cache of instance scales, which are computed on demand."""

    scales: Floats  # (n, 3, 3)
    is_known: Bools  # (n,)


def polar_scales(matrices: Floats) -> Floats:
    """Compute the scaling, including mirroring, of each matrix by polar decomposition.

    Matrices and scales have shape (m, 3, 3). The rotation is computed by Newton's method (Higham
    1986). The result is rounded to 12 digits, so that a scale factor of 1.4 remains 1.4 no matter
    how often an instance is moved.
    """
    rotations = matrices
    for _ in range(_MAX_ITERATIONS):
        previous = rotations
        rotations = (rotations + inverse(rotations).transpose(0, 2, 1)) / 2
        if (rotations == previous).all():
            break
    scales = matmul(rotations.transpose(0, 2, 1), matrices)
    scales = (
        (scales + scales.transpose(0, 2, 1)) / 2 * np.sign(determinant(rotations))[:, None, None]
    )
    digits = [11 - decade(largest) for largest in np.abs(scales).max(axis=(1, 2)).tolist()]
    rounded = [np.round(scale, count) for scale, count in zip(scales, digits, strict=True)]
    return np.array(rounded) + 0.0
