"""Python files that contain the ray arrays of each frame and require only NumPy."""

from __future__ import annotations

import base64
import textwrap
import zlib
from collections.abc import Sequence
from math import isfinite

import numpy as np

from ..numerics.arrays import AnyArray
from .fired_rays import RayList

_WIDTH = 96  # characters per line of packed numbers

_TEXT = '''"""{title}

{words}
"""

import base64
import zlib

import numpy as np

NAME = {name!r}
RATE_HZ = {rate_hz!r}  # frames per second
MIN_RANGE_M = {min_range_m!r}
MAX_RANGE_M = {max_range_m}
FRAMES = {frames}  # in this file; frame FRAMES is frame 0 again


{functions}

def _unpacked(text, dtype):
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype)


_BOUNDS = {bounds}  # first rays of the frames, and the end
{arrays}
'''
_ARRAY = '''_unpacked(
    """
{packed}
    """,
    "{dtype}",
)'''


def python_text(
    rays: RayList,
    title: str,
    words: str,
    left_out: Sequence[str],
    functions: str,
    arrays: dict[str, str],
) -> str:
    """Return the content of a Python file.

    Parameters
    ----------
    rays
        Rays that have times.
    title, words
        Title and text of the file's docstring, which also lists missing properties.
    left_out
        Phrases for properties that the file does not store.
    functions
        Code of functions that return the rays of frame k, from _BOUNDS[k] to _BOUNDS[k + 1].
    arrays
        Expressions for the arrays in the file, as {name: code}.
    """
    assert rays.times_ns is not None and rays.cycle_ns is not None  # the caller sets both
    frames = max(round(rays.cycle_ns * rays.rate_hz / 1e9), 1)
    starts_ns = np.rint(np.arange(1, frames) * (1e9 / rays.rate_hz))
    bounds = [0, *np.searchsorted(rays.times_ns, starts_ns).tolist(), len(rays)]
    min_range_m, max_range_m = rays.range_m
    lacks = f"\n\nNot in this file: {'; '.join(left_out)}." if left_out else ""
    return _TEXT.format(
        title=title.format(name=rays.name.replace('"', "'").replace("\\", "/")),
        words=words + lacks,
        name=rays.name,
        rate_hz=rays.rate_hz,
        min_range_m=min_range_m,
        max_range_m=repr(max_range_m) if isfinite(max_range_m) else 'float("inf")',
        frames=frames,
        functions=functions,
        bounds=bounds,
        arrays="\n".join(f"{name} = {code}" for name, code in arrays.items()),
    )


def array_code(values: AnyArray, dtype: str) -> str:
    """Return a Python expression for a flattened array of the given dtype."""
    content = np.ascontiguousarray(values.astype(dtype)).tobytes()
    packed = base64.b64encode(zlib.compress(content, 9)).decode()
    return _ARRAY.format(packed="\n".join(textwrap.wrap(packed, _WIDTH)), dtype=dtype)


def times_code(rays: RayList) -> str:
    """Return a Python expression for the int64 times of rays, in nanoseconds."""
    assert rays.times_ns is not None  # the caller sets the times
    steps_code = array_code(np.diff(rays.times_ns, prepend=0), "<i8")
    return f"np.cumsum({steps_code})"
