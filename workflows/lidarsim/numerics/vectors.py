"""Operations on vectors and small matrices that are bit-identical on every processor.

Products are summed in a fixed order, and each product is rounded. In contrast, BLAS, LAPACK and
`numpy.einsum` use fused multiply-add instructions if the processor supports them, and `pow` differs
in the last bit between C libraries.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Ints

# Tolerance of numpy.linalg.matrix_rank, with a margin for rounding errors in cofactors.
_FLAT = 16 * 2.0**-52


def rotate(vectors: Floats, rotation: Floats | None) -> Floats:
    """Multiply vectors by a matrix, or return them unchanged if it is None.

    The vectors have shape (n, 3). The matrix has shape (k, 3), where k is 3 for a rotation.
    """
    if rotation is None:
        return vectors
    x, y, z = vectors.T
    return np.stack([(x * a + y * b) + z * c for a, b, c in rotation], axis=1)


def rotate_into_frames(vectors: Floats, rotations: Floats | None) -> Floats:
    """Rotate each vector from the scene frame into its own frame.

    The vectors have shape (m, 3), and the rotations have shape (m, 3, 3). If `rotations` is None,
    the vectors are returned unchanged.
    """
    if rotations is None:
        return vectors
    x, y, z = vectors.T
    rotated = np.empty(vectors.shape[::-1]).T
    for axis in range(3):
        a, b, c = (rotations[:, row, axis] for row in range(3))
        rotated[:, axis] = (x * a + y * b) + z * c
    return rotated


def dot(first: Floats, second: Floats) -> Floats:
    """Return the dot products of two arrays of vectors.

    Both arrays have shape (3, ...), and the result has shape (...).
    """
    x, y, z = first
    a, b, c = second
    product = x * a
    product += y * b
    product += z * c
    return np.asarray(product)


def cross(first: Floats, second: Floats) -> Floats:
    """Return the cross products of two arrays of vectors.

    All arrays have shape (3, ...).
    """
    a, b, c = first
    d, e, f = second
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def matmul(first: ArrayLike, second: ArrayLike) -> Floats:
    """Multiply small matrices.

    The matrices have the shapes (..., i, j) and (..., j, k).
    """
    first = np.asarray(first, np.float64)
    second = np.asarray(second, np.float64)
    axes = max(first.ndim, second.ndim)
    product = matmul_of_components(_components_first(first, axes), _components_first(second, axes))
    return product.transpose(*range(2, product.ndim), 0, 1)


def matmul_of_components(first: Floats, second: Floats) -> Floats:
    """Multiply small matrices whose components are on the first two axes.

    The matrices have the shapes (i, j, ...) and (j, k, ...). For many matrices, this function is
    faster than `matmul` because the longest axis is contiguous.
    """
    product: Floats = first[:, 0, None] * second[None, 0]
    for number in range(1, first.shape[1]):
        product += first[:, number, None] * second[None, number]
    return product


def _components_first(matrices: Floats, axes: int) -> Floats:
    """Move the components of matrices to the first two axes of a contiguous array.

    The result has `axes` dimensions.
    """
    matrices = matrices[(None,) * (axes - matrices.ndim)]
    return np.ascontiguousarray(matrices.transpose(axes - 2, axes - 1, *range(axes - 2)))


def matvec(matrices: ArrayLike, vectors: ArrayLike) -> Floats:
    """Multiply matrices by vectors.

    The matrices have shape (..., i, j), and the vectors have shape (..., j).
    """
    return matmul(matrices, np.asarray(vectors)[..., None])[..., 0]


def norm(vectors: Floats) -> Any:
    """Return the Euclidean norms of vectors along the last axis."""
    squares = vectors * vectors
    total = squares[..., 0]
    for axis in range(1, squares.shape[-1]):
        total = total + squares[..., axis]
    return np.sqrt(total)


def hypot(x: Any, y: Any) -> Any:
    """Return the lengths of 2D vectors from their components."""
    return np.sqrt(x * x + y * y)


def adjugates(matrices: Floats) -> tuple[Floats, Floats]:
    """Compute the adjugates and determinants of 3x3 matrices from their cofactors."""
    rows = np.moveaxis(matrices, (-2, -1), (0, 1))  # (3, 3, ...)
    (a, b, c), (d, e, f), (g, h, i) = rows
    # The columns are cross products of the rows. For few matrices, `numpy.cross` takes four times
    # as long.
    columns = [
        [e * i - f * h, f * g - d * i, d * h - e * g],
        [h * c - i * b, i * a - g * c, g * b - h * a],
        [b * f - c * e, c * d - a * f, a * e - b * d],
    ]
    adjugate = np.moveaxis(np.array(columns), (0, 1), (-1, -2))
    return adjugate, dot(rows[0], np.array(columns[0]))


def inverse(matrices: Floats) -> Floats:
    """Return the inverses of invertible 3x3 matrices."""
    adjugate, determinant = adjugates(matrices)
    return np.asarray(adjugate / determinant[..., None, None])


def determinant(matrices: Floats) -> Floats:
    """Return the determinants of 3x3 matrices, bit-identical to those from `adjugates`."""
    axes = matrices.ndim - 2, matrices.ndim - 1, *range(matrices.ndim - 2)
    (a, b, c), (d, e, f), (g, h, i) = matrices.transpose(axes)
    return np.asarray((a * (e * i - f * h) + b * (f * g - d * i)) + c * (d * h - e * g))


def rank(matrices: Floats) -> Ints:
    """Return the ranks of 3x3 matrices, ignoring rounding errors.

    The rank is at least 1, even for a matrix of zeros.
    """
    shape = (*matrices.shape[:-2], 9)
    largest = np.abs(matrices).reshape(shape).max(axis=-1)
    unit = matrices / np.where(largest > 0, largest, 1)[..., None, None]
    cofactors, size = adjugates(unit)
    lengths = norm(unit.reshape(shape))
    areas = norm(cofactors.reshape(shape))
    thin = ~(areas > _FLAT * lengths * lengths)
    flat = thin | ~(np.abs(size) > _FLAT * lengths * areas)
    return np.asarray(3 - flat.astype(np.int64) - thin)
