"""Gazebo <gpu_lidar> sensors (.sdf), whose rays must form regular grids.

See http://sdformat.org/spec?ver=1.9&elem=sensor. Azimuths increase counterclockwise from x, and
elevations are measured above the xy plane. Both are evenly spaced, in radians, including both ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from ..errors import LidarError
from ..numerics.arrays import Floats, Ints
from .complete_files import write_complete_text, xml_comment
from .fired_rays import AXES, RayList

_SLACK_DEG = 1e-4  # tolerance of even spacing
_SAME_DEG = 1e-6  # angles that differ by less are treated as equal
_ADVICE = "The formats livox, npz and csv support any rays."


class _Angles(NamedTuple):
    """Evenly spaced angles in degrees, including both ends."""

    first_deg: float
    last_deg: float
    samples: int


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write a model that contains a <gpu_lidar> sensor.

    Raises
    ------
    LidarError
        If the rays do not form a regular grid. The message explains why.
    """
    horizontal, vertical = _grid(rays)
    min_range_m, max_range_m = rays.range_m
    lines = [
        '<?xml version="1.0"?>',
        '<sdf version="1.9">',
        f"  <!-- {xml_comment(rays.name)}. Axes: {AXES}. -->",
        *(f"  <!-- Not in this file: {xml_comment(clause)}. -->" for clause in left_out),
        '  <model name="lidar">',
        '    <link name="lidar">',
        f'      <sensor name={quoteattr(rays.name or "lidar")} type="gpu_lidar">',
        "        <always_on>true</always_on>",
        f"        <update_rate>{rays.rate_hz!r}</update_rate>",
        "        <topic>lidar</topic>",
        "        <lidar>",
        "          <scan>",
        *_scan("horizontal", horizontal),
        *_scan("vertical", vertical),
        "          </scan>",
        f"          <range><min>{min_range_m!r}</min><max>{max_range_m!r}</max></range>",
        "        </lidar>",
        "      </sensor>",
        "    </link>",
        "  </model>",
        "</sdf>",
    ]
    write_complete_text(path, "\n".join(lines) + "\n")
    return left_out


def _scan(name: str, angles: _Angles) -> list[str]:
    limits = np.radians([angles.first_deg, angles.last_deg]).tolist()
    return [
        f"            <{name}>",
        f"              <samples>{angles.samples}</samples>",
        f"              <min_angle>{limits[0]!r}</min_angle>",
        f"              <max_angle>{limits[1]!r}</max_angle>",
        f"            </{name}>",
    ]


def _grid(rays: RayList) -> tuple[_Angles, _Angles]:
    """Return the azimuths and elevations of the regular grid that the rays form.

    Raises
    ------
    LidarError
        If the rays do not form a regular grid.
    """
    azimuths = _levels(np.mod(rays.azimuths_deg + _SAME_DEG / 4, 360))
    elevations = _levels(rays.elevations_deg)
    pairs = np.unique(azimuths.of_ray * len(elevations.angles_deg) + elevations.of_ray)
    expected = len(azimuths.angles_deg) * len(elevations.angles_deg)
    if len(pairs) != expected:
        raise LidarError(
            f"{rays.name} is not a regular grid, which <gpu_lidar> requires. Its {len(pairs):,} "
            f"rays have {len(azimuths.angles_deg):,} azimuths and {len(elevations.angles_deg):,} "
            "elevations, because channels fire at different azimuths or the pattern has no rows. "
            f"{_ADVICE}"
        )
    vertical = _even(rays.name, "elevations", elevations.angles_deg)
    # A sector starts after the widest gap between azimuths.
    gaps = np.diff(azimuths.angles_deg, append=azimuths.angles_deg[0] + 360)
    start = (int(gaps.argmax()) + 1) % len(gaps)
    if np.ptp(gaps) < _SLACK_DEG:
        start = int(azimuths.of_ray[0])
    ordered = np.roll(azimuths.angles_deg, -start)
    ordered = np.where(ordered < ordered[0], ordered + 360, ordered)
    if ordered[0] > 180 or (ordered[0] == 180 and len(ordered) > 1):
        ordered = ordered - 360
    return _even(rays.name, "azimuths", ordered), vertical


class _Levels(NamedTuple):
    """Distinct angles, and the index of each ray's angle."""

    angles_deg: Floats  # (k,), ascending
    of_ray: Ints  # (n,): index into `angles_deg` for each ray


def _levels(angles_deg: Floats) -> _Levels:
    order = np.argsort(angles_deg, kind="stable")
    is_new = np.diff(angles_deg[order], prepend=-np.inf) > _SAME_DEG
    of_ray = np.empty(len(order), np.int64)
    of_ray[order] = np.cumsum(is_new) - 1
    return _Levels(angles_deg[order][is_new], of_ray)


def _even(name: str, words: str, angles_deg: Floats) -> _Angles:
    """Return the first, the last and the number of evenly spaced angles.

    Raises LidarError if the angles are not evenly spaced.
    """
    count = len(angles_deg)
    even_deg = np.linspace(angles_deg[0], angles_deg[-1], count)
    if np.abs(even_deg - angles_deg).max() > _SLACK_DEG:
        steps = np.diff(angles_deg)
        raise LidarError(
            f"{name} is not a regular grid, which <gpu_lidar> requires. Neighboring {words} are "
            f"{steps.min():.4g} to {steps.max():.4g} degrees apart. {_ADVICE}"
        )
    return _Angles(float(angles_deg[0]), float(angles_deg[-1]), count)
