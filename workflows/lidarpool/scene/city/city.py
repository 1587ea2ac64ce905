"""A city as a scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...base.errors import LidarpoolError
from ..scene import Scene
from . import parts
from .layout import CLASSES, PAVEMENT, Catalogue, Placements, lay_blocks, place_all
from .solids import Solid, box

LEAST_TRIANGLES = 1_000
MOST_TRIANGLES = 100_000_000
_GROUND_SHARE = 0.03  # of the triangles, at least
_MARGIN_M = 12.0


def city(triangles: int = 100_000, seed: int = 0) -> Scene:
    """Make a city of a number of triangles: more of them make a larger city, not a finer one.

    There is a crossing at (0, 0), where a sensor may stand. The ground, at z = 0, is an object,
    the pavement of all blocks is one, and every building, tree, car and lamp is one of its own:
    building-12, tree-7, counted from the centre.

    Parameters
    ----------
    triangles
        At least 1000. The scene has as many, less one in fifty at the most.
    seed
        The same seed and number give the same city.

    Raises
    ------
    LidarpoolError
        For a number of triangles that is out of range, or a negative seed.

    Examples
    --------
    >>> scene = city(20_000)
    >>> scene.names[:2], 19_800 <= len(scene.faces) <= 20_000
    (('ground', 'pavement'), True)
    """
    if not LEAST_TRIANGLES <= triangles <= MOST_TRIANGLES:
        raise LidarpoolError(
            f"A city of {triangles} triangles cannot be made: "
            f"give {LEAST_TRIANGLES} to {MOST_TRIANGLES}."
        )
    if seed < 0:
        raise LidarpoolError(f"seed is {seed}; it must be at least 0.")
    kinds, catalogue = _catalogue(seed)
    sizes = np.array([len(kind.faces) for kind in kinds])
    budget = int((1 - _GROUND_SHARE) * triangles)
    things = _placements(catalogue, sizes, budget, seed)
    left = triangles - int(sizes[things.kind].sum())
    return _scene(kinds, things, _ground(things, left))


def _catalogue(seed: int) -> tuple[list[Solid], Catalogue]:
    """All kinds of things, and how many of each class."""
    slab = box(1, 1, 0.15)
    groups = [
        [slab], parts.towers(), parts.houses(), parts.trees(seed), parts.cars(), parts.lamps()
    ]  # fmt: skip
    return [kind for group in groups for kind in group], Catalogue(*map(len, groups))


def _placements(
    catalogue: Catalogue, sizes: NDArray[np.int64], budget: int, seed: int
) -> Placements:
    """As many things, from the centre outwards, as the budget of triangles allows."""
    rings = 1
    while True:
        rng = np.random.default_rng(seed)
        things = place_all(lay_blocks(rings, rng), catalogue, rng)
        used = np.cumsum(sizes[things.kind])
        if used[-1] >= budget:
            return things.only(slice(0, int(np.searchsorted(used, budget, side="right"))))
        # Triangles grow with the square of the rings; the centre's towers have the most.
        rings = max(rings + 1, int(np.sqrt(budget / used[-1]) * rings))


def _ground(things: Placements, triangles: int) -> Solid:
    """Flat ground under everything, of as many triangles as are left."""
    blocks = things.only(np.flatnonzero(things.owner == PAVEMENT))
    reach = (np.abs(blocks.place) + blocks.scale / 2).max(axis=0) + _MARGIN_M
    rows = max(1, int(np.sqrt(triangles / 2)))
    columns = max(1, triangles // (2 * rows))
    x = np.linspace(-reach[0], reach[0], columns + 1)
    y = np.linspace(-reach[1], reach[1], rows + 1)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=-1)
    corner = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).reshape(-1)
    beside = corner + rows + 1
    faces = [
        np.stack([corner, beside, beside + 1], axis=-1),
        np.stack([corner, beside + 1, corner + 1], axis=-1),
    ]
    return Solid(points.reshape(-1, 3), np.concatenate(faces))


def _scene(kinds: list[Solid], things: Placements, ground: Solid) -> Scene:
    """Put copies of the kinds where they belong."""
    points = np.array([len(kind.vertices) for kind in kinds])[things.kind]
    sides = np.array([len(kind.faces) for kind in kinds])[things.kind]
    first_point = len(ground.vertices) + np.cumsum(points) - points
    first_face = len(ground.faces) + np.cumsum(sides) - sides
    vertices = np.empty((len(ground.vertices) + int(points.sum()), 3))
    faces = np.empty((len(ground.faces) + int(sides.sum()), 3), np.int32)
    vertices[: len(ground.vertices)] = ground.vertices
    faces[: len(ground.faces)] = ground.faces
    for number, kind in enumerate(kinds):
        rows = np.flatnonzero(things.kind == number)
        if len(rows):
            at = first_point[rows, None] + np.arange(len(kind.vertices))
            vertices[at] = _copies(kind, things.only(rows))
            at = first_face[rows, None] + np.arange(len(kind.faces))
            faces[at] = kind.faces + first_point[rows, None, None]
    ids = np.cumsum(things.owner != PAVEMENT) + 1  # ground is 0, all pavement 1
    ids[things.owner == PAVEMENT] = 1
    owner = np.repeat(np.append(0, ids), np.append(len(ground.faces), sides)).astype(np.int32)
    return Scene(vertices, faces, owner, ("ground", "pavement", *_names(things)), np.zeros(3))


def _copies(kind: Solid, things: Placements) -> NDArray[np.float64]:
    """Vertices of one kind at every place: (things, v, 3)."""
    out = kind.vertices * things.scale[:, None]
    cos, sin = np.cos(things.yaw)[:, None], np.sin(things.yaw)[:, None]
    x, y = out[..., 0].copy(), out[..., 1].copy()
    out[..., 0] = x * cos - y * sin
    out[..., 1] = x * sin + y * cos
    out += things.place[:, None]
    return out


def _names(things: Placements) -> list[str]:
    """Name all but the pavement by class, numbered from 1 from the centre outwards."""
    owners = things.owner[things.owner != PAVEMENT]
    number = np.empty(len(owners), np.int64)
    for owner in np.unique(owners):
        rows = np.flatnonzero(owners == owner)
        number[rows] = np.arange(1, len(rows) + 1)
    return [
        f"{CLASSES[owner]}-{k}" for owner, k in zip(owners.tolist(), number.tolist(), strict=True)
    ]
