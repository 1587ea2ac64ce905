"""MuJoCo models (.xml) that contain a body with a site and a rangefinder for each ray.

A rangefinder measures along the z axis of its site in each simulation step. See
https://mujoco.readthedocs.io/en/latest/XMLreference.html#sensor-rangefinder
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from xml.sax.saxutils import quoteattr

from ..errors import LidarError
from ..numerics.arrays import Floats
from .complete_files import write_complete_text, xml_comment
from .fired_rays import AXES, RayList

MAX_SITES = 10_000  # limited because MuJoCo casts the rangefinders of each step one by one


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write a model whose body `lidar` has a site and a rangefinder for each ray.

    Raises
    ------
    LidarError
        If the model would have more than `MAX_SITES` sites.
    """
    if len(rays) > MAX_SITES:
        raise LidarError(
            f"{path} would have {len(rays):,} rangefinder sites, but the limit is {MAX_SITES:,}. "
            "Reduce seconds, or write an .npz for MuJoCo-LiDAR (format mujoco)."
        )
    max_range_m = rays.range_m[1]
    cutoff = f' cutoff="{max_range_m!r}"' if isfinite(max_range_m) else ""
    sites = [
        f'      <site name="ray_{number}" pos="{_numbers(start)}" zaxis="{_numbers(direction)}"/>'
        for number, (start, direction) in enumerate(
            zip(rays.origins_or_center, rays.directions, strict=True)
        )
    ]
    finders = [
        f'    <rangefinder name="range_{number}" site="ray_{number}"{cutoff}/>'
        for number in range(len(rays))
    ]
    lines = [
        f"<mujoco model={quoteattr(rays.name)}>",
        f"  <!-- Axes of the body lidar: {AXES}. Sites are in firing order. -->",
        *(f"  <!-- Not in this file: {xml_comment(clause)}. -->" for clause in left_out),
        "  <worldbody>",
        '    <body name="lidar">',
        *sites,
        "    </body>",
        "  </worldbody>",
        "  <sensor>",
        *finders,
        "  </sensor>",
        "</mujoco>",
    ]
    write_complete_text(path, "\n".join(lines) + "\n")
    return left_out


def _numbers(vector: Floats) -> str:
    return " ".join(map(repr, vector.tolist()))
