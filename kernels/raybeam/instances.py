"""Meshes, instances, and the scenes that backends use.

Rays are cast on two levels. The scene and each mesh have their own local coordinates
(`LocalFrame`). At an instance, a matrix transforms a ray from scene to mesh coordinates, and its
direction is normalized again. Therefore, the same error bounds hold for all meshes, and no ray
slips between two adjacent triangles. Distances are divided by the length that the direction had
before it was normalized.

All backends perform these operations in float64, in the order of `LocalScene.to_mesh_coordinates`
and without fused multiply-adds, so that their results have the same bits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from .arrays import AnyArray, Floats, Indices, Integers, Ints, Ints32
from .mesh import LocalFrame, LocalMesh, center_and_scale, local_mesh
from .opacity import Opacity
from .poses import determinants
from .tree import PAD

# Maximum number of triangles in all meshes. A tree node refers to triangles with 31 bits, of which
# 3 hold the size of a leaf.
MAX_TRIANGLES = 2**28 - 1
# A transform counts as singular if its determinant, divided by the lengths of its columns, is less
# than this value.
_FLAT = 1e-9


class Mesh:
    """A triangle mesh that can be shared by instances.

    Parameters
    ----------
    vertices
        (v, 3) real numbers, in meters. Large coordinates do not lose precision, because they are
        stored relative to a local origin.
    faces
        (f, 3) integers, indices into `vertices`. Triangles with zero area are never hit.
    opacity
        Mask of the opaque parts of the triangles; None if all triangles are opaque.

    Raises
    ------
    ValueError
        If the mesh or its opacity is not finite or has a wrong shape, if faces refer to missing
        vertices, or if the mesh has no area.
    """

    def __init__(
        self, vertices: ArrayLike, faces: ArrayLike, opacity: Opacity | None = None
    ) -> None:
        self._local = local_mesh(vertices, faces, opacity)

    def __repr__(self) -> str:
        return f"Mesh({self.face_count} triangles)"

    @property
    def face_count(self) -> int:
        """Number of triangles, including triangles with zero area."""
        return self._local.face_count


@dataclass(frozen=True, eq=False)
class Instance:
    """A mesh with a transform.

    Attributes
    ----------
    mesh
        The mesh. Any number of instances can share a mesh with very little additional memory.
    transform
        (3, 4), or (4, 4) with the last row 0, 0, 0, 1: transform from mesh to scene coordinates, in
        meters. It may rotate, translate, mirror, shear and scale, even non-uniformly. None for the
        identity.
    """

    mesh: Mesh
    transform: ArrayLike | None = None


@dataclass(frozen=True, eq=False)
class MeshFrames:
    """Local coordinates and bounding box of each instance's mesh, for n instances.

    Attributes
    ----------
    scale
        float64 (n,): as in `LocalFrame`.
    center
        float64 (n, 3): as in `LocalFrame`, in meters.
    box_center
        float64 (n, 3): center of the bounding box relative to `center`, in meters.
    box_half_size
        float64 (n, 3): half the dimensions of the bounding box, in meters.
    """

    scale: Floats
    center: Floats
    box_center: Floats
    box_half_size: Floats

    @classmethod
    def from_instances(cls, meshes: tuple[LocalMesh, ...], mesh: Indices) -> MeshFrames:
        """Look up the local coordinates of each instance's mesh. See `LocalScene` for arguments."""
        frames = [local.frame for local in meshes]
        scale = np.array([frame.scale for frame in frames])[mesh]
        lower = np.array([frame.lower for frame in frames])[mesh] / scale[:, None]
        upper = np.array([frame.upper for frame in frames])[mesh] / scale[:, None]
        center = np.array([frame.center for frame in frames])[mesh]
        return cls(scale, center, (lower + upper) / 2, (upper - lower) / 2)


@dataclass(frozen=True, eq=False)
class LocalScene:
    """Instances and meshes in the form that backends use.

    Attributes
    ----------
    meshes
        The distinct meshes, in the order in which instances first use them.
    mesh
        intp (n,): index of the mesh of each instance.
    frame
        Local coordinates of the scene. In a plain scene, they are the coordinates of the mesh.
    matrices
        float64 (n, 12): (3, 4) matrix of each instance, row by row, which transforms from the local
        coordinates of the scene to those of the mesh. None if the scene is plain, that is, a single
        mesh without a transform.
    boxes
        float64 (n, 2, 3): lower and upper corner of the bounding box of each instance, in local
        coordinates of the scene.
    mesh_frames
        Local coordinates of the mesh of each instance. None if the scene is plain.
    """

    meshes: tuple[LocalMesh, ...]
    mesh: Indices
    frame: LocalFrame
    matrices: Floats | None
    boxes: Floats
    mesh_frames: MeshFrames | None = None

    @property
    def has_matrices(self) -> bool:
        """Whether rays must be transformed to the coordinates of each mesh."""
        return self.matrices is not None

    @cached_property
    def first_face(self) -> Ints:
        """First row of each mesh in a table of hit counts, then its length. Shape (meshes + 1,)."""
        return np.cumsum([0, *(mesh.face_count for mesh in self.meshes)])

    @property
    def face_count(self) -> int:
        """Number of rows in a table of hit counts."""
        return int(self.first_face[-1])

    @property
    def counters(self) -> Ints:
        """Location of each instance's rows in a table of hit counts.

        The array has shape (n, 2). Its columns are the first row and the row step.
        """
        first = self.first_face[:-1][self.mesh]
        return np.stack([first, np.ones_like(first)], axis=1)

    def with_transforms(self, transforms: Floats) -> LocalScene:
        """Return a copy of the scene with new transforms.

        The scene must be nested. The transforms have shape (n, 3, 4) and must already have been
        validated.
        """
        assert self.mesh_frames is not None
        return _nested_scene(self.meshes, self.mesh, self.mesh_frames, transforms)

    def tally_rows(self, instance: Ints32, triangle: Ints32) -> Integers:
        """Return the row of each hit in a table of hit counts, given instances and triangles."""
        return self.first_face[self.mesh[instance]] + triangle if self.has_matrices else triangle

    def to_mesh_coordinates(
        self, instance: Indices, origins: Floats, directions: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Transform each ray to the mesh coordinates of its instance.

        The scene must be nested.

        Parameters
        ----------
        origins, directions
            (m, 3), in local coordinates of the scene. The directions have approximately unit
            length.

        Returns
        -------
        origins, directions
            (m, 3), in local coordinates of the mesh. The directions have unit length.
        length
            (m,): length of each direction before it was normalized. A distance in the scene is the
            distance in the mesh divided by this length.
        """
        assert self.matrices is not None
        rows = np.ascontiguousarray(self.matrices[instance].T).reshape(3, 4, -1)
        x, y, z = directions.T
        u, v, w = ((a * x + b * y) + c * z for a, b, c, _ in rows)
        length = np.sqrt((u * u + v * v) + w * w)
        x, y, z = origins.T
        moved = np.stack([((a * x + b * y) + c * z) + d for a, b, c, d in rows], axis=1)
        return moved, np.stack([u / length, v / length, w / length], axis=1), length


def single_mesh_scene(mesh: LocalMesh) -> LocalScene:
    """Return the plain scene of a single, untransformed mesh."""
    frame = mesh.frame
    boxes = np.stack([frame.lower, frame.upper])[None]
    return LocalScene((mesh,), np.zeros(1, np.intp), frame, None, boxes)


def build_scene(instances: Sequence[Instance]) -> tuple[LocalScene, Floats]:
    """Validate instances, and return them as a scene together with their transforms.

    Raises
    ------
    ValueError
        If there are no instances, a transform is invalid, or the meshes have too many triangles.
    """
    listed = list(instances)
    if not listed:
        raise ValueError("A caster requires at least one instance.")
    transforms = np.stack([_matrix(k, instance.transform) for k, instance in enumerate(listed)])
    _check_regular(np.arange(len(listed)), transforms)
    numbers: dict[Mesh, int] = {}
    mesh = np.array(
        [numbers.setdefault(instance.mesh, len(numbers)) for instance in listed], np.intp
    )
    meshes = tuple(mesh._local for mesh in numbers)
    total = sum(mesh.face_count for mesh in meshes)
    if total > MAX_TRIANGLES:
        raise ValueError(
            f"The instances have {total:,} triangles, but the limit is {MAX_TRIANGLES:,}."
        )
    if len(listed) == 1 and listed[0].transform is None:
        return single_mesh_scene(meshes[0]), transforms
    frames = MeshFrames.from_instances(meshes, mesh)
    return _nested_scene(meshes, mesh, frames, transforms), transforms


def check_transforms(numbers: Integers, transforms: ArrayLike) -> Floats:
    """Validate the transforms of the instances `numbers`, and return them as a float64 array.

    The result has shape (k, 3, 4). If a transform is invalid, raises ValueError with the index of
    its instance.
    """
    values = np.asarray(transforms)
    if values.ndim != 3 or len(values) != len(numbers):
        raise ValueError(
            f"{len(numbers)} instances require transforms of shape ({len(numbers)}, 3, 4) or "
            f"({len(numbers)}, 4, 4), but got shape {values.shape}."
        )
    matrices = _matrices(numbers, values)
    _check_regular(numbers, matrices)
    return matrices


def _matrix(number: int, transform: ArrayLike | None) -> Floats:
    """Return a transform as a (3, 4) float64 matrix, or the identity for None.

    Raises ValueError if the shape or type is invalid.
    """
    if transform is None:
        return np.eye(3, 4)
    return np.asarray(_matrices(np.array([number]), np.asarray(transform)[None])[0])


def _matrices(numbers: Integers, values: AnyArray) -> Floats:
    """Convert the transforms of the instances `numbers` to (3, 4) float64 matrices.

    Raises ValueError if the shape, the type or the last row is invalid.
    """
    if values.dtype.kind not in "fiu" or values.shape[1:] not in ((3, 4), (4, 4)):
        raise ValueError(
            f"The transform of instance {numbers[0]} must be an array of real numbers with shape "
            f"(3, 4) or (4, 4), but has dtype {values.dtype} and shape {values.shape[1:]}."
        )
    matrices = values.astype(np.float64)
    if values.shape[1] == 4:
        wrong = np.flatnonzero((matrices[:, 3] != [0, 0, 0, 1]).any(axis=1))
        if len(wrong):
            raise ValueError(
                f"The last row of the transform of instance {numbers[wrong[0]]} must "
                f"be [0, 0, 0, 1], but is {matrices[wrong[0], 3].tolist()}."
            )
    return matrices[:, :3]


def _check_regular(numbers: Integers, transforms: Floats) -> None:
    """Raise ValueError if a transform is singular or not finite."""
    finite = np.isfinite(transforms).all(axis=(1, 2))
    if not finite.all():
        row = int(finite.argmin())
        raise ValueError(
            f"The transform of instance {numbers[row]} must be finite, but is "
            f"{transforms[row].tolist()}."
        )
    rotation_scale = transforms[:, :, :3]
    with np.errstate(all="ignore"):
        lengths = np.sqrt((rotation_scale**2).sum(axis=1))
        volume = np.abs(determinants(rotation_scale.transpose(1, 2, 0))) / lengths.prod(axis=1)
    regular = volume >= _FLAT  # also False for NaN
    if not regular.all():
        row = int(regular.argmin())
        raise ValueError(
            f"The transform of instance {numbers[row]} is singular or cannot be inverted "
            f"accurately: {rotation_scale[row].tolist()}."
        )


def _nested_scene(
    meshes: tuple[LocalMesh, ...], mesh: Indices, mesh_frames: MeshFrames, transforms: Floats
) -> LocalScene:
    """Create a scene from instances and their transforms.

    Parameters
    ----------
    meshes, mesh
        Distinct meshes, and the index of each instance's mesh, as in `LocalScene`.
    mesh_frames
        Local coordinates of the mesh of each instance.
    transforms
        (n, 3, 4), validated, from mesh to scene coordinates in meters.
    """
    rotation_scale = transforms[:, :, :3]
    scale = mesh_frames.scale
    # Origin of each mesh's local coordinates in the scene, in meters. Large numbers are subtracted
    # from each other before anything small is added.
    center = _multiply(rotation_scale, mesh_frames.center) + transforms[:, :, 3]
    shift = _multiply(rotation_scale, mesh_frames.box_center)
    half = _multiply(np.abs(rotation_scale), mesh_frames.box_half_size)
    frame, boxes = _scene_frame(center, shift, half)
    offset = frame.center - center
    inverse = _invert(rotation_scale)
    matrices = np.empty((len(mesh), 3, 4))
    matrices[:, :, :3] = inverse * (scale / frame.scale)[:, None, None]
    matrices[:, :, 3] = _multiply(inverse, offset) * scale[:, None]
    return LocalScene(
        meshes=meshes,
        mesh=mesh,
        frame=frame,
        matrices=matrices.reshape(-1, 12),
        boxes=boxes,
        mesh_frames=mesh_frames,
    )


def _scene_frame(center: Floats, shift: Floats, half: Floats) -> tuple[LocalFrame, Floats]:
    """Compute the local coordinates of a scene, and the boxes of its instances in them.

    The boxes have the centers ``center + shift`` (n, 3), and half their dimensions are `half`
    (n, 3). The returned boxes have shape (n, 2, 3).
    """
    lower = (center + shift - half).min(axis=0)
    upper = (center + shift + half).max(axis=0)
    origin, unit = center_and_scale(lower, upper)
    local = ((center - origin) + shift) * unit
    boxes = np.stack([local - half * unit, local + half * unit], axis=1)
    lower = boxes[:, 0].min(axis=0) - PAD
    upper = boxes[:, 1].max(axis=0) + PAD
    return LocalFrame(origin, unit, lower, upper), boxes


def _multiply(matrices: Floats, vectors: Floats) -> Floats:
    """Multiply matrices by vectors. The results are bit-identical on every machine."""
    return (matrices * vectors[:, None, :]).sum(axis=2)


def _invert(matrices: Floats) -> Floats:
    """Invert 3 x 3 matrices. The results are bit-identical on every machine."""
    (a, d, g), (b, e, h), (c, f, i) = matrices.transpose(1, 2, 0)  # columns (a, b, c), …
    # The rows are cross products of columns. `numpy.cross` takes four times as long for few
    # matrices.
    across = np.empty((3, 3, len(matrices)))
    across[0] = e * i - f * h, f * g - d * i, d * h - e * g
    across[1] = h * c - i * b, i * a - g * c, g * b - h * a
    across[2] = b * f - c * e, c * d - a * f, a * e - b * d
    across = across.transpose(2, 0, 1)
    volume = (matrices[:, :, 0] * across[:, 0]).sum(axis=1)
    return across / volume[:, None, None]
