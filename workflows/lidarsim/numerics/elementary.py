"""Elementary functions of arrays that are bit-identical on every processor.

The results of NumPy and C library functions differ in the last bits between versions and
processors. The functions in this module apply `elementary_scalars` to each element. They use
compiled loops, or plain Python for small arrays because importing numba takes half a second.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, to_writable
from .elementary_scalars import arctan2_of, exp_of, log_of, sin_cos_of

_MAX_INTERPRETED = 1 << 12  # maximum array size for plain Python, which takes about 20 ms


def sin_cos(x: ArrayLike) -> tuple[Floats, Floats]:
    """Return the sines and cosines of angles in radians."""
    sine, cosine = _apply("sin_cos", sin_cos_of, 2, x)
    return sine, cosine


def sin(x: ArrayLike) -> Floats:
    """Return the sines of angles in radians."""
    return sin_cos(x)[0]


def cos(x: ArrayLike) -> Floats:
    """Return the cosines of angles in radians."""
    return sin_cos(x)[1]


def exp(x: ArrayLike) -> Floats:
    """Return the exponentials of numbers."""
    return _apply("exp", exp_of, 1, x)[0]


def log(x: ArrayLike) -> Floats:
    """Return the natural logarithms of numbers."""
    return _apply("log", log_of, 1, x)[0]


def arctan2(y: ArrayLike, x: ArrayLike) -> Floats:
    """Return the angles in radians of vectors with the components `x` and `y`."""
    return _apply("arctan2", arctan2_of, 1, *np.broadcast_arrays(y, x))[0]


def arcsin(x: ArrayLike) -> Floats:
    """Return the angles in radians whose sines are `x`."""
    x = np.asarray(x, np.float64)
    return arctan2(x, np.sqrt((1 - x) * (1 + x)))


def arccos(x: ArrayLike) -> Floats:
    """Return the angles in radians whose cosines are `x`."""
    x = np.asarray(x, np.float64)
    return arctan2(np.sqrt((1 - x) * (1 + x)), x)


def log1p(x: ArrayLike) -> Floats:
    """Return log(1 + x), which is also accurate for small x (Kahan 1982)."""
    x = np.asarray(x, np.float64)
    argument = 1 + x
    rounded = argument - 1
    scale = x / np.where(rounded == 0, 1, rounded)
    return np.asarray(np.where(rounded == 0, x, log(argument) * scale))[()]


def expm1(x: ArrayLike) -> Floats:
    """Return exp(x) - 1, which is also accurate for small x (Kahan 1982)."""
    x = np.asarray(x, np.float64)
    exponential = exp(x)
    is_plain = (exponential == 1) | (exponential < 0.5) | (exponential > 2)
    difference = exponential - 1
    corrected = difference * (x / np.where(is_plain, 1, log(exponential)))
    return np.where(exponential == 1, x, np.where(is_plain, difference, corrected))[()]


def power(x: ArrayLike, exponent: float) -> Floats:
    """Raise nonnegative numbers to a power.

    The results are less accurate if the exponent is large.
    """
    return exp(exponent * log(x))


def cbrt(x: ArrayLike) -> Floats:
    """Return the cube roots of nonzero numbers.

    The roots of perfect cubes are exact.
    """
    size = np.abs(x)
    root = power(size, 1 / 3)
    root = root - (root * root * root - size) / (3 * root * root)  # Newton's method
    return np.copysign(root, x)


def geomspace(start: float, stop: float, count: int) -> Floats:
    """Return `count` geometrically spaced numbers from `start` to `stop`, inclusive.

    Both limits must be positive.
    """
    numbers = start * exp(np.linspace(0, float(log(stop / start)), count))
    numbers[-1] = stop
    return numbers


def interp(x: ArrayLike, knots: Floats, values: Floats) -> Floats:
    """Interpolate linearly between values at ascending knots.

    `knots` and `values` have shape (k,). Beyond the first and last knot, the result is constant.
    """
    x = np.asarray(x, np.float64)
    row = np.clip(np.searchsorted(knots, x, "right") - 1, 0, max(len(knots) - 2, 0))
    with np.errstate(divide="ignore", invalid="ignore"):  # slopes between equal knots are unused
        slopes = np.diff(values, append=values[-1]) / np.diff(knots, append=np.inf)
    interpolated = (x - knots[row]) * slopes[row] + values[row]
    return np.where(x < knots[0], values[0], np.where(x >= knots[-1], values[-1], interpolated))


def decade(x: float) -> int:
    """Return the decimal exponent of a positive number after rounding it to 16 digits."""
    return int(f"{x:.15e}".partition("e")[2])


def _apply(
    name: str, function: Callable[..., Any], results: int, *arguments: ArrayLike
) -> tuple[Floats, ...]:
    """Apply a function elementwise.

    The results have the shape of the first argument.
    """
    arrays = [np.asarray(array, np.float64) for array in arguments]
    shape = arrays[0].shape
    output = np.empty((results, arrays[0].size))
    if arrays[0].size <= _MAX_INTERPRETED and "numba" not in sys.modules:
        for k, numbers in enumerate(
            zip(*(array.ravel().tolist() for array in arrays), strict=True)
        ):
            output[:, k] = function(*numbers)
    else:
        from . import elementary_loops

        getattr(elementary_loops, name + "_each")(*map(to_writable, map(np.ravel, arrays)), *output)
    return tuple(row.reshape(shape)[()] for row in output)
