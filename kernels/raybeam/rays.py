"""Rays from the caller: checked, in float64, with unit directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .arrays import AnyArray, Bools, Floats

# A vector with a squared length this close to 1 is a unit vector up to rounding, and is left as it
# is, so that the last bits of normalised directions do not change.
UNIT_SLACK = 1e-14

# Rows that are checked at a time, so that extra memory does not grow with the rays.
_BLOCK = 1 << 18


@dataclass(frozen=True)
class Rays:
    """Rays that have been checked.

    Attributes
    ----------
    origins
        (n, 3), or (1, 3) when all rays share one, metres.
    directions
        (n, 3), of any length but zero.
    t_min, t_max
        Hits nearer or farther than this are not reported, metres; both ends count.
    """

    origins: Floats
    directions: Floats
    t_min: float
    t_max: float

    def __len__(self) -> int:
        return len(self.directions)

    def part(self, start: int, stop: int) -> Rays:
        """Rays `start` to `stop` for engines: in float64, directions as unit vectors.

        They are converted part by part, so that a cast needs memory for one part only.
        """
        origins = self.origins if len(self.origins) == 1 else self.origins[start:stop]
        directions = _float64(self.directions[start:stop])
        return Rays(_float64(origins), _normalised(directions), self.t_min, self.t_max)


def check_rays(origins: ArrayLike, directions: ArrayLike, t_min: float, t_max: float) -> Rays:
    """Check the rays given; raises ValueError for invalid ones.

    Parameters
    ----------
    origins
        (3,) or (n, 3), metres.
    directions
        (n, 3), or (3,) for a single ray.
    t_min, t_max
        Metres, ``0 <= t_min <= t_max``.
    """
    table = _check_directions(directions)
    return Rays(check_origins(origins, len(table)), table, *check_interval(t_min, t_max))


def check_origins(origins: ArrayLike, rays: int) -> AnyArray:
    """Origins (n, 3) as given, or one (1, 3); ValueError for other shapes."""
    start = real_rows("origins", origins)
    if len(start) not in (1, rays):
        raise ValueError(
            f"There are {len(start)} origins and {rays} directions: "
            "give one origin for all rays, or one for each."
        )
    refuse_rows("Origin", start, finite_rows, "finite coordinates")
    return start


def check_interval(t_min: float, t_max: float) -> tuple[float, float]:
    """Return both as floats; raises ValueError unless ``0 <= t_min <= t_max``."""
    t_min = float(t_min)
    t_max = float(t_max)
    if not (0 <= t_min < np.inf and t_min <= t_max):
        raise ValueError(
            f"t_min is {t_min} and t_max {t_max}: distances must be finite, at least 0, "
            "and t_max not less than t_min (inf for no limit)."
        )
    return t_min, t_max


def unit_directions(directions: ArrayLike) -> Floats:
    """Directions as new float64 unit vectors (n, 3); raises ValueError for zero, NaN and inf.

    Their memory is in columns, so that the transposed array is contiguous.
    Each row's result depends only on that row, so that batches may be cut anywhere.
    """
    table = real_rows("directions", directions)
    columns = np.empty((3, len(table)))
    columns[...] = table.T
    if _are_units(columns):
        return columns.T
    _refuse_directions(table)
    out = np.empty((3, len(table))).T
    for start in range(0, len(table), _BLOCK):
        out[start : start + _BLOCK] = _normalised(_float64(table[start : start + _BLOCK]))
    return out


def _normalised(table: Floats) -> Floats:
    """Normalise checked directions; returns the same array if they are unit vectors already."""
    x, y, z = table.T
    # No einsum or norm: those may fuse multiply and add, so the last bit would depend on the
    # machine.
    with np.errstate(over="ignore", under="ignore"):
        squared = (x * x + y * y) + z * z
    off = np.abs(squared - 1) > UNIT_SLACK
    if not off.any():
        return table
    rows = table[off]
    # Squares of 1e200 or 1e-200 overflow or underflow.
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)
    x, y, z = rows.T
    out = table.copy()
    out[off] = rows / np.sqrt((x * x + y * y) + z * z)[:, None]
    return out


def real_rows(name: str, values: ArrayLike, shape: tuple[int, ...] = (3,)) -> AnyArray:
    """Real numbers (n, *shape), copied only if they are no array; a single row may omit n."""
    given = np.asarray(values)
    if given.shape == shape:
        given = given[None]
    if given.dtype.kind not in "fiu" or not given.ndim or given.shape[1:] != shape:
        expected = ", ".join(map(str, shape))
        raise ValueError(
            f"{name} must be real numbers of shape (n, {expected}), "
            f"not {given.dtype} {given.shape}."
        )
    return given


def finite_rows(block: Floats) -> Bools:
    """Whether each row (n, 3) has only finite numbers: (n,)."""
    x, y, z = np.isfinite(block).T
    return x & y & z


def refuse_rows(
    what: str,
    table: AnyArray,
    good: Callable[[Floats], Bools],
    expected: str,
) -> None:
    """Raise ValueError for the first row that is not good."""
    bad = [np.zeros(0, np.intp)]
    for start in range(0, len(table), _BLOCK):
        block = _float64(table[start : start + _BLOCK])
        bad.append(np.flatnonzero(~good(block)) + start)
    rows = np.concatenate(bad)
    if len(rows):
        raise ValueError(
            f"{what} {rows[0]} is {_float64(table[rows[0]]).tolist()}: expected {expected} "
            f"({len(rows)} of {len(table)} rows are like that)."
        )


def _are_units(columns: Floats) -> bool:
    """Whether all vectors (3, n) are finite unit vectors: then there is no more to be checked."""
    x, y, z = columns
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        squared = x * x
        squared += y * y
        squared += z * z
        squared -= 1
        return bool((np.abs(squared, out=squared) <= UNIT_SLACK).all())


def _check_directions(directions: ArrayLike) -> AnyArray:
    table = real_rows("directions", directions)
    _refuse_directions(table)
    return table


def _refuse_directions(table: AnyArray) -> None:
    refuse_rows(
        "Direction",
        table,
        lambda block: finite_rows(block) & block.any(axis=1),
        "a finite vector that is not zero",
    )


def _float64(table: AnyArray) -> Floats:
    return np.ascontiguousarray(table, dtype=np.float64)
