"""Sine, exponential, logarithm and the like of arrays, with the same bits on every processor.

Functions of NumPy and of C libraries differ in their last bits between versions and processors.
Those of this module apply `elementary_scalars` to each number: compiled, or in Python for few
numbers, since numba takes half a second to import.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, owned
from .elementary_scalars import arctan2_of, exp_of, log_of, sin_cos_of

_FEW = 1 << 12  # numbers: some 20 ms


def sin_cos(x: ArrayLike) -> tuple[Floats, Floats]:
    """Sines and cosines of angles in radians, of any shape."""
    sine, cosine = _each("sin_cos", sin_cos_of, 2, x)
    return sine, cosine


def sin(x: ArrayLike) -> Floats:
    """Sines of angles in radians."""
    return sin_cos(x)[0]


def cos(x: ArrayLike) -> Floats:
    """Cosines of angles in radians."""
    return sin_cos(x)[1]


def exp(x: ArrayLike) -> Floats:
    """Exponentials."""
    return _each("exp", exp_of, 1, x)[0]


def log(x: ArrayLike) -> Floats:
    """Natural logarithms."""
    return _each("log", log_of, 1, x)[0]


def arctan2(y: ArrayLike, x: ArrayLike) -> Floats:
    """Angles of vectors (x, y), radians."""
    return _each("arctan2", arctan2_of, 1, *np.broadcast_arrays(y, x))[0]


def arcsin(x: ArrayLike) -> Floats:
    """Angles with these sines, radians."""
    x = np.asarray(x, np.float64)
    return arctan2(x, np.sqrt((1 - x) * (1 + x)))


def arccos(x: ArrayLike) -> Floats:
    """Angles with these cosines, radians."""
    x = np.asarray(x, np.float64)
    return arctan2(np.sqrt((1 - x) * (1 + x)), x)


def log1p(x: ArrayLike) -> Floats:
    """Logarithms of 1 + x, exact for small x too (Kahan 1982)."""
    x = np.asarray(x, np.float64)
    near = 1 + x
    off = near - 1
    return np.asarray(np.where(off == 0, x, log(near) * (x / np.where(off == 0, 1, off))))[()]


def expm1(x: ArrayLike) -> Floats:
    """Exponentials of x, less 1, exact for small x too (Kahan 1982)."""
    x = np.asarray(x, np.float64)
    near = exp(x)
    plain = (near == 1) | (near < 0.5) | (near > 2)
    less = near - 1
    found = less * (x / np.where(plain, 1, log(near)))
    return np.where(near == 1, x, np.where(plain, less, found))[()]


def power(x: ArrayLike, exponent: float) -> Floats:
    """Powers of numbers above 0, or 0; of a large exponent less exact."""
    return exp(exponent * log(x))


def cbrt(x: ArrayLike) -> Floats:
    """Cube roots of numbers other than 0; those of cubes are exact."""
    size = np.abs(x)
    root = power(size, 1 / 3)
    root = root - (root * root * root - size) / (3 * root * root)  # Newton's method
    return np.copysign(root, x)


def geomspace(start: float, stop: float, count: int) -> Floats:
    """Return numbers (count,) from one to another above 0 that have one ratio."""
    out = start * exp(np.linspace(0, float(log(stop / start)), count))
    out[-1] = stop
    return out


def interp(x: ArrayLike, at: Floats, values: Floats) -> Floats:
    """Return values between those at ascending places (k,), and the first or last beyond."""
    x = np.asarray(x, np.float64)
    row = np.clip(np.searchsorted(at, x, "right") - 1, 0, max(len(at) - 2, 0))
    with np.errstate(divide="ignore", invalid="ignore"):  # between equal places, of no use
        slopes = np.diff(values, append=values[-1]) / np.diff(at, append=np.inf)
    found = (x - at[row]) * slopes[row] + values[row]
    return np.where(x < at[0], values[0], np.where(x >= at[-1], values[-1], found))


def decade(x: float) -> int:
    """Exponent of the largest power of ten that is at most a number above 0, of 16 digits."""
    return int(f"{x:.15e}".partition("e")[2])


def _each(
    name: str, one: Callable[..., Any], results: int, *given: ArrayLike
) -> tuple[Floats, ...]:
    """Call a function for each number, and give arrays of the shape of the first argument."""
    arrays = [np.asarray(array, np.float64) for array in given]
    shape = arrays[0].shape
    out = np.empty((results, arrays[0].size))
    if arrays[0].size <= _FEW and "numba" not in sys.modules:
        for k, numbers in enumerate(
            zip(*(array.ravel().tolist() for array in arrays), strict=True)
        ):
            out[:, k] = one(*numbers)
    else:
        from . import elementary_loops

        getattr(elementary_loops, name + "_each")(*map(owned, map(np.ravel, arrays)), *out)
    return tuple(row.reshape(shape)[()] for row in out)
