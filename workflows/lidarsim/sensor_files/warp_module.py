"""Rays as one Python file (.py), for programs that cast rays with Warp, such as Isaac Lab.

The file needs NumPy only. Its function `rays` returns origins, directions and times of a frame, in
the sensor frame: x forward, y left, z up.
"""

from __future__ import annotations

import base64
import textwrap
import zlib
from collections.abc import Sequence
from math import isfinite
from pathlib import Path

import numpy as np

from ..base.arrays import AnyArray
from .complete_files import write_text_of
from .fired_rays import AXES, FiredRays

_WIDTH = 96  # letters of a line of packed numbers

# The text of a file. Lengths of frames are in the order of time; the lists of numbers are packed.
_TEXT = '''"""Rays of {name}, as lidarpool wrote them.

Axes: {axes}. Directions are float32 unit vectors, origins metres, times nanoseconds
since the start of the pattern. {lacks}

    origins, directions, times_ns = rays(frame=0)
"""

import base64
import zlib

import numpy as np

NAME = {name!r}
RATE_HZ = {rate_hz!r}  # frames a second
MIN_RANGE_M = {min_range_m!r}
MAX_RANGE_M = {max_range_m}
FRAMES = {frames}  # in this file; frame FRAMES is frame 0 again


def rays(frame=0):
    """Return origins (n, 3), directions (n, 3) and times (n,) of the rays of a frame."""
    start, stop = _BOUNDS[frame % FRAMES], _BOUNDS[frame % FRAMES + 1]
    return _ORIGINS[start:stop], _DIRECTIONS[start:stop], _TIMES_NS[start:stop]


def _unpacked(text, dtype):
    return np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype)


_BOUNDS = {bounds}
_DIRECTIONS = _unpacked(
    """
{directions}
    """,
    "<f4",
).reshape(-1, 3)
_TIMES_NS = np.cumsum(
    _unpacked(
        """
{steps}
        """,
        "<i8",
    )
)
_ORIGINS = {origins}
'''
_ORIGINS = '''_unpacked(
    """
{origins}
    """,
    "<f4",
).reshape(-1, 3)'''


def write(path: Path, rays: FiredRays, left_out: Sequence[str]) -> Sequence[str]:
    """Write a Python file."""
    rays = rays.timed()
    assert rays.times_ns is not None and rays.cycle_ns is not None  # of timed rays
    min_range_m, max_range_m = rays.range_m
    frames = max(round(rays.cycle_ns * rays.rate_hz / 1e9), 1)
    starts_ns = np.rint(np.arange(1, frames) * (1e9 / rays.rate_hz))
    bounds = [0, *np.searchsorted(rays.times_ns, starts_ns).tolist(), len(rays)]
    origins = "np.zeros_like(_DIRECTIONS)"
    if rays.origins is not None:
        origins = _ORIGINS.format(origins=_packed(rays.origins.astype("<f4")))
    lacks = f"Not in this file: {'; '.join(left_out)}." if left_out else ""
    text = _TEXT.format(
        name=rays.name.replace('"', "'").replace("\\", "/"),
        axes=AXES,
        lacks=lacks,
        rate_hz=rays.rate_hz,
        min_range_m=min_range_m,
        max_range_m=repr(max_range_m) if isfinite(max_range_m) else 'float("inf")',
        frames=frames,
        bounds=bounds,
        directions=_packed(rays.directions.astype("<f4")),
        steps=_packed(np.diff(rays.times_ns, prepend=0).astype("<i8")),
        origins=origins,
    )
    write_text_of(path, text)
    return left_out


def _packed(values: AnyArray) -> str:
    """Return the bytes of an array as lines of text."""
    packed = base64.b64encode(zlib.compress(np.ascontiguousarray(values).tobytes(), 9)).decode()
    return "\n".join(textwrap.wrap(packed, _WIDTH))
