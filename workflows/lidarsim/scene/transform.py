"""Transforms from mesh file coordinates to world coordinates."""

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

# Proper rotations that map the named axis to +z. They contain only 0 and ±1, so that rotating large
# coordinates does not lose precision.
UP_AXES = {
    "x": np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}


def affine(linear: Floats, offset: Floats) -> Floats:
    """Return the homogeneous matrices of p -> linear @ p + offset.

    `linear` has shape (..., 3, 3), `offset` has shape (..., 3), and the result has shape
    (..., 4, 4).
    """
    matrices = np.zeros((*np.shape(offset)[:-1], 4, 4))
    matrices[..., :3, :3] = linear
    matrices[..., :3, 3] = offset
    matrices[..., 3, 3] = 1
    return matrices


def inverse_pose(matrix: Floats) -> Floats:
    """Return the inverse of a pose matrix.

    Both matrices have shape (4, 4). The upper left block must be a rotation.
    """
    back = matrix[:3, :3].T
    return affine(back, -matvec(back, matrix[:3, 3]))


def rotation_about(axis: ArrayLike, degrees: float) -> Floats:
    """Return the rotation matrix for an angle about a nonzero axis (Rodrigues 1840).

    The shape is (3, 3).
    """
    cross = np.cross(np.eye(3), np.array(axis) / norm(np.array(axis, np.float64)))
    sine, cosine = sin_cos_of(math.radians(degrees))
    rotation: Floats = sine * cross + (1 - cosine) * matmul(cross, cross)
    return np.eye(3) + rotation


@dataclass(frozen=True, eq=False)
class Transform:
    """An affine transform to world coordinates, p -> linear @ p + offset.

    Parameters
    ----------
    linear
        Invertible matrix. Shape (3, 3), float64.
    offset
        Translation in meters. Shape (3,), float64.

    Raises
    ------
    LidarError
        If a shape is wrong, a number is not finite, or `linear` is singular.
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
        """Whether the transform leaves x and y unchanged."""
        return not self.offset[:2].any() and bool((self.linear[:2] == np.eye(3)[:2]).all())

    @property
    def keeps_z(self) -> bool:
        """Whether the transform leaves z unchanged."""
        return not self.offset[2] and bool((self.linear[2] == np.eye(3)[2]).all())

    @classmethod
    def from_parts(
        cls,
        translation: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        scale: float | tuple[float, float, float] = 1.0,
    ) -> Transform:
        """Create a transform that scales, then rotates, then translates.

        Parameters
        ----------
        translation
            Translation in meters.
        rotation_deg
            Rotations about the x, y and z axes of the world in degrees, applied in this order.
        scale
            Nonzero scale factor for all axes, or one factor for each axis.
        """
        roll, pitch, yaw = rotation_deg
        rotation = Pose(
            (0.0, 0.0, 0.0), yaw_deg=yaw, pitch_deg=pitch, roll_deg=roll
        ).rotation_matrix
        return cls(rotation * np.broadcast_to(scale, 3), np.array(translation))

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Transform:
        """Create a transform from a homogeneous matrix.

        The shape is (4, 4), and the last row must be 0 0 0 1.
        """
        array = as_array("transform", matrix)
        if array.shape != (4, 4) or not np.array_equal(array[3], [0, 0, 0, 1]):
            raise LidarError(
                "A transform matrix must have four rows of four numbers with 0 0 0 1 as the last "
                f"row, but is {array.tolist()}."
            )
        return cls(array[:3, :3], array[:3, 3])
