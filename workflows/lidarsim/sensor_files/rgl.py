"""Rays as input arrays of RobotecGPULidar nodes (.npz).

According to its header api/core.h, a ray is a matrix (3, 4) that maps the z axis to the direction
of the ray and the zero vector to its origin. Ring ids are int32, time offsets are float32
milliseconds, and ranges are pairs of float32.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import chain
from math import inf
from pathlib import Path

import numpy as np

from ..numerics.arrays import Floats
from .complete_files import open_complete
from .fired_rays import AXES, RayList
from .ray_header import DIRECTION, ORIGIN, TIME_COLUMN, check_names, rays_of
from .ray_npz import HEADER, header_in, read_arrays

_NAMES = ("rays", "ring_ids", "time_offsets", "ranges")
_STEEP = 0.9  # z component above which a ray is treated as vertical


def write(path: Path, rays: RayList, left_out: Sequence[str]) -> Sequence[str]:
    """Write arrays, each of which is named after the node to which it is an input."""
    times_ns = rays.with_times().times_ns
    assert times_ns is not None  # `with_times` sets the times
    header = {
        "sensor": rays.name,
        "axes": AXES,
        "rays": "rgl_node_rays_from_mat3x4f: rows of matrices; column 3 is the direction",
        "ring_ids": "rgl_node_rays_set_ring_ids",
        "time_offsets": "rgl_node_rays_set_time_offsets: milliseconds since the start of the list",
        "ranges": "rgl_node_rays_set_range: shortest and longest, meters",
        "rate_hz": rays.rate_hz,
        "cycle_ns": rays.cycle_ns,
        "not_in_this_file": list(left_out),
    }
    with open_complete(path) as file:
        np.savez_compressed(
            file,
            allow_pickle=False,
            rays=_matrices(rays).astype(np.float32),
            ring_ids=rays.channels.astype(np.int32),
            time_offsets=(times_ns / 1e6).astype(np.float32),
            ranges=np.array([rays.range_m], np.float32),
            **{HEADER: np.array(json.dumps(header))},
        )
    return left_out


def _matrices(rays: RayList) -> Floats:
    """Return matrices that map the z axis to the rays.

    Their x axes are horizontal and point to the right of the rays, or to -y for vertical rays.
    """
    ahead = rays.directions
    up = np.where(np.abs(ahead[:, 2:]) > _STEEP, [[1.0, 0, 0]], [[0.0, 0, 1]])
    right = np.cross(ahead, up)
    right /= np.sqrt((right * right).sum(axis=1))[:, None]
    return np.stack([right, np.cross(ahead, right), ahead, rays.origins_or_center], axis=2)


def read(path: Path) -> RayList | None:
    """Read rays from RGL arrays. Return None if the arrays have another format.

    Raises
    ------
    ValueError
        If an array has the wrong shape, or if a value is not finite.
    LidarError
        If the content exceeds the memory limit.
    """
    arrays = read_arrays(path)
    if "rays" not in arrays:
        return None
    header = header_in(arrays)
    check_names("arrays", arrays, _NAMES)
    matrices = arrays["rays"]
    if matrices.shape[1:] != (3, 4):
        raise ValueError(f"rays must have the shape (n, 3, 4), but has {matrices.shape}")
    vectors = np.asarray(matrices[:, :, 2:], np.float64).reshape(-1, 6)
    names = chain.from_iterable(zip(DIRECTION, ORIGIN, strict=True))
    columns = dict(zip(names, vectors.T, strict=True))
    if "time_offsets" in arrays:
        columns[TIME_COLUMN] = np.asarray(arrays["time_offsets"], np.float64) * 1e6
    if "ring_ids" in arrays:
        columns["channel"] = arrays["ring_ids"]
    if "ranges" in arrays:
        ranges = np.asarray(arrays["ranges"], np.float64)
        if ranges.shape[-1:] != (2,) or not ranges.size:
            raise ValueError(f"ranges must have the shape (n, 2), but has {ranges.shape}")
        longest_m = float(ranges[..., 1].max())
        header["min_range_m"] = float(ranges[..., 0].min())
        header["max_range_m"] = None if longest_m == inf else longest_m
    return rays_of(columns, header)
