"""Rays as a Python file (.py), for programs such as Isaac Lab that cast rays with Warp.

The file requires only NumPy. Its function `rays` returns origins, directions and times of the rays
in a frame, in the sensor frame with x forward, y left and z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from .complete_files import write_complete_text
from .fired_rays import AXES, RayList
from .python_file import array_code, python_text, times_code

_WORDS = f"""Axes: {AXES}. Directions are float32 unit vectors, origins meters, times
nanoseconds since the start of the pattern.

    origins, directions, times_ns = rays(frame=0)"""
_FUNCTIONS = '''def rays(frame=0):
    """Return origins (n, 3), directions (n, 3) and times (n,) of the rays of a frame."""
    start, stop = _BOUNDS[frame % FRAMES], _BOUNDS[frame % FRAMES + 1]
    return _ORIGINS[start:stop], _DIRECTIONS[start:stop], _TIMES_NS[start:stop]
'''


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write rays to a Python file."""
    rays = rays.with_times()
    origins = "np.zeros_like(_DIRECTIONS)"
    if rays.origins is not None:
        origins = f"{array_code(rays.origins, '<f4')}.reshape(-1, 3)"
    arrays = {
        "_DIRECTIONS": f"{array_code(rays.directions, '<f4')}.reshape(-1, 3)",
        "_TIMES_NS": times_code(rays),
        "_ORIGINS": origins,
    }
    title = "Rays of {name}, written by lidarpool."
    write_complete_text(path, python_text(rays, title, _WORDS, left_out, _FUNCTIONS, arrays))
    return left_out
