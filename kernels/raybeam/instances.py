"""Meshes, their instances, and the scene that a caster makes of them.

Rays are cast in two levels. The scene has local coordinates of its own, and each mesh has its own
(`Frame`). At an instance, a matrix takes the ray from the first to the second, and the direction
there is made a unit vector again, so all that is known of rays and meshes in [-1, 1] holds: every
error bound, and that no ray slips between two triangles. Its distance is divided by the length
that the direction had.

All backends do these operations in float64, in the order of `Scene.enter`, without a fused
multiply-add.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Indices, Integers, Ints, Ints32
from .mesh import Frame, LocalMesh, local_mesh, middle
from .opacity import Opacity
from .tree import PAD

MOST_TRIANGLES = 2**28 - 1  # of all meshes: places in a tree have 31 bits, of which a leaf takes 3
_FLAT = 1e-9  # a transform that keeps less of its columns' volume is singular


class Mesh:
    """A triangle mesh that instances share.

    Parameters
    ----------
    vertices
        (v, 3) real numbers, metres. Large coordinates lose no precision: they are made local.
    faces
        (f, 3) integers, rows of `vertices`. A triangle without an area is never hit.
    opacity
        Which parts of the triangles stop a ray; None for all.

    Raises
    ------
    ValueError
        If the mesh or its opacity is not finite or of a wrong shape, or the mesh has faces
        without vertices, or no area.
    """

    def __init__(
        self, vertices: ArrayLike, faces: ArrayLike, opacity: Opacity | None = None
    ) -> None:
        self._local = local_mesh(vertices, faces, opacity)

    def __repr__(self) -> str:
        return f"Mesh({self.face_count} triangles)"

    @property
    def face_count(self) -> int:
        """Number of triangles given, including those without an area."""
        return self._local.face_count


@dataclass(frozen=True, eq=False)
class Instance:
    """A mesh in its place.

    Attributes
    ----------
    mesh
        Shared by any number of instances, which take hardly any memory.
    transform
        (3, 4), or (4, 4) with the last row 0, 0, 0, 1: takes the mesh's points to the scene's,
        metres. It may turn, move, mirror, shear and scale, also unevenly; None leaves the mesh in
        its place.
    """

    mesh: Mesh
    transform: ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """Instances as the backends need them.

    Attributes
    ----------
    meshes
        Each once, in the order in which instances use them.
    mesh
        intp (n,): number of each instance's mesh.
    frame
        Of the scene: the mesh's, if the scene is plain.
    matrices
        float64 (n, 12): rows of the (3, 4) matrix that takes points from the scene's local
        coordinates to the mesh's. None if the scene is plain: one mesh, in its place.
    boxes
        float64 (n, 2, 3): least and greatest coordinates of each instance, local to the scene.
    """

    meshes: tuple[LocalMesh, ...]
    mesh: Indices
    frame: Frame
    matrices: Floats | None
    boxes: Floats

    @property
    def nested(self) -> bool:
        """Whether rays have to be taken to the meshes' coordinates."""
        return self.matrices is not None

    @cached_property
    def first_face(self) -> Ints:
        """Where the faces of each mesh begin in a tally, and their number: (meshes + 1,)."""
        return np.cumsum([0, *(mesh.face_count for mesh in self.meshes)])

    @property
    def face_count(self) -> int:
        """Rows of a tally."""
        return int(self.first_face[-1])

    @property
    def counters(self) -> Ints:
        """First row of each instance's triangles in a tally, and the step to the next: (n, 2)."""
        first = self.first_face[:-1][self.mesh]
        return np.stack([first, np.ones_like(first)], axis=1)

    def to_scene(self) -> Floats:
        """Matrices (n, 3, 4) that take the meshes' local coordinates to the scene's."""
        assert self.matrices is not None
        matrices = self.matrices.reshape(-1, 3, 4)
        inverse, _ = _inverse(matrices[:, :, :3])
        move = -_product(inverse, matrices[:, :, 3])
        return np.concatenate([inverse, move[:, :, None]], axis=2)

    def tally_rows(self, instance: Ints32, triangle: Ints32) -> Integers:
        """Rows of a tally of triangles (k,) that instances (k,) show."""
        return self.first_face[self.mesh[instance]] + triangle if self.nested else triangle

    def enter(
        self, instance: Indices, origins: Floats, directions: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Take rays to the coordinates of the meshes of instances (m,); the scene is not plain.

        Parameters
        ----------
        origins, directions
            (m, 3), local to the scene; directions of about unit length.

        Returns
        -------
        origins, directions
            (m, 3), local to the mesh; unit directions.
        length
            (m,): of the directions before they were made unit vectors. A distance in the scene is
            one in the mesh divided by this.
        """
        assert self.matrices is not None
        rows = np.ascontiguousarray(self.matrices[instance].T).reshape(3, 4, -1)
        x, y, z = directions.T
        u, v, w = ((a * x + b * y) + c * z for a, b, c, _ in rows)
        length = np.sqrt((u * u + v * v) + w * w)
        x, y, z = origins.T
        moved = np.stack([((a * x + b * y) + c * z) + d for a, b, c, d in rows], axis=1)
        return moved, np.stack([u / length, v / length, w / length], axis=1), length


def plain(mesh: LocalMesh) -> Scene:
    """Make the scene of a mesh in its place."""
    frame = mesh.frame
    boxes = np.stack([frame.low, frame.high])[None]
    return Scene((mesh,), np.zeros(1, np.intp), frame, None, boxes)


def check_instances(instances: Sequence[Instance]) -> tuple[Scene, Floats]:
    """Make a scene of instances, and return it with their transforms (n, 3, 4).

    Raises
    ------
    ValueError
        If there is no instance, a transform is invalid, or the meshes have too many triangles.
    """
    given = list(instances)
    if not given:
        raise ValueError("There is no instance: a caster needs at least one.")
    transforms = np.stack([_matrix(k, one.transform) for k, one in enumerate(given)])
    _check_regular(0, transforms)
    numbers: dict[Mesh, int] = {}
    mesh = np.array([numbers.setdefault(one.mesh, len(numbers)) for one in given], np.intp)
    meshes = tuple(mesh._local for mesh in numbers)
    total = sum(mesh.face_count for mesh in meshes)
    if total > MOST_TRIANGLES:
        raise ValueError(f"{total:,} triangles are too many: the limit is {MOST_TRIANGLES:,}.")
    if len(given) == 1 and given[0].transform is None:
        return plain(meshes[0]), transforms
    return place(meshes, mesh, transforms), transforms


def check_transform(number: int, transform: ArrayLike | None) -> Floats:
    """Transform of the instance of that number: float64 (3, 4); ValueError if it is invalid."""
    matrix = _matrix(number, transform)
    _check_regular(number, matrix[None])
    return matrix


def _matrix(number: int, transform: ArrayLike | None) -> Floats:
    if transform is None:
        return np.eye(3, 4)
    given = np.asarray(transform)
    if given.dtype.kind not in "fiu" or given.shape not in ((3, 4), (4, 4)):
        raise ValueError(
            f"The transform of instance {number} must be real numbers of shape (3, 4) or (4, 4), "
            f"not {given.dtype} {given.shape}."
        )
    matrix = given.astype(np.float64)
    if len(matrix) == 4 and (matrix[3] != [0, 0, 0, 1]).any():
        raise ValueError(
            f"The last row of the transform of instance {number} is {matrix[3].tolist()}: "
            "expected 0, 0, 0, 1."
        )
    return matrix[:3]


def _check_regular(first: int, transforms: Floats) -> None:
    """Check transforms (n, 3, 4) of instances from a number on, all at once."""
    finite = np.isfinite(transforms).all(axis=(1, 2))
    if not finite.all():
        row = int(finite.argmin())
        raise ValueError(
            f"The transform of instance {first + row} is not finite: {transforms[row].tolist()}."
        )
    turn = transforms[:, :, :3]
    with np.errstate(all="ignore"):
        lengths = np.sqrt((turn**2).sum(axis=1))
        volume = np.abs(_inverse(turn)[1]) / lengths.prod(axis=1)
    regular = volume >= _FLAT  # also False when it is not a number
    if not regular.all():
        row = int(regular.argmin())
        raise ValueError(
            f"The transform of instance {first + row} is singular: {turn[row].tolist()} makes "
            "the mesh flat, or is too large or small to be inverted."
        )


def place(meshes: tuple[LocalMesh, ...], mesh: Indices, transforms: Floats) -> Scene:
    """Make a scene that is not plain.

    Parameters
    ----------
    meshes, mesh
        As in `Scene`.
    transforms
        (n, 3, 4), checked.
    """
    frames = [one.frame for one in meshes]
    turn = transforms[:, :, :3]
    move = transforms[:, :, 3]
    scale = np.array([frame.scale for frame in frames])[mesh]
    # Middle of each mesh's coordinates in the scene, metres: large numbers are subtracted first.
    centre = _product(turn, np.array([frame.centre for frame in frames])[mesh]) + move
    low = np.array([frame.low for frame in frames])[mesh] / scale[:, None]
    high = np.array([frame.high for frame in frames])[mesh] / scale[:, None]
    shift = _product(turn, (low + high) / 2)
    half = _product(np.abs(turn), (high - low) / 2)
    middles = centre + shift
    origin, unit = middle((middles - half).min(axis=0), (middles + half).max(axis=0))
    at = ((centre - origin) + shift) * unit
    boxes = np.stack([at - half * unit, at + half * unit], axis=1)
    frame = Frame(origin, unit, boxes[:, 0].min(axis=0) - PAD, boxes[:, 1].max(axis=0) + PAD)
    inverse, _ = _inverse(turn)
    matrices = np.empty((len(mesh), 3, 4))
    matrices[:, :, :3] = inverse * (scale / unit)[:, None, None]
    matrices[:, :, 3] = _product(inverse, origin - centre) * scale[:, None]
    return Scene(meshes, mesh, frame, matrices.reshape(-1, 12), boxes)


def _product(matrices: Floats, vectors: Floats) -> Floats:
    """Matrices (n, 3, 3) times vectors (n, 3), with the same bits on every machine."""
    return (matrices * vectors[:, None, :]).sum(axis=2)


def _inverse(matrices: Floats) -> tuple[Floats, Floats]:
    """Inverses and determinants of matrices (n, 3, 3), with the same bits on every machine."""
    a, b, c = (matrices[:, :, k] for k in range(3))
    across = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = (a * across[:, 0]).sum(axis=1)
    return across / volume[:, None, None], volume
