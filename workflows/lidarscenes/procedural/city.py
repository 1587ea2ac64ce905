"""A generated city of any size: streets, houses, towers, trees, cars, lamps.

Streets run along x and y and two of them cross at (0, 0). Blocks between them are divided into
lots, two rows back to back; lots near the centre have more towers. Everything is made for all
blocks at once, by arrays, so that ten million triangles take a few seconds more than a thousand.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from lidarsim.base.arrays import AnyArray, Floats, Ints
from lidarsim.base.declared import Seed
from lidarsim.base.validation import checked
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance

from . import city_kinds
from .city_furniture import MOST_CARS, parked_cars, street_trees
from .city_kinds import Solid
from .plants import MOST_TREES
from .terrain import grid_faces

# One row for each thing: position and size; `block` is counted from the centre.
_THING = np.dtype({
    "names": ["kind", "owner", "block", "place", "yaw", "scale"],
    "formats": ["i8", "i8", "i8", "3f8", "f8", "3f8"],
})  # fmt: skip

CLASSES = ("pavement", "building", "tree", "car", "lamp")
PAVEMENT, BUILDING, TREE, CAR, LAMP = range(len(CLASSES))

_GROUND_SHARE = 0.03  # of the triangles, at least
_MARGIN_M = 12.0
_STREET_M = 13.0
_AVENUE_M = 24.0
_AVENUE_EVERY = 4
_BLOCK_M = ((60.0, 100.0), (46.0, 62.0))  # along x, along y
# width and height
_PAVEMENT_M = 3.5
_KERB_M = 0.15
_LOT_M = 16.5
_PARKS = 0.09  # share of the blocks


@checked
def city(
    triangles: Annotated[int, Field(ge=1_000, le=100_000_000)] = 100_000,
    seed: Seed = 0,
    trees: Annotated[int, Field(ge=0, le=MOST_TREES)] = 0,
    cars: Annotated[int, Field(ge=0, le=MOST_CARS)] = 0,
) -> Scene:
    """Make a city of a number of triangles: more triangles make it larger, not finer.

    There is a crossing at (0, 0), where a sensor may stand. The ground, at z = 0, is one object,
    the pavement of all blocks another, and so is each building, tree, car and lamp: building-12,
    tree-7, counted from the centre.

    Parameters
    ----------
    triangles
        The scene has at most one in fifty fewer.
    seed
        The same seed and number give the same city.
    trees
        Number of trees with branches and leaves instead of the simple ones: instances of one mesh
        for each of `SPECIES` in plants.py, at streets, in yards and in parks. Ground, buildings
        and lamps stay the same.
    cars
        Number of cars with windows and wheels instead of the simple ones: instances of one mesh for
        each of `lidarscenes.procedural.cars.MODELS`, parked at the kerbs.

    Raises
    ------
    LidarError
        For a number that is out of range, or trees or cars that do not fit.

    Examples
    --------
    >>> scene = city(20_000)
    >>> scene.names[:2], 19_800 <= len(scene.faces) <= 20_000
    (('ground', 'pavement'), True)
    """
    kinds = city_kinds.all_kinds(seed)
    solids = [solid for group in kinds.values() for solid in group]
    sizes = np.array([len(solid.faces) for solid in solids])
    things = _things(kinds, sizes, int((1 - _GROUND_SHARE) * triangles), seed)
    left = triangles - int(sizes[things["kind"]].sum())
    ground = _ground(things, left)
    replaced = [owner for owner, count in ((TREE, trees), (CAR, cars)) if count]
    things = things[~np.isin(things["owner"], replaced)]
    scene = _scene(solids, things, ground)
    if not replaced:
        return scene
    return Scene.from_meshes([*scene.meshes(), *_furniture(scene, things, trees, cars, seed)])


def _furniture(
    scene: Scene, things: AnyArray, trees: int, cars: int, seed: int
) -> list[SceneInstance]:
    """Place trees and cars among things."""
    pavement = things[things["owner"] == PAVEMENT]
    blocks = np.stack([pavement["place"][:, :2], pavement["scale"][:, :2]], axis=1)
    names = CLASSES[BUILDING] + "-"
    built = [number for number, name in enumerate(scene.names) if name.startswith(names)]
    boxes = scene.object_bounds[built][..., :2]
    houses, lamps = (things[things["owner"] == owner] for owner in (BUILDING, LAMP))
    ends = [np.searchsorted(some["block"], pavement["block"][1:]) for some in (houses, lamps)]
    return [
        *street_trees(
            blocks,
            np.split(boxes, ends[0]),
            np.split(lamps["place"][:, :2], ends[1]),
            _KERB_M,
            trees,
            seed,
        ),
        *parked_cars(blocks, cars, seed),
    ]


def _things(kinds: dict[str, list[Solid]], sizes: Ints, budget: int, seed: int) -> AnyArray:
    """Select things from the centre outwards, within the budget of triangles."""
    rings = 1
    while True:
        things = _CityBlocks(kinds, rings, seed).things()
        used = np.cumsum(sizes[things["kind"]])
        if used[-1] >= budget:
            return things[: int(np.searchsorted(used, budget, side="right"))]
        # Triangles grow with the square of the rings; the centre's towers have the most.
        rings = max(rings + 1, int(np.sqrt(budget / used[-1]) * rings))


def _ground(things: AnyArray, triangles: int) -> Solid:
    """Flat ground under everything, of the remaining triangles."""
    blocks = things[things["owner"] == PAVEMENT]
    reach = (np.abs(blocks["place"]) + blocks["scale"] / 2).max(axis=0) + _MARGIN_M
    rows = max(1, int(np.sqrt(triangles / 2)))
    columns = max(1, triangles // (2 * rows))
    x = np.linspace(-reach[0], reach[0], columns + 1)
    y = np.linspace(-reach[1], reach[1], rows + 1)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=-1)
    return Solid(points.reshape(-1, 3), grid_faces(columns, rows).swapaxes(0, 1).reshape(-1, 3))


def _scene(solids: list[Solid], things: AnyArray, ground: Solid) -> Scene:
    """Place copies of the solids."""
    points = np.array([len(solid.vertices) for solid in solids])[things["kind"]]
    sides = np.array([len(solid.faces) for solid in solids])[things["kind"]]
    first_point = len(ground.vertices) + np.cumsum(points) - points
    first_face = len(ground.faces) + np.cumsum(sides) - sides
    vertices = np.empty((len(ground.vertices) + int(points.sum()), 3))
    faces = np.empty((len(ground.faces) + int(sides.sum()), 3), np.int32)
    vertices[: len(ground.vertices)] = ground.vertices
    faces[: len(ground.faces)] = ground.faces
    for number, solid in enumerate(solids):
        rows = np.flatnonzero(things["kind"] == number)
        at = first_point[rows, None] + np.arange(len(solid.vertices))
        vertices[at] = _copies(solid, things[rows])
        at = first_face[rows, None] + np.arange(len(solid.faces))
        faces[at] = solid.faces + first_point[rows, None, None]
    ids = np.cumsum(things["owner"] != PAVEMENT) + 1  # ground is 0, all pavement 1
    ids[things["owner"] == PAVEMENT] = 1
    owner = np.repeat(np.append(0, ids), np.append(len(ground.faces), sides)).astype(np.int32)
    return Scene(vertices, faces, owner, ("ground", "pavement", *_names(things)), np.zeros(3))


def _copies(solid: Solid, things: AnyArray) -> Floats:
    """Vertices of a solid at every place: (things, v, 3)."""
    out = solid.vertices * things["scale"][:, None]
    cos = np.cos(things["yaw"])[:, None]
    sin = np.sin(things["yaw"])[:, None]
    x = out[..., 0].copy()
    y = out[..., 1].copy()
    out[..., 0] = x * cos - y * sin
    out[..., 1] = x * sin + y * cos
    out += things["place"][:, None]
    return out


def _names(things: AnyArray) -> list[str]:
    """Name all but the pavement by class, numbered from 1 from the centre outwards."""
    numbers = dict.fromkeys(CLASSES, 0)
    names = []
    for owner in things["owner"].tolist():
        if owner != PAVEMENT:
            numbers[CLASSES[owner]] += 1
            names.append(f"{CLASSES[owner]}-{numbers[CLASSES[owner]]}")
    return names


class _CityBlocks:
    """Positions of everything on and around ``(2 * rings) ** 2`` blocks.

    Parameters
    ----------
    kinds
        {group: its solids}; kinds are numbered through all groups.
    """

    def __init__(self, kinds: dict[str, list[Solid]], rings: int, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._count = {name: len(group) for name, group in kinds.items()}
        starts = np.cumsum([0, *self._count.values()]).tolist()
        self._start = dict(zip(kinds, starts, strict=False))
        self._lay_blocks(rings)

    def _lay_blocks(self, rings: int) -> None:
        """Lay rectangles between streets, from the centre outwards: middles and sizes (n, 2)."""
        spans = []
        for least, most in _BLOCK_M:
            halves = []
            for side in (1, -1):
                streets = np.full(rings, _STREET_M)
                streets[::_AVENUE_EVERY] = _AVENUE_M
                streets[0] /= 2  # the other half of the central one is on the other side
                width = self._rng.uniform(least, most, rings)
                start = np.cumsum(streets + width) - width
                halves.append((side * (start + width / 2), width))
            spans.append([np.concatenate(parts) for parts in zip(*halves, strict=True)])
        (x, width), (y, depth) = spans
        middle = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        size = np.stack(np.meshgrid(width, depth, indexing="ij"), axis=-1).reshape(-1, 2)
        order = np.argsort(np.hypot(*middle.T), kind="stable")
        park = self._rng.random(len(middle)) < _PARKS
        park[:4] = False  # never at the centre
        self._middle = middle[order]
        self._size = size[order]
        self._park = park

    def things(self) -> AnyArray:
        """All things, block by block, within a block in random order after its pavement."""
        n = len(self._middle)
        slab = np.column_stack([self._size, np.ones(n)])
        whole = np.concatenate([
            self._rows(PAVEMENT, "pavement", 0, np.arange(n), self._middle, 0.0, slab, z=0.0),
            *self._lots(),
            self._park_trees(),
            self._along_streets(TREE, inwards=1.6, spacing=9.0, chance=0.55),
            self._along_streets(CAR, inwards=-1.3, spacing=6.5, chance=0.35),
            self._along_streets(LAMP, inwards=0.6, spacing=26.0, chance=0.95),
        ])  # fmt: skip
        turn = np.where(whole["owner"] == PAVEMENT, -1.0, self._rng.random(len(whole)))
        return whole[np.lexsort((turn, whole["block"]))]

    def _rows(
        self,
        owner: int,
        group: str,
        kind: Ints | int,
        block: Ints,
        xy: Floats,
        yaw: Floats | float,
        scale: Floats | float,
        z: float = _KERB_M,
    ) -> AnyArray:
        """Rows of one class, `kind` being counted within its group."""
        out = np.empty(len(block), _THING)
        out["kind"] = self._start[group] + kind
        out["owner"] = owner
        out["block"] = block
        out["place"][:, :2] = xy
        out["place"][:, 2] = z
        out["yaw"] = yaw
        out["scale"] = scale
        return out

    def _lots(self) -> list[AnyArray]:
        """Towers and houses, and the trees behind the houses."""
        rng = self._rng
        built = np.flatnonzero(~self._park)
        inner = self._size[built] - 2 * _PAVEMENT_M
        across = np.maximum(2, np.round(inner[:, 0] / _LOT_M)).astype(np.int64)
        block = np.repeat(built, 2 * across)
        number = np.arange(len(block)) - np.repeat(np.cumsum(2 * across) - 2 * across, 2 * across)
        column = number // 2
        back = number % 2
        lot = np.repeat(
            np.column_stack([inner[:, 0] / across, inner[:, 1] / 2]), 2 * across, axis=0
        )
        side = 2.0 * back - 1  # -1: its street is to the south
        corner = self._middle[block] - np.repeat(inner, 2 * across, axis=0) / 2
        x = corner[:, 0] + (column + 0.5) * lot[:, 0]
        edge = self._middle[block, 1] + side * lot[:, 1]  # of the pavement
        yaw = np.pi * back.astype(np.float64)
        reach = 60 + 0.3 * np.hypot(*self._middle.T).max()
        near = np.exp(-((np.hypot(*self._middle[block].T) / reach) ** 2))
        tower = rng.random(len(block)) < 0.9 * near
        t = np.flatnonzero(tower)
        h = np.flatnonzero(~tower)
        tall = np.clip(near[t] * rng.uniform(0.2, 1.15, len(t)), 0, 0.999)
        shapes = 4
        floors = (tall * (self._count["tower"] // shapes)).astype(np.int64)
        kind = floors * shapes + rng.integers(shapes, size=len(t))
        fit = np.column_stack([
            (lot[t, 0] - 1.5) / 19 * rng.uniform(0.85, 1, len(t)),
            rng.uniform(0.95, 1.25, len(t)),
            rng.uniform(0.92, 1.08, len(t)),
        ])  # fmt: skip
        xy = np.column_stack([x[t], edge[t] - side[t] * (1 + 8.7 * fit[:, 1])])
        towers = self._rows(BUILDING, "tower", kind, block[t], xy, yaw[t], fit)
        kind = rng.integers(self._count["house"], size=len(h))
        scale = rng.uniform(0.88, 1.12, (len(h), 3))
        set_back = rng.uniform(10.5, 12.5, len(h))
        xy = np.column_stack([x[h] + rng.uniform(-1.5, 1.5, len(h)), edge[h] - side[h] * set_back])
        homes = self._rows(BUILDING, "house", kind, block[h], xy, yaw[h], scale)
        behind = np.repeat(h, 2)
        n = len(behind)
        deep = rng.uniform(0.72, 0.95, n) * lot[behind, 1]
        xy = np.column_stack([
            x[behind] + rng.uniform(-0.4, 0.4, n) * lot[behind, 0],
            edge[behind] - side[behind] * deep,
        ])  # fmt: skip
        return [towers, homes, self._trees(block[behind], xy)]

    def _park_trees(self) -> AnyArray:
        parks = np.flatnonzero(self._park)
        block = np.repeat(parks, (self._size[parks].prod(axis=1) / 50).astype(np.int64))
        room = self._size[block] / 2 - _PAVEMENT_M - 2
        xy = self._middle[block] + room * self._rng.uniform(-1, 1, (len(block), 2))
        return self._trees(block, xy)

    def _trees(self, block: Ints, xy: Floats) -> AnyArray:
        rng = self._rng
        n = len(block)
        kind = rng.integers(self._count["tree"], size=n)
        size = rng.uniform(0.75, 1.3, (n, 1)) * rng.uniform(0.9, 1.1, (n, 3))
        return self._rows(TREE, "tree", kind, block, xy, rng.uniform(0, 2 * np.pi, n), size)

    def _along_streets(
        self, owner: int, *, inwards: float, spacing: float, chance: float
    ) -> AnyArray:
        """Rows of one class along all four edges of each block, with gaps."""
        rng = self._rng
        n = len(self._middle)
        block = np.tile(np.arange(n), 4)
        yaw = np.repeat(np.array([-0.5, 0.0, 0.5, 1.0]) * np.pi, n)  # outwards over the edge
        along_x = np.repeat([True, False, True, False], n)
        width, depth = self._size[block].T
        length = np.where(along_x, width, depth) - 8
        deep = np.where(along_x, depth, width) / 2 - inwards
        count = (length / spacing).astype(np.int64) + 1
        edge = np.repeat(np.arange(4 * n), count)
        step = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
        there = rng.random(len(edge)) < chance
        edge = edge[there]
        step = step[there]
        shift = (step - (count[edge] - 1) / 2) * spacing
        out = np.column_stack([np.cos(yaw[edge]), np.sin(yaw[edge])])
        left = out[:, ::-1] * [-1, 1]
        xy = self._middle[block[edge]] + out * deep[edge, None] + left * shift[:, None]
        n = len(edge)
        if owner == TREE:
            return self._trees(block[edge], xy)
        if owner == LAMP:
            return self._rows(LAMP, "lamp", 0, block[edge], xy, yaw[edge], 1.0)
        kind = rng.integers(self._count["car"], size=n)
        turned = yaw[edge] + np.pi * (rng.integers(2, size=n) - 0.5)
        scale = rng.uniform(0.94, 1.06, (n, 3))
        xy += left * rng.uniform(-0.5, 0.5, (n, 1))
        return self._rows(CAR, "car", kind, block[edge], xy, turned, scale, z=0.0)
