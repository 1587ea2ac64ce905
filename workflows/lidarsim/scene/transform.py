"""Units, up axes and placements: from mesh file coordinates to world coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..errors import LidarError
from ..motion.trajectory import Pose
from ..numerics.arrays import Floats
from ..numerics.elementary_scalars import sin_cos_of
from ..numerics.vectors import matmul, matvec, norm, rank
from ..schema.checks import as_array

# Proper rotations that take the named axis to +z; the rows hold only 0 and ±1, so that
# rotating large coordinates loses no digit.
UP_AXES = {
    "x": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}


def affine(linear: Floats, offset: Floats) -> Floats:
    """Return matrices (..., 4, 4) of p -> linear @ p + offset, from (..., 3, 3) and (..., 3)."""
    matrices = np.zeros((*np.shape(offset)[:-1], 4, 4))
    matrices[..., :3, :3] = linear
    matrices[..., :3, 3] = offset
    matrices[..., 3, 3] = 1
    return matrices


def inverted(matrix: Floats) -> Floats:
    """Return the inverse (4, 4) of the matrix (4, 4) of a pose."""
    back = matrix[:3, :3].T
    return affine(back, -matvec(back, matrix[:3, 3]))


def rotation_about(axis: ArrayLike, degrees: float) -> Floats:
    """Return the rotation (3, 3) about an axis that is not zero (Rodrigues 1840)."""
    cross = np.cross(np.eye(3), np.array(axis) / norm(np.array(axis, np.float64)))
    sine, cosine = sin_cos_of(math.radians(degrees))
    rotation: Floats = sine * cross + (1 - cosine) * matmul(cross, cross)
    return np.eye(3) + rotation


@dataclass(frozen=True, eq=False)
class Transform:
    """An affine placement in the world: p -> linear @ p + offset.

    Parameters
    ----------
    linear
        float64 (3, 3), invertible.
    offset
        float64 (3,), meters.

    Raises
    ------
    LidarError
        If the numbers are not finite or `linear` flattens the mesh.
    """

    linear: Floats
    offset: Floats

    def __post_init__(self) -> None:
        linear = as_array("linear", self.linear)
        offset = as_array("offset", self.offset)
        if linear.shape != (3, 3) or offset.shape != (3,):
            raise LidarError(
                f"A transform requires a (3, 3) matrix and 3 offsets, but has {linear.shape} and "
                f"{offset.shape}."
            )
        if not (np.isfinite(linear).all() and np.isfinite(offset).all()):
            raise LidarError("The numbers of a transform must be finite.")
        if rank(linear) < 3:
            raise LidarError("The matrix of the transform is singular, so it flattens the mesh.")
        object.__setattr__(self, "linear", linear)
        object.__setattr__(self, "offset", offset)

    @property
    def keeps_xy(self) -> bool:
        """True if x and y stay as they are."""
        return not self.offset[:2].any() and bool((self.linear[:2] == np.eye(3)[:2]).all())

    @classmethod
    def from_parts(
        cls,
        translation: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        scale: float | tuple[float, float, float] = 1.0,
    ) -> Transform:
        """Make a transform that scales, then rotates about the world's x, y and z axes, then moves.

        Parameters
        ----------
        translation
            Translation, meters.
        rotation_deg
            Rotations about x, y and z in this order, degrees.
        scale
            A factor for all axes, or three factors; not zero.
        """
        roll, pitch, yaw = rotation_deg
        rotation = Pose(
            (0.0, 0.0, 0.0), yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll
        ).rotation_matrix
        return cls(rotation * np.broadcast_to(scale, 3), np.array(translation))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Transform:
        """Make a transform of a homogeneous (4, 4) matrix whose last row is 0 0 0 1."""
        array = as_array("transform", matrix)
        if array.shape != (4, 4) or not np.array_equal(array[3], [0, 0, 0, 1]):
            raise LidarError(
                "A transform matrix must have four rows of four numbers with 0 0 0 1 as the last "
                f"row, but is {array.tolist()}."
            )
        return cls(array[:3, :3], array[:3, 3])
