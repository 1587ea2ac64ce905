"""Compute the origins and directions of the rays in a pattern."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from operator import index

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Floats, Ints
from .pattern import Pattern
from .poses import PoseMotion, Poses, check_poses
from .sub_rays import sub_ray_directions

_BLOCK_RAYS = 1 << 14  # number of rays per block, chosen so that their arrays fit into the cache


def pattern_rays(
    pattern: Pattern,
    numbers: ArrayLike,
    positions: ArrayLike | Poses,
    rotations: ArrayLike | None = None,
    *,
    start: int = 0,
    rays_per_pose: int | None = None,
    motion: PoseMotion | None = None,
) -> tuple[Floats, Floats]:
    """Return the origins and directions of a scan's rays in mesh coordinates.

    The rays are bit-identical to the rays that `RayCaster.scan` casts, in any batch.

    Parameters
    ----------
    pattern
        The pattern of the scan.
    numbers
        (m,) integers: ray indices as in `ScanReturns`, starting at 0 for the first ray of the
        window.
    positions, rotations, rays_per_pose, motion
        As for `RayCaster.scan`.
    start
        First row of the window.

    Returns
    -------
    origins
        float64 (m, 3), or (1, 3) if all rays share an origin, in meters.
    directions
        float64 (m, 3), unit vectors.

    Raises
    ------
    ValueError
        If poses are invalid, or if a ray has no pose or no row in the pattern.

    Examples
    --------
    >>> pattern = Pattern([[2, 0, 0], [0, 1, 0]], origins=[[0.1, 0, 0], [0, 0.1, 0]])
    >>> origins, directions = pattern_rays(pattern, [0, 1, 2], positions=[0, 0, 5])
    >>> origins.tolist()
    [[0.1, 0.0, 5.0], [0.0, 0.1, 5.0], [0.1, 0.0, 5.0]]
    >>> directions.tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    """
    ray = np.asarray(numbers).astype(np.int64, casting="same_kind")
    first = index(start)
    stop = int(ray.max()) + 1 if len(ray) else 0
    if first < 0 or (len(ray) and (int(ray.min()) < 0 or not len(pattern))):
        raise ValueError(
            f"Rays {ray.min() if len(ray) else 0} to {stop} from row {start} are outside a pattern "
            f"with {len(pattern)} rows. Ray and row numbers start at 0."
        )
    poses = check_poses(positions, rotations, rays_per_pose, stop, motion)
    return compute_rays(pattern, first, ray, poses)


def compute_rays(pattern: Pattern, first: int, ray: Ints, poses: Poses) -> tuple[Floats, Floats]:
    """Compute the origins and directions of rays, with compiled loops if numba is installed.

    `first` is the pattern row of ray 0, and `ray` (m,) contains ray indices. The arguments are not
    validated. The result is as in `pattern_rays`.
    """
    if not (_numba_is_installed() and len(ray)):
        return compute_rays_numpy(pattern, first, ray, poses)
    from . import ray_loops  # Importing numba takes half a second.

    origins, directions = ray_loops.compute_rays_compiled(pattern, first, ray, poses)
    return (poses.positions if origins is None else origins.T), directions.T


def compute_rays_numpy(
    pattern: Pattern, first: int, ray: Ints, poses: Poses
) -> tuple[Floats, Floats]:
    """Compute the origins and directions of rays with NumPy, as `compute_rays` does.

    Vectors are rotated to the mesh frame and then translated: ``((x a + y b) + z c) + p``. If the
    lidar moves while the rays of a pose are fired, rotations are followed by ``v + t (w x v)`` and
    translations by ``p + t u``.
    """
    shares_origin = pattern.shares_origin(poses)
    origins, directions = np.empty((2, 3, len(ray)))
    scratch = np.empty((18, min(len(ray), _BLOCK_RAYS)))
    for start in range(0, len(ray), _BLOCK_RAYS):
        block = slice(start, start + _BLOCK_RAYS)
        numbers = ray[block]
        ray_poses = poses.per_ray(numbers, scratch[:, : len(numbers)])
        direction, offset = _sensor_rays(pattern, first + numbers)
        directions[:, block] = ray_poses.rotate(direction)
        if shares_origin:
            continue
        origin = ray_poses.positions
        if offset is not None:
            origin = ray_poses.rotate(offset) + origin
        origins[:, block] = ray_poses.translate(origin)
    return (poses.positions if shares_origin else origins.T), directions.T


def _sensor_rays(pattern: Pattern, row: Ints) -> tuple[Floats, Floats | None]:
    """Compute the directions and origins of rays in the sensor frame.

    `row` (m,) contains pattern rows, which may be beyond the end of the pattern. The results have
    shape (3, m). The origins are relative to the sensor position, in meters, or None if all are
    zero.
    """
    row = row - row // len(pattern) * len(pattern)  # takes half as long as the % operator
    beam = row // pattern.subrays_per_beam
    direction = _columns(pattern.directions.T, beam)
    offset = None
    sub_rays = pattern.sub_rays
    if sub_rays is not None:
        angles = None if pattern.offsets is None else pattern.offsets[:, beam]
        direction, offset = sub_ray_directions(
            sub_rays, direction, row - beam * len(sub_rays), angles
        )
    if pattern.origins is not None:
        beam_origin = _columns(pattern.origins.T, beam)
        offset = beam_origin if offset is None else beam_origin + offset
    return direction, offset


@cache
def _numba_is_installed() -> bool:
    return find_spec("numba") is not None


def _columns(table: Floats, row: Ints) -> Floats:
    return np.stack([numbers.take(row) for numbers in table])
