"""Named triangle meshes, which are read from mesh files or generated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from ..errors import LidarError
from ..numerics.arrays import AnyArray, AnyFloats, Bools, Floats, Floats32, Integers, Ints
from ..numerics.vectors import determinant, matmul, norm, rank, rotate
from ..schema.checks import as_array, check_fields
from ..schema.value_texts import one_line
from .animation import Animation
from .colors import Colors
from .face_materials import FaceMaterials

MAX_UV = 1 << 30  # larger texture coordinates have no fractional digits in single precision
MAX_VOXELS = 10_000  # per axis, since a ray takes a step for each voxel
MAX_LEAF_DENSITY = 1e4  # leaf area density, m²/m³


@dataclass(frozen=True, eq=False)
class Cutout:
    """An opacity mask for faces that block light only partly, such as leaves or a wire fence.

    Attributes
    ----------
    mask
        True where light is blocked. Shape (h, w), bool.
    uv
        Texture coordinates of the corners of k faces. Shape (k, 3, 2), float32. As in glTF, (0, 0)
        is the outer corner of the first mask element, u increases along the rows of the mask, v
        increases along its columns, and the mask repeats beyond its edges.
    """

    mask: Bools
    uv: Floats32


@dataclass(frozen=True, eq=False)
class Voxels:
    """A grid of leaf densities inside a closed surface.

    There are no leaves outside the surface.

    Attributes
    ----------
    density
        One-sided leaf area per volume in m²/m³. Values are finite and nonnegative. Shape
        (nx, ny, nz), float32.
    matrix
        Transform from grid coordinates to mesh coordinates. In grid coordinates, voxels are unit
        cubes, and the first voxel starts at zero. Shape (3, 4), float64.
    """

    density: Floats32
    matrix: Floats

    def affine_transform(self, linear: Floats, offset: Floats) -> Voxels:
        """Return the voxels transformed by p -> linear @ p + offset.

        The leaf area per volume does not change.
        """
        shift = np.pad(offset[:, None], ((0, 0), (3, 0)))
        return Voxels(self.density, matmul(linear, self.matrix) + shift)


@dataclass(frozen=True, eq=False)
class SceneMesh:
    """Triangle mesh of an object in world coordinates.

    Parameters
    ----------
    name
        Name of the object.
    vertices
        Finite coordinates in meters, with z pointing up. Shape (v, 3), float64.
    faces
        Indices into `vertices`. At least one face is required. Shape (f, 3), int64.
    cutouts
        Cutouts of the last faces, in the order of these faces.
    colors
        Colors of the faces (`lidarsim.scene.colors.Colors`), or None.
    voxels
        Leaf densities within the surface of the mesh, which must be closed and have no cutouts.
    animation
        Motion of the vertices, which applies if the mesh belongs to an actor. Otherwise, the mesh
        is static and has the shape defined by `vertices`.
    materials
        Material names of the faces (`lidarsim.scene.face_materials.FaceMaterials`), or None.

    Raises
    ------
    LidarError
        If there are no triangles, a shape is wrong, a coordinate is not finite, or a face refers to
        a vertex that does not exist.
    """

    name: str
    vertices: Floats
    faces: Ints
    cutouts: tuple[Cutout, ...] = ()
    colors: Colors | None = None
    voxels: Voxels | None = None
    animation: Animation | None = None
    materials: FaceMaterials | None = None

    __repr__ = one_line

    def __post_init__(self) -> None:
        check_fields(self)
        object.__setattr__(self, "vertices", points_array(self.name, self.vertices))
        faces = np.asarray(self.faces)
        if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
            raise LidarError(
                f"The faces of {self.name!r} must be integers of the shape (f, 3), but are "
                f"{faces.dtype} of the shape {faces.shape}."
            )
        if not len(faces):
            raise LidarError(f"Object {self.name!r} has no triangles.")
        if faces.min() < 0 or faces.max() >= len(self.vertices):
            raise LidarError(
                f"The faces of {self.name!r} refer to vertices {faces.min()} to {faces.max()}, but "
                f"there are {len(self.vertices)} vertices, counted from 0."
            )
        object.__setattr__(self, "faces", np.ascontiguousarray(faces, dtype=np.int64))
        object.__setattr__(self, "cutouts", tuple(self.cutouts))
        _check_cutouts(self.name, self.cutouts, len(faces))
        if self.colors is not None:
            self.colors.check(self.name, len(faces))
        if self.materials is not None:
            self.materials.check(self.name, len(faces))
        if self.voxels is not None:
            _check_voxels(self.name, self.voxels)
            if self.cutouts:
                raise LidarError(f"{self.name!r} cannot have both voxels and cutouts.")
        if self.animation is not None:
            moving = self.animation.vertices.shape[1]
            if moving != len(self.vertices) or self.cutouts or self.voxels is not None:
                raise LidarError(
                    f"{self.name!r} has {len(self.vertices)} vertices, but its animation moves "
                    f"{moving}. An animation must move all vertices of a mesh without cutouts and "
                    "voxels."
                )

    @cached_property
    def bounds(self) -> Floats:
        """Minimum and maximum coordinates in meters.

        The shape is (2, 3).
        """
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    @cached_property
    def has_area(self) -> bool:
        """Whether any triangle has a nonzero area, or the mesh is animated."""
        blocks = (
            self.vertices[self.faces[i : i + 65536]] for i in range(0, len(self.faces), 65536)
        )
        edges = (block[:, 1:] - block[:, :1] for block in blocks)
        return self.animation is not None or any(np.cross(*e.swapaxes(0, 1)).any() for e in edges)

    def affine_transform(self, name: str, linear: Floats, offset: Floats) -> SceneMesh:
        """Return a renamed copy of the mesh that is transformed by p -> linear @ p + offset."""
        faces = self.faces
        cutouts = self.cutouts
        colors = self.colors
        if determinant(linear) < 0:
            faces = faces[:, ::-1]
            cutouts = tuple(replace(cut, uv=cut.uv[:, ::-1]) for cut in cutouts)
            colors = colors and colors.reverse_corners()
        voxels = self.voxels and self.voxels.affine_transform(linear, offset)
        animation = self.animation and self.animation.affine_transform(linear, offset)
        vertices = rotate(self.vertices, linear) + offset
        return SceneMesh(
            name=name,
            vertices=vertices,
            faces=faces,
            cutouts=cutouts,
            colors=colors,
            voxels=voxels,
            animation=animation,
            materials=self.materials,
        )


def _check_voxels(name: str, voxels: Voxels) -> None:
    density = voxels.density
    matrix = voxels.matrix
    valid = density.dtype == np.float32 and density.ndim == 3 and density.size > 0
    valid = valid and max(density.shape) <= MAX_VOXELS
    valid = valid and bool(0 <= density.min() <= density.max() <= MAX_LEAF_DENSITY)
    valid = valid and matrix.shape == (3, 4) and bool(np.isfinite(matrix).all())
    if not valid or rank(matrix[:, :3]) < 3:
        raise LidarError(
            f"The voxels of {name!r} must be float32 (nx, ny, nz) from 0 to {MAX_LEAF_DENSITY:g} "
            f"m²/m³, with at most {MAX_VOXELS:,} along each axis and a finite, invertible (3, 4) "
            f"matrix, but are {density.dtype} {density.shape} with a matrix {matrix.shape}."
        )


def _check_cutouts(name: str, cutouts: tuple[Cutout, ...], faces: int) -> None:
    for cut in cutouts:
        valid = cut.mask.dtype == np.bool_ and cut.mask.ndim == 2 and cut.mask.size > 0
        valid = valid and cut.uv.shape[1:] == (3, 2) and len(cut.uv) > 0
        if not valid or not (np.abs(cut.uv) < MAX_UV).all():
            raise LidarError(
                f"A cutout of {name!r} must have a bool mask (h, w) and uv (k, 3, 2) within "
                f"{MAX_UV:,}, but has a mask {cut.mask.dtype} {cut.mask.shape} and uv "
                f"{cut.uv.shape}."
            )
    if (cutout_faces := sum(len(cut.uv) for cut in cutouts)) > faces:
        raise LidarError(f"{name!r} has {faces} faces, but its cutouts have {cutout_faces}.")


def stack_meshes(meshes: Iterable[tuple[AnyArray, AnyArray]]) -> tuple[AnyArray, AnyArray]:
    """Concatenate the vertices and faces of meshes, renumbering the faces accordingly.

    Vertices have shape (v, 3), and faces have shape (f, 3).
    """
    vertices = []
    faces = []
    offset = 0
    for points, corners in meshes:
        vertices.append(points)
        faces.append(corners + offset)
        offset += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def drop_unused_vertices(vertices: AnyArray, faces: Integers) -> tuple[AnyArray, Ints]:
    """Remove unused vertices, renumbering the faces accordingly.

    The order of the remaining vertices does not change.
    """
    if faces.size < len(vertices):
        used, corners = np.unique(faces, return_inverse=True)
        return vertices[used], corners.reshape(-1, 3)
    is_used = np.zeros(len(vertices), np.bool_)
    is_used[faces] = True
    if is_used.all():
        return vertices, np.asarray(faces, np.int64)
    return vertices[is_used], (np.cumsum(is_used) - 1)[faces]


def points_array(name: str, points: ArrayLike) -> Floats:
    """Convert points to a contiguous float64 array and check that all coordinates are finite.

    The shape is (n, 3). The object `name` appears in error messages.

    Raises
    ------
    LidarError
        If the shape is wrong, or if a number is NaN or infinite.
    """
    array = np.ascontiguousarray(as_array(f"vertices of {name!r}", points))
    if array.ndim != 2 or array.shape[1] != 3:
        raise LidarError(
            f"The vertices of {name!r} must have the shape (v, 3), but have {array.shape}."
        )
    bad = ~np.isfinite(array).all(axis=1)
    if bad.any():
        raise LidarError(
            f"{int(bad.sum())} of the {len(array)} vertices of {name!r} are NaN or infinite. The "
            f"first is vertex {int(bad.argmax())}. Repair the mesh."
        )
    return array


def triangle_areas(corners: AnyFloats) -> Floats:
    """Return the areas of triangles.

    `corners` has shape (n, 3, 3), and the result has shape (n,).
    """
    sides = corners[:, 1:] - corners[:, :1]
    doubled = norm(np.cross(sides[:, 0], sides[:, 1]))
    return np.asarray(doubled / 2, np.float64)
