"""Rays from inside a closed mesh to its edges and corners, where rays are most likely to escape."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from raybeam import RayCaster

Float = NDArray[np.float64]
Index = NDArray[np.integer]
_PART = 1 << 18  # rays that are cast at a time


def seam_rays(
    vertices: Float, faces: Index, origins: Float, count: int, rng: np.random.Generator
) -> Float:
    """Return directions from the origins to corners, edge midpoints, and other points on edges."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edge = vertices[edges[rng.integers(len(edges), size=count)]]
    part = rng.choice([0.0, 0.5, 1.0, np.nan], count)
    part = np.where(np.isnan(part), rng.random(count), part)[:, None]
    return edge[:, 0] * (1 - part) + edge[:, 1] * part - origins


def escaped(
    caster: RayCaster,
    mesh: tuple[Float, Index],
    inside: Float,
    room: float,
    count: int,
    rng: np.random.Generator,
) -> int:
    """Count escaping rays among `count` rays from a point and `count` rays from points around it.

    `inside` is a point (3,) inside the closed mesh. `room` is the distance by which this point may
    be moved along each axis.
    """
    leaks = 0
    for origins in (inside, inside + room * rng.uniform(-1, 1, (count, 3))):
        directions = seam_rays(*mesh, origins, count, rng)
        leaks += count - int(caster.cast(origins, directions).hit.sum())
    return leaks


def count_escaped(
    caster: RayCaster, mesh: tuple[Float, Index], inside: Float, room: float, count: int
) -> dict[str, int]:
    """Count escaping rays among about `count` rays, which are cast in parts to limit memory."""
    rng = np.random.default_rng(0)
    cast = leaks = 0
    while cast < count:
        half = -(-min(_PART, count - cast) // 2)
        leaks += escaped(caster, mesh, inside, room, half, rng)
        cast += 2 * half
    return {"rays": cast, "escaped": leaks}
