"""Vectors and small matrices, with the same bits on every processor.

Sums of products have one order, and each product is rounded: BLAS, LAPACK and `numpy.einsum` fuse
multiplications with additions where a processor can, and C's power is off by its own last bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Ints

# As in numpy.linalg.matrix_rank, with room for what cofactors round.
_FLAT = 16 * 2.0**-52


def turned(vectors: Floats, rotation: Floats | None) -> Floats:
    """Rotate vectors (n, 3) by a matrix (k, 3): (n, k); by None they stay."""
    if rotation is None:
        return vectors
    x, y, z = vectors.T
    return np.stack([(x * a + y * b) + z * c for a, b, c in rotation], axis=1)


def into_axes(vectors: Floats, rotations: Floats | None) -> Floats:
    """Rotate vectors (m, 3) from the scene's axes to those of rotations (m, 3, 3), one each."""
    if rotations is None:
        return vectors
    x, y, z = vectors.T
    out = np.empty(vectors.shape[::-1]).T
    for axis in range(3):
        a, b, c = (rotations[:, row, axis] for row in range(3))
        out[:, axis] = (x * a + y * b) + z * c
    return out


def products(one: Floats, other: Floats) -> Floats:
    """Scalar products of vectors (3, ...): (...)."""
    (x, y, z), (a, b, c) = one, other
    product = x * a
    product += y * b
    product += z * c
    return np.asarray(product)


def matmul(one: ArrayLike, other: ArrayLike) -> Floats:
    """Products of small matrices (..., i, j) and (..., j, k): (..., i, k)."""
    one = np.asarray(one, np.float64)
    other = np.asarray(other, np.float64)
    out: Floats = one[..., :, 0, None] * other[..., None, 0, :]
    for column in range(1, one.shape[-1]):
        out += one[..., :, column, None] * other[..., None, column, :]
    return out


def applied(matrices: ArrayLike, vectors: ArrayLike) -> Floats:
    """Products of matrices (..., i, j) and vectors (..., j): (..., i)."""
    return matmul(matrices, np.asarray(vectors)[..., None])[..., 0]


def length(vectors: Floats) -> Any:
    """Lengths of vectors (..., k): (...)."""
    squares = vectors * vectors
    total = squares[..., 0]
    for axis in range(1, squares.shape[-1]):
        total = total + squares[..., axis]
    return np.sqrt(total)


def hypot(x: Any, y: Any) -> Any:
    """Lengths of vectors (x, y)."""
    return np.sqrt(x * x + y * y)


def adjugates(matrices: Floats) -> tuple[Floats, Floats]:
    """Adjugates of matrices (..., 3, 3), by cofactors, and determinants (...)."""
    a, b, c = (matrices[..., row, :] for row in range(3))
    found = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-1)
    return found, applied(a[..., None, :], found[..., 0])[..., 0]


def inverse(matrices: Floats) -> Floats:
    """Inverses of matrices (..., 3, 3), which have some."""
    found, determinant = adjugates(matrices)
    return np.asarray(found / determinant[..., None, None])


def determinant(matrices: Floats) -> Floats:
    """Compute the determinants (...) of matrices (..., 3, 3)."""
    return adjugates(matrices)[1]


def rank(matrices: Floats) -> Ints:
    """Ranks of matrices (..., 3, 3), as far as rounding tells, from 1 on: (...)."""
    shape = (*matrices.shape[:-2], 9)
    largest = np.abs(matrices).reshape(shape).max(axis=-1)
    unit = matrices / np.where(largest > 0, largest, 1)[..., None, None]
    cofactors, size = adjugates(unit)
    lengths = length(unit.reshape(shape))
    areas = length(cofactors.reshape(shape))
    thin = ~(areas > _FLAT * lengths * lengths)
    flat = thin | ~(np.abs(size) > _FLAT * lengths * areas)
    return np.asarray(3 - flat.astype(np.int64) - thin)
