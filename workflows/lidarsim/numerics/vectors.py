"""Operations on vectors and small matrices that are bit-identical on every processor.

Sums of products have a fixed order, and each product is rounded. BLAS, LAPACK and `numpy.einsum`
use fused multiply-add where the processor supports it, and `pow` of different C libraries differs
in the last bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Ints

# Same as in numpy.linalg.matrix_rank, with a margin for rounding errors of cofactors.
_FLAT = 16 * 2.0**-52


def rotate(vectors: Floats, rotation: Floats | None) -> Floats:
    """Rotate vectors (n, 3) by a matrix (k, 3), or return them unchanged if it is None."""
    if rotation is None:
        return vectors
    x, y, z = vectors.T
    return np.stack([(x * a + y * b) + z * c for a, b, c in rotation], axis=1)


def rotate_into_frames(vectors: Floats, rotations: Floats | None) -> Floats:
    """Rotate vectors (m, 3) from the scene frame to the frames with the given rotations (m, 3, 3).

    Vectors are returned unchanged if `rotations` is None.
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
    """Return the cross products of two arrays of vectors, each of shape (3, ...)."""
    a, b, c = first
    d, e, f = second
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def matmul(first: ArrayLike, second: ArrayLike) -> Floats:
    """Multiply small matrices of shapes (..., i, j) and (..., j, k)."""
    first = np.asarray(first, np.float64)
    second = np.asarray(second, np.float64)
    axes = max(first.ndim, second.ndim)
    product = matmul_of_components(_components_first(first, axes), _components_first(second, axes))
    return product.transpose(*range(2, product.ndim), 0, 1)


def matmul_of_components(first: Floats, second: Floats) -> Floats:
    """Multiply small matrices of shapes (i, j, ...) and (j, k, ...).

    This is faster than `matmul` for many matrices, because the long axis is the last.
    """
    product: Floats = first[:, 0, None] * second[None, 0]
    for number in range(1, first.shape[1]):
        product += first[:, number, None] * second[None, number]
    return product


def _components_first(matrices: Floats, axes: int) -> Floats:
    """Return matrices (..., i, j) as a contiguous array (i, j, ...) with `axes` dimensions."""
    matrices = matrices[(None,) * (axes - matrices.ndim)]
    return np.ascontiguousarray(matrices.transpose(axes - 2, axes - 1, *range(axes - 2)))


def matvec(matrices: ArrayLike, vectors: ArrayLike) -> Floats:
    """Multiply matrices (..., i, j) by vectors (..., j)."""
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
    """Return the adjugates and the determinants of matrices (..., 3, 3), from cofactors."""
    rows = np.moveaxis(matrices, (-2, -1), (0, 1))  # (3, 3, ...)
    (a, b, c), (d, e, f), (g, h, i) = rows
    # Columns are cross products of rows. `numpy.cross` takes four times as long for few matrices.
    columns = [
        [e * i - f * h, f * g - d * i, d * h - e * g],
        [h * c - i * b, i * a - g * c, g * b - h * a],
        [b * f - c * e, c * d - a * f, a * e - b * d],
    ]
    adjugate = np.moveaxis(np.array(columns), (0, 1), (-1, -2))
    return adjugate, dot(rows[0], np.array(columns[0]))


def inverse(matrices: Floats) -> Floats:
    """Return the inverses of invertible matrices (..., 3, 3)."""
    adjugate, determinant = adjugates(matrices)
    return np.asarray(adjugate / determinant[..., None, None])


def determinant(matrices: Floats) -> Floats:
    """Return the determinants of matrices (..., 3, 3), bit-identical to those of `adjugates`."""
    axes = matrices.ndim - 2, matrices.ndim - 1, *range(matrices.ndim - 2)
    (a, b, c), (d, e, f), (g, h, i) = matrices.transpose(axes)
    return np.asarray((a * (e * i - f * h) + b * (f * g - d * i)) + c * (d * h - e * g))


def rank(matrices: Floats) -> Ints:
    """Return the ranks (...), at least 1, of matrices (..., 3, 3), up to rounding errors."""
    shape = (*matrices.shape[:-2], 9)
    largest = np.abs(matrices).reshape(shape).max(axis=-1)
    unit = matrices / np.where(largest > 0, largest, 1)[..., None, None]
    cofactors, size = adjugates(unit)
    lengths = norm(unit.reshape(shape))
    areas = norm(cofactors.reshape(shape))
    thin = ~(areas > _FLAT * lengths * lengths)
    flat = thin | ~(np.abs(size) > _FLAT * lengths * areas)
    return np.asarray(3 - flat.astype(np.int64) - thin)
