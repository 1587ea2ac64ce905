"""Divide a scan's rays into tiles of neighboring rays.

The rays of a pattern are stored firing by firing. The rings of a firing are not necessarily sorted
by elevation, and their beams may point at different azimuths, several degrees apart. Therefore,
rings are sorted by elevation, and a tile takes the rays of each ring from the firings that pass the
same azimuth. The division affects only the speed and not the results.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .arrays import Floats, Ints
from .pattern_rays import compute_rays
from .scan import Scan
from .tile_sizes import SUBTILES, VECTOR_RAYS, lanes_per_beam

# Limit for all tiles of a column. Longer firings are divided into consecutive rays.
_MAX_LANES = 1 << 20
# Rings are not shifted in scans with fewer firings than this multiple of the largest shift, because
# too many tiles would be incomplete.
_FEW_FIRINGS = 4
# Casting smaller images separately would take longer than casting a few tiles with rays from two
# images.
_MIN_IMAGE_RAYS = 1024


class TilePlan(NamedTuple):
    """Tiles into which the rays of a scan are divided.

    Attributes
    ----------
    firing
        Rays per firing, including all sub-rays.
    firings
        Firings per tile. A new column of tiles starts after this number of firings.
    lanes
        int64 (groups, rays): index of each ray of a tile relative to the first ray of the tile's
        first firing. Each group of rings has separate tiles.
    shifts
        int64 (groups,): number of firings by which the first tile of a group starts before the
        first firing.
    """

    firing: int
    firings: int
    lanes: Ints
    shifts: Ints

    @property
    def rays(self) -> int:
        """Number of rays per tile."""
        return self.lanes.shape[1]


def image_rays(scan: Scan, firing: int) -> int:
    """Return the number of rays per image if a scan consists of several large images, otherwise 0.

    All rays of an image have the same pose. The poses of images can be far apart, whereas a moving
    lidar has a pose for each firing. A tile with rays from two images would test all triangles
    between the images.
    """
    rays = scan.poses.rays_per_pose
    return rays if max(firing, _MIN_IMAGE_RAYS) < rays < len(scan) else 0


def plan_consecutive(subrays: int) -> TilePlan:
    """Create a plan in which each tile consists of consecutive beams with all of their sub-rays."""
    beams = np.arange(SUBTILES * VECTOR_RAYS)
    return TilePlan(
        subrays, len(beams), _sub_ray_lanes(beams, subrays)[None], np.zeros(1, np.int64)
    )


def _sub_ray_lanes(beams: Ints, subrays: int) -> Ints:
    """Return the ray index of every sub-ray in the given beams.

    The sub-rays of each beam are padded to whole vectors.
    """
    if subrays == 1:
        return beams
    # Padded with copies of the last sub-ray.
    sub_ray = np.minimum(np.arange(lanes_per_beam(subrays)), subrays - 1)
    return (beams[..., None] * subrays + sub_ray).reshape(*beams.shape[:-1], -1)


def plan_tiles(scan: Scan) -> TilePlan:
    """Create the tile plan for a scan from the directions of two firings."""
    subrays = scan.pattern.subrays_per_beam
    step = scan.pattern.step
    firing = step * subrays
    start = -scan.first % firing  # first ray of the first complete firing
    rays = image_rays(scan, firing) or len(scan)
    whole_firings = (rays - start) // firing
    if step == 1 or whole_firings < 2 or firing * SUBTILES * VECTOR_RAYS > _MAX_LANES:
        return plan_consecutive(subrays)
    start += (whole_firings - 2) // 2 * firing
    beams = start + subrays * np.arange(step)
    _, directions = compute_rays(scan.pattern, scan.first, np.r_[beams, beams + firing], scan.poses)
    rings, shifts, spacings = _sort_rings(directions[:step], directions[step:])
    if whole_firings < _FEW_FIRINGS * np.ptp(shifts):
        shifts[:] = 0
    return _plan_from_rings(rings, shifts, spacings, subrays)


def _sort_rings(first: Floats, second: Floats) -> tuple[Ints, Ints, tuple[float, float]]:
    """Find neighboring rings by comparing the directions of two firings.

    The directions have shape (n, 3), and the firings must be consecutive.

    Returns
    -------
    rings
        (n,): indices of the rings, sorted by their elevation above the plane of rotation.
    shifts
        (n,): number of firings after which each of these rings passes the azimuth of the first
        ring.
    spacings
        Angle between firings and angle between rings, in radians.
    """
    axis = np.cross(first, second).sum(axis=0)
    rings = np.argsort((first * axis).sum(axis=1), kind="stable")
    ahead = (second - first)[rings]
    squared = np.maximum((ahead * ahead).sum(axis=1), 1e-24)
    steps = np.diff(first[rings], axis=0)
    along = (steps * ahead[1:]).sum(axis=1) / squared[1:]
    along = np.clip(along, -1e6, 1e6)
    across = steps - along[:, None] * ahead[1:]
    ring_spacing = float(np.median(np.sqrt((across * across).sum(axis=1))))
    shifts = -np.rint(np.r_[0, np.cumsum(along)]).astype(np.int64)
    return rings, shifts, (float(np.sqrt(np.median(squared))), max(ring_spacing, 1e-12))


def _plan_from_rings(
    rings: Ints, shifts: Ints, spacings: tuple[float, float], subrays: int
) -> TilePlan:
    """Create a plan whose tiles cover nearly square ranges of angles."""
    step = len(rings)
    firing = step * subrays
    each = 1 if subrays > 1 else 2  # vectors per subtile, without sub-rays
    beams = SUBTILES * VECTOR_RAYS * each
    most_rings = 1 << (step.bit_length() - 1)
    tile = _squarest_grid(beams, spacings, most_rings, beams)
    subtile = _squarest_grid(VECTOR_RAYS * each, spacings, *tile)
    vector = _squarest_grid(VECTOR_RAYS, spacings, *subtile)
    # Numbers of rings and firings: subtiles per tile, vectors per subtile, and rays per vector.
    grids = [
        (tile[0] // subtile[0], tile[1] // subtile[1]),
        (subtile[0] // vector[0], subtile[1] // vector[1]),
        vector,
    ]
    ring = np.zeros(1, np.int64)
    later = np.zeros(1, np.int64)
    for ring_count, firing_count in grids:
        ring = (ring[:, None, None] * ring_count + np.arange(ring_count)[:, None]) + np.zeros(
            firing_count, np.int64
        )
        later = (
            later[:, None, None] * firing_count
            + np.arange(firing_count)
            + np.zeros((ring_count, 1), np.int64)
        )
        ring = ring.reshape(-1)
        later = later.reshape(-1)
    groups = -(-step // tile[0])
    chosen = np.minimum(np.arange(groups)[:, None] * tile[0] + ring, step - 1)
    shift = shifts[chosen]
    shift = shift - shift.min(axis=1, keepdims=True)
    beam = (later + shift) * step + rings[chosen]
    return TilePlan(firing, tile[1], _sub_ray_lanes(beam, subrays), shift.max(axis=1))


def _squarest_grid(
    beams: int, spacings: tuple[float, float], most_rings: int, most_firings: int
) -> tuple[int, int]:
    """Choose the numbers of rings and firings that form the most nearly square tile.

    Their product is `beams`.
    """
    firing_spacing, ring_spacing = spacings
    best = (1, beams)
    least = np.inf
    rings = 1
    while rings <= min(beams, most_rings):
        firings = beams // rings
        ratio = rings * ring_spacing / (firings * firing_spacing)
        difference = max(ratio, 1 / ratio)
        if firings <= most_firings and difference < least:
            least = difference
            best = rings, firings
        rings *= 2
    return best
