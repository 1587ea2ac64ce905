"""Where things stand in the city: a table of placements, from the centre outwards.

Streets run along x and y and two of them cross at (0, 0). Blocks between them are divided into
lots, two rows back to back; the nearer to the centre, the more of them hold towers. Everything
is made for all blocks at once, by arrays, so that ten million triangles are no more code and
few more seconds than a thousand.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

CLASSES = ("pavement", "building", "tree", "car", "lamp")
PAVEMENT, BUILDING, TREE, CAR, LAMP = range(len(CLASSES))

_STREET_M, _AVENUE_M, _AVENUE_EVERY = 13.0, 24.0, 4
_BLOCK_M = ((60.0, 100.0), (46.0, 62.0))  # along x, along y
_PAVEMENT_M = 3.5
_LOT_M = 16.5
_PARKS = 0.09  # share of the blocks


@dataclass(frozen=True)
class Catalogue:
    """How many kinds there are of each class; kinds are numbered through all classes."""

    pavement: int
    tower: int
    house: int
    tree: int
    car: int
    lamp: int

    def start(self, name: str) -> int:
        """Return the number of the first kind of a class."""
        names = [field.name for field in fields(self)]
        return sum(getattr(self, earlier) for earlier in names[: names.index(name)])


@dataclass(frozen=True, eq=False)
class Placements:
    """One row a thing.

    Attributes
    ----------
    kind, owner
        int64 (n,): kind in the catalogue; index of its class in `CLASSES`.
    block
        int64 (n,): number of the block that it belongs to, counted from the centre.
    place
        float64 (n, 3): x, y, z in metres.
    yaw
        float64 (n,): radians, counter-clockwise.
    scale
        float64 (n, 3): along its own axes.
    """

    kind: NDArray[np.int64]
    owner: NDArray[np.int64]
    block: NDArray[np.int64]
    place: Float
    yaw: Float
    scale: Float

    def __len__(self) -> int:
        return len(self.kind)

    def only(self, rows: NDArray[np.intp] | slice) -> Placements:
        """Return some of the rows."""
        return Placements(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class Blocks:
    """Rectangles between streets, from the centre outwards.

    Attributes
    ----------
    middle, size
        float64 (n, 2), metres.
    park
        bool (n,): holds trees only.
    """

    middle: Float
    size: Float
    park: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.middle)


def lay_blocks(rings: int, rng: np.random.Generator) -> Blocks:
    """Lay ``(2 * rings) ** 2`` blocks around the crossing at (0, 0)."""
    spans = []
    for least, most in _BLOCK_M:
        halves = []
        for side in (1, -1):
            streets = np.full(rings, _STREET_M)
            streets[::_AVENUE_EVERY] = _AVENUE_M
            streets[0] /= 2  # the other half of the central one is on the other side
            width = rng.uniform(least, most, rings)
            start = np.cumsum(streets + width) - width
            halves.append((side * (start + width / 2), width))
        spans.append([np.concatenate(parts) for parts in zip(*halves, strict=True)])
    (x, width), (y, depth) = spans
    middle = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    size = np.stack(np.meshgrid(width, depth, indexing="ij"), axis=-1).reshape(-1, 2)
    order = np.argsort(np.hypot(*middle.T), kind="stable")
    park = rng.random(len(middle)) < _PARKS
    park[:4] = False  # never at the centre
    return Blocks(middle[order], size[order], park)


def place_all(blocks: Blocks, catalogue: Catalogue, rng: np.random.Generator) -> Placements:
    """Everything on and around the blocks, block by block, within a block in random order."""
    tables = [
        _slabs(blocks, catalogue),
        *_lots(blocks, catalogue, rng),
        _park_trees(blocks, catalogue, rng),
        _along_streets(blocks, catalogue, rng, TREE, inwards=1.6, spacing=9.0, chance=0.55),
        _along_streets(blocks, catalogue, rng, CAR, inwards=-1.3, spacing=6.5, chance=0.35),
        _along_streets(blocks, catalogue, rng, LAMP, inwards=0.6, spacing=26.0, chance=0.95),
    ]
    columns = ([getattr(table, field.name) for table in tables] for field in fields(Placements))
    whole = Placements(*(np.concatenate(parts) for parts in columns))
    turn = np.where(whole.owner == PAVEMENT, -1.0, rng.random(len(whole)))
    return whole.only(np.lexsort((turn, whole.block)))


def _table(
    owner: int,
    kind: NDArray[np.int64],
    block: NDArray[np.int64],
    xy: Float,
    yaw: Float,
    scale: Float,
    z: float = 0.15,
) -> Placements:
    n = len(kind)
    place = np.column_stack([xy, np.full(n, z)])
    return Placements(kind, np.full(n, owner), block, place, yaw, scale)


def _slabs(blocks: Blocks, catalogue: Catalogue) -> Placements:
    """Raise the ground of each block."""
    n = len(blocks)
    kind = np.full(n, catalogue.start("pavement"))
    scale = np.column_stack([blocks.size, np.ones(n)])
    return _table(PAVEMENT, kind, np.arange(n), blocks.middle, np.zeros(n), scale, z=0.0)


def _lots(blocks: Blocks, catalogue: Catalogue, rng: np.random.Generator) -> list[Placements]:
    """Towers and houses, and the trees behind the houses."""
    built = np.flatnonzero(~blocks.park)
    inner = blocks.size[built] - 2 * _PAVEMENT_M
    across = np.maximum(2, np.round(inner[:, 0] / _LOT_M)).astype(np.int64)
    block = np.repeat(built, 2 * across)
    number = np.arange(len(block)) - np.repeat(np.cumsum(2 * across) - 2 * across, 2 * across)
    column, back = number // 2, number % 2
    lot = np.repeat(np.column_stack([inner[:, 0] / across, inner[:, 1] / 2]), 2 * across, axis=0)
    side = 2.0 * back - 1  # -1: its street is to the south
    corner = blocks.middle[block] - np.repeat(inner, 2 * across, axis=0) / 2
    x = corner[:, 0] + (column + 0.5) * lot[:, 0]
    edge = blocks.middle[block, 1] + side * lot[:, 1]  # of the pavement
    yaw: Float = np.pi * back.astype(np.float64)
    reach = 60 + 0.3 * np.hypot(*blocks.middle.T).max()
    near = np.exp(-((np.hypot(*blocks.middle[block].T) / reach) ** 2))
    tower = rng.random(len(block)) < 0.9 * near
    t, h = np.flatnonzero(tower), np.flatnonzero(~tower)
    tall = np.clip(near[t] * rng.uniform(0.2, 1.15, len(t)), 0, 0.999)
    shapes = 4
    floors = (tall * (catalogue.tower // shapes)).astype(np.int64)
    kind = catalogue.start("tower") + floors * shapes + rng.integers(shapes, size=len(t))
    fit = np.column_stack([
        (lot[t, 0] - 1.5) / 19 * rng.uniform(0.85, 1, len(t)),
        rng.uniform(0.95, 1.25, len(t)),
        rng.uniform(0.92, 1.08, len(t)),
    ])  # fmt: skip
    xy = np.column_stack([x[t], edge[t] - side[t] * (1 + 8.7 * fit[:, 1])])
    towers = _table(BUILDING, kind, block[t], xy, yaw[t], fit)
    kind = catalogue.start("house") + rng.integers(catalogue.house, size=len(h))
    scale = rng.uniform(0.88, 1.12, (len(h), 3))
    set_back = rng.uniform(10.5, 12.5, len(h))
    xy = np.column_stack([x[h] + rng.uniform(-1.5, 1.5, len(h)), edge[h] - side[h] * set_back])
    homes = _table(BUILDING, kind, block[h], xy, yaw[h], scale)
    behind = np.repeat(h, 2)
    n = len(behind)
    deep = rng.uniform(0.72, 0.95, n) * lot[behind, 1]
    xy = np.column_stack([
        x[behind] + rng.uniform(-0.4, 0.4, n) * lot[behind, 0], edge[behind] - side[behind] * deep
    ])  # fmt: skip
    return [towers, homes, _trees(catalogue, rng, block[behind], xy)]


def _park_trees(blocks: Blocks, catalogue: Catalogue, rng: np.random.Generator) -> Placements:
    parks = np.flatnonzero(blocks.park)
    block = np.repeat(parks, (blocks.size[parks].prod(axis=1) / 50).astype(np.int64))
    room = blocks.size[block] / 2 - _PAVEMENT_M - 2
    xy = blocks.middle[block] + room * rng.uniform(-1, 1, (len(block), 2))
    return _trees(catalogue, rng, block, xy)


def _trees(
    catalogue: Catalogue, rng: np.random.Generator, block: NDArray[np.int64], xy: Float
) -> Placements:
    n = len(block)
    kind = catalogue.start("tree") + rng.integers(catalogue.tree, size=n)
    size = rng.uniform(0.75, 1.3, (n, 1)) * rng.uniform(0.9, 1.1, (n, 3))
    return _table(TREE, kind, block, xy, rng.uniform(0, 2 * np.pi, n), size)


def _along_streets(
    blocks: Blocks,
    catalogue: Catalogue,
    rng: np.random.Generator,
    owner: int,
    inwards: float,
    spacing: float,
    chance: float,
) -> Placements:
    """Rows of one class along all four edges of each block, some places left empty."""
    n = len(blocks)
    block = np.tile(np.arange(n), 4)
    yaw = np.repeat(np.array([-0.5, 0.0, 0.5, 1.0]) * np.pi, n)  # outwards over the edge
    along_x = np.repeat([True, False, True, False], n)
    length = np.where(along_x, blocks.size[block, 0], blocks.size[block, 1]) - 8
    deep = np.where(along_x, blocks.size[block, 1], blocks.size[block, 0]) / 2 - inwards
    count = (length / spacing).astype(np.int64) + 1
    edge = np.repeat(np.arange(4 * n), count)
    step = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
    there = rng.random(len(edge)) < chance
    edge, step = edge[there], step[there]
    shift = (step - (count[edge] - 1) / 2) * spacing
    out = np.column_stack([np.cos(yaw[edge]), np.sin(yaw[edge])])
    left = out[:, ::-1] * [-1, 1]
    xy = blocks.middle[block[edge]] + out * deep[edge, None] + left * shift[:, None]
    n = len(edge)
    if owner == TREE:
        return _trees(catalogue, rng, block[edge], xy)
    if owner == LAMP:
        kind = np.full(n, catalogue.start("lamp"))
        return _table(LAMP, kind, block[edge], xy, yaw[edge], np.ones((n, 3)))
    kind = catalogue.start("car") + rng.integers(catalogue.car, size=n)
    turned = yaw[edge] + np.pi * (rng.integers(2, size=n) - 0.5)
    scale = rng.uniform(0.94, 1.06, (n, 3))
    xy += left * rng.uniform(-0.5, 0.5, (n, 1))
    return _table(CAR, kind, block[edge], xy, turned, scale, z=0.0)
