"""Rotation matrices, quaternions, and conversion from yaw, pitch and roll."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats
from ..numerics.elementary import arctan2, sin_cos
from ..numerics.vectors import cross, determinant, dot, matmul_of_components, norm

_MAX_LENGTH_ERROR = 0.01  # maximum error of the length of a recorded quaternion

# Number of power iterations, which is sufficient for matrices with rounding errors up to 2e-3.
_ROUNDS = 8


def rotations_of(angles_deg: Floats) -> Floats:
    """Convert yaw, pitch and roll in degrees to rotation matrices.

    The angles are applied in the aerospace order. Angles of shape (k, 3) result in matrices of
    shape (k, 3, 3), and angles of shape (3,) in a single matrix of shape (3, 3).
    """
    angles = np.radians(angles_deg.T)
    (sy, sp, sr), (cy, cp, cr) = sin_cos(angles)
    rotations = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    if rotations.ndim == 2:
        return rotations
    return np.ascontiguousarray(np.moveaxis(rotations, 2, 0))


def check_rotations(rotations: Floats, slack: float = 1e-6) -> None:
    """Check that matrices are rotation matrices.

    Parameters
    ----------
    rotations
        Matrices of shape (k, 3, 3).
    slack
        Tolerance for the dot products of the columns, which are 0 or 1 in a rotation matrix.

    Raises
    ------
    LidarError
        If a matrix reflects or deforms.
    """
    rows = np.ascontiguousarray(rotations.transpose(1, 2, 0))
    products = matmul_of_components(rows.transpose(1, 0, 2), rows)
    # The comparison is also false for NaN.
    rigid = np.asarray((np.abs(products - np.eye(3)[:, :, None]) <= slack).all(axis=(0, 1)))
    right_handed = determinant(rotations) > 0
    bad = np.flatnonzero(~(rigid & right_handed))
    if len(bad):
        first = int(bad[0])
        fault = "mirrors" if rigid[first] else "deforms"
        raise LidarError(
            f"Matrix {first} of a pose {fault}: {rotations[first].round(6).tolist()}. A pose is a "
            "rigid transform, so the matrix must have orthonormal rows and the determinant 1 "
            "(matrices are counted from 0)."
        )


def rotation_sines(rotations: Floats) -> Floats:
    """Return the unit rotation axes multiplied by twice the sine of the rotation angle.

    For rotations of shape (k, 3, 3), the result has shape (k, 3).
    """
    differences = [rotations[:, k, j] - rotations[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))]
    return np.stack(differences, axis=1)


def rotation_terms(rotations: Floats, axes: Floats) -> Floats:
    """Return coefficients that rotate matrices further about the given axes (Rodrigues 1840).

    For rotations of shape (3, 3, s) and unit axes of shape (3, s), the result `terms` has shape
    (3, 9, s). After a further rotation by the angle a, the matrix is
    ``terms[0] + sin(a) * terms[1] + cos(a) * terms[2]``.
    """
    x, y, z = axes
    zero = np.zeros_like(x)
    cross_matrix = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    tilted = matmul_of_components(rotations, cross_matrix)
    square = matmul_of_components(tilted, cross_matrix)
    return np.stack([rotations + square, tilted, -square]).reshape(3, 9, -1)


def rotations_between(first: Floats, last: Floats, durations_s: Floats) -> tuple[Floats, Floats]:
    """Return the axes and rates of the constant rotations between pairs of quaternions.

    Parameters
    ----------
    first, last
        Quaternions at the start and the end of each rotation. Shape (4, s).
    durations_s
        Durations in seconds. Shape (s,).

    Returns
    -------
    tuple
        Unit axes (3, s) in the frame of the first pose, and rates (s,) in rad/s.
    """
    p = first[:3]
    q = last[:3]
    # conjugate(p) q
    axis = first[3] * q - last[3] * p - cross(p, q)
    cosine = dot(p, q) + first[3] * last[3]
    axis = np.where(cosine < 0, -axis, axis)  # the shorter rotation
    x, y, z = axis
    sine = np.sqrt((x * x + y * y) + z * z)
    rates = 2 * arctan2(sine, np.abs(cosine)) / durations_s
    return axis / np.where(sine > 0, sine, 1), rates


def recorded_rotation(quaternion: Sequence[float], owner: str) -> Floats:
    """Convert a recorded quaternion (x, y, z, w) to a rotation matrix.

    The quaternion is normalized, because it may be rounded. `owner` names its source in messages.

    Raises
    ------
    ValueError
        If the quaternion is not finite, or if its length is not 1 apart from rounding errors.
    """
    values = np.asarray(quaternion, np.float64)
    if not np.isfinite(values).all():
        raise ValueError(f"the quaternion of {owner} is not finite")
    length = float(np.sqrt((values * values).sum()))
    if not abs(length - 1) < _MAX_LENGTH_ERROR:
        raise ValueError(
            f"the quaternion of {owner} has the length {length:.3g}, but a rotation requires 1"
        )
    (rotation,) = matrices(values[None] / length)
    return np.asarray(rotation)


def matrices(quaternions: Floats) -> Floats:
    """Convert unit quaternions to rotation matrices.

    The quaternions (x, y, z, w) have shape (k, 4), and the matrices have shape (k, 3, 3).
    """
    return matrices_by_component(quaternions.T).transpose(2, 0, 1)


def matrices_by_component(quaternions: Floats) -> Floats:
    """Convert unit quaternions to rotation matrices. The components are on the first axes.

    The quaternions (x, y, z, w) have shape (4, k), and the matrices have shape (3, 3, k).
    """
    x, y, z, w = quaternions
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows)


def quaternions_of(rotations: Floats) -> Floats:
    """Convert rotation matrices, which may contain rounding errors, to unit quaternions.

    The matrices have shape (k, 3, 3), and the quaternions (x, y, z, w) have shape (k, 4).

    The quaternion is the eigenvector of the largest eigenvalue of a 4 x 4 matrix (Bar-Itzhack,
    2000). The power iteration converges quickly because the identity is added to this matrix. The
    other eigenvalues are then 0 for exact rotations, and similar in size to the rounding errors
    otherwise.
    """
    matrix = np.ascontiguousarray(rotations.transpose(1, 2, 0))
    table = np.zeros((4, 4, len(rotations)))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        table[i, i] = matrix[i, i] - matrix[j, j] - matrix[k, k]
        table[i, j] = table[j, i] = matrix[i, j] + matrix[j, i]
        table[k, 3] = table[3, k] = matrix[j, i] - matrix[i, j]
    table[3, 3] = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    table += np.eye(4)[:, :, None]
    best = np.diagonal(table).argmax(axis=1)
    vectors = np.take_along_axis(table, best[None, None], axis=0)[0]
    for _ in range(_ROUNDS):
        unit = vectors / norm(vectors.T)
        vectors = matmul_of_components(table, unit[:, None])[:, 0]
    return np.ascontiguousarray((vectors / norm(vectors.T)).T)
