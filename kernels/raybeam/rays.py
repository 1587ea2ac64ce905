"""Validation and normalization of rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .arrays import AnyArray, Bools, Floats

# Vectors whose squared length differs from 1 by at most this value count as unit vectors and are
# not normalized again, so that normalizing twice has no effect.
UNIT_SLACK = 1e-14

# Number of rows that are processed at a time, so that temporary memory does not grow with the rays.
_BLOCK = 1 << 18


@dataclass(frozen=True)
class Rays:
    """Validated rays.

    Attributes
    ----------
    origins
        (n, 3), or (1, 3) if all rays share an origin, in meters.
    directions
        (n, 3), of any length greater than zero.
    t_min, t_max
        Minimum and maximum distance of a hit in meters, both inclusive.
    """

    origins: Floats
    directions: Floats
    t_min: float
    t_max: float

    def __len__(self) -> int:
        return len(self.directions)

    def normalize_range(self, start: int, stop: int) -> Rays:
        """Return rays `start` to `stop` in float64, with unit directions.

        Backends normalize rays part by part, so that the temporary memory does not grow with the
        rays.
        """
        origins = self.origins if len(self.origins) == 1 else self.origins[start:stop]
        directions = _float64(self.directions[start:stop])
        return Rays(_float64(origins), _normalized(directions), self.t_min, self.t_max)


def check_rays(origins: ArrayLike, directions: ArrayLike, t_min: float, t_max: float) -> Rays:
    """Validate rays.

    Raises ValueError if a ray is invalid.

    Parameters
    ----------
    origins
        (3,) or (n, 3), in meters.
    directions
        (n, 3), or (3,) for a single ray.
    t_min, t_max
        Minimum and maximum distance in meters, ``0 <= t_min <= t_max``.
    """
    table = _check_directions(directions)
    return Rays(check_origins(origins, len(table)), table, *check_interval(t_min, t_max))


def check_origins(origins: ArrayLike, ray_count: int) -> AnyArray:
    """Validate origins and return them.

    The result has shape (n, 3), or (1, 3) if all rays share an origin. Raises ValueError if the
    shape is wrong or a value is not finite.
    """
    rows = as_real_rows("origins", origins)
    if len(rows) not in (1, ray_count):
        raise ValueError(
            f"origins must have length 1 or the same length as directions, which is {ray_count}, "
            f"but has length {len(rows)}."
        )
    check_rows("Origin", rows, are_finite, "finite")
    return rows


def check_interval(t_min: float, t_max: float) -> tuple[float, float]:
    """Validate the minimum and maximum distance, and return them as floats.

    Raises ValueError unless ``0 <= t_min <= t_max`` and `t_min` is finite.
    """
    t_min = float(t_min)
    t_max = float(t_max)
    if not (0 <= t_min < np.inf and t_min <= t_max):
        raise ValueError(
            "t_min must be finite and at least 0, and t_max must not be less than t_min, but t_min "
            f"is {t_min} and t_max is {t_max}. Use inf as t_max for no limit."
        )
    return t_min, t_max


def unit_directions(directions: ArrayLike) -> Floats:
    """Normalize directions, and return them as a new float64 array.

    The array has shape (n, 3), and its transpose is contiguous. Each row of the result depends only
    on the same row of the input, so that batches can be split anywhere.

    Raises ValueError if a direction is zero or not finite.
    """
    table = as_real_rows("directions", directions)
    columns = np.empty((3, len(table)))
    columns[...] = table.T
    if _are_units(columns):
        return columns.T
    _check_nonzero(table)
    result = np.empty((3, len(table))).T
    for start in range(0, len(table), _BLOCK):
        result[start : start + _BLOCK] = _normalized(_float64(table[start : start + _BLOCK]))
    return result


def _normalized(table: Floats) -> Floats:
    """Normalize directions that are not unit vectors.

    If all directions already are unit vectors, the same array is returned.
    """
    x, y, z = table.T
    # `einsum` and `norm` may use fused multiply-adds, so that the last bit would depend on the
    # machine.
    with np.errstate(over="ignore", under="ignore"):
        squared = (x * x + y * y) + z * z
    not_unit = np.abs(squared - 1) > UNIT_SLACK
    if not not_unit.any():
        return table
    rows = table[not_unit]
    # Scale the rows first, because squares of very large or small numbers overflow or underflow.
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)
    x, y, z = rows.T
    result = table.copy()
    result[not_unit] = rows / np.sqrt((x * x + y * y) + z * z)[:, None]
    return result


def as_real_rows(name: str, values: ArrayLike, shape: tuple[int, ...] = (3,)) -> AnyArray:
    """Convert real numbers to an array with rows of a given shape, copying only if necessary.

    The result has shape (n, *shape). An array with the shape `shape` counts as a single row.
    """
    rows = np.asarray(values)
    if rows.shape == shape:
        rows = rows[None]
    if rows.dtype.kind not in "fiu" or not rows.ndim or rows.shape[1:] != shape:
        expected = ", ".join(map(str, shape))
        raise ValueError(
            f"{name} must be an array of real numbers with shape (n, {expected}), but has dtype "
            f"{rows.dtype} and shape {rows.shape}."
        )
    return rows


def are_finite(block: Floats) -> Bools:
    """Return a mask of the rows that only contain finite numbers."""
    x, y, z = np.isfinite(block).T
    return x & y & z


def check_rows(
    subject: str,
    table: AnyArray,
    is_valid: Callable[[Floats], Bools],
    expected: str,
) -> None:
    """Raise ValueError if any row is invalid.

    The message contains the first invalid row and the number of invalid rows.
    """
    invalid = [np.zeros(0, np.intp)]
    for start in range(0, len(table), _BLOCK):
        block = _float64(table[start : start + _BLOCK])
        invalid.append(np.flatnonzero(~is_valid(block)) + start)
    rows = np.concatenate(invalid)
    if len(rows):
        raise ValueError(
            f"{subject} {rows[0]} must be {expected}, but is {_float64(table[rows[0]]).tolist()}. "
            f"{len(rows)} of {len(table)} rows are invalid."
        )


def _are_units(columns: Floats) -> bool:
    """Return whether all directions are finite unit vectors."""
    x, y, z = columns
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        squared = x * x
        squared += y * y
        squared += z * z
        squared -= 1
        return bool((np.abs(squared, out=squared) <= UNIT_SLACK).all())


def _check_directions(directions: ArrayLike) -> AnyArray:
    table = as_real_rows("directions", directions)
    _check_nonzero(table)
    return table


def _check_nonzero(table: AnyArray) -> None:
    check_rows(
        "Direction",
        table,
        lambda block: are_finite(block) & block.any(axis=1),
        "finite and nonzero",
    )


def _float64(table: AnyArray) -> Floats:
    return np.ascontiguousarray(table, dtype=np.float64)
