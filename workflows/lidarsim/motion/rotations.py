"""Rotations: matrices, quaternions, and angles as users give them."""

from __future__ import annotations

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats
from ..numerics.elementary import arctan2, sin_cos
from ..numerics.vectors import cross, determinant, dot, matmul_of_components, norm

_ROUNDS = 8  # rounds of the power iteration: rotations are rounded by 2e-3 at most


def rotations_of(angles_deg: Floats) -> Floats:
    """Return the rotations (k, 3, 3) of yaw, pitch and roll in degrees (k, 3), in aerospace order.

    Angles (3,) give one rotation (3, 3).
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
    """Check that matrices (k, 3, 3) of poses are rotations.

    Products of their columns may differ by `slack` from the products of a rotation's columns.

    Raises
    ------
    LidarError
        If a matrix mirrors or deforms.
    """
    rows = np.ascontiguousarray(rotations.transpose(1, 2, 0))
    products = matmul_of_components(rows.transpose(1, 0, 2), rows)
    # Written so that NaN is an error.
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
    """Return the axes of rotations (k, 3, 3), times twice the sines of their angles: (k, 3)."""
    differences = [rotations[:, k, j] - rotations[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))]
    return np.stack(differences, axis=1)


def rotation_terms(rotations: Floats, axes: Floats) -> Floats:
    """Return the terms (3, 9, s) of rotations (3, 3, s) that go on about unit axes (3, s)."""
    x, y, z = axes
    zero = np.zeros_like(x)
    cross_matrix = np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    tilted = matmul_of_components(rotations, cross_matrix)
    square = matmul_of_components(tilted, cross_matrix)
    return np.stack([rotations + square, tilted, -square]).reshape(3, 9, -1)


def rotations_between(first: Floats, last: Floats, durations_s: Floats) -> tuple[Floats, Floats]:
    """Return the axes (3, s) and rates (s,), rad/s, of rotations between quaternions (4, s).

    Axes are in the frame of the first pose. A rotation takes its duration (s,), seconds.
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


def matrices(quaternions: Floats) -> Floats:
    """Convert unit quaternions to rotation matrices.

    The quaternions (x, y, z, w) have shape (k, 4), and the matrices have shape (k, 3, 3).
    """
    return matrices_by_component(quaternions.T).transpose(2, 0, 1)


def matrices_by_component(quaternions: Floats) -> Floats:
    """Return the rotation matrices (3, 3, k) of unit quaternions x, y, z, w (4, k)."""
    x, y, z, w = quaternions
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.array(rows)


def quaternions_of(rotations: Floats) -> Floats:
    """Return unit quaternions x, y, z, w (k, 4) of matrices (k, 3, 3), which may be rounded.

    A quaternion is the eigenvector of the greatest eigenvalue (Bar-Itzhack, 2000), by power
    iteration: plus one, the smaller eigenvalues are about as small as the matrices are rounded, and
    zero for exact rotations.
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
