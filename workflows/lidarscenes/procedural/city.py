"""Generate a city of any size with streets, houses, towers, trees, cars, and street lamps.

Streets run along x and y, and two streets cross at (0, 0). The blocks between streets are divided
into lots in two rows, back to back. Lots near the center have more towers. The objects of all
blocks are created at once with array operations, so ten million triangles take only a few seconds
longer than a thousand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import AnyArray, Floats, Ints
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_instances import SceneInstance
from lidarsim.schema.checks import check_fits, check_number
from lidarsim.schema.declared import Seed

from . import city_kinds
from .city_furniture import MAX_CARS, parked_cars, street_trees
from .city_kinds import Solid
from .plants import MAX_TREES
from .terrain import grid_faces

# A row for each object. Blocks are numbered from the center.
_OBJECT = np.dtype({
    "names": ["kind", "owner", "block", "place", "yaw", "scale"],
    "formats": ["i8", "i8", "i8", "3f8", "f8", "3f8"],
})  # fmt: skip

CLASSES = ("pavement", "building", "tree", "car", "lamp")
PAVEMENT, BUILDING, TREE, CAR, LAMP = range(len(CLASSES))

_GROUND_SHARE = 0.03  # minimum fraction of the triangles that are used for the ground
_MARGIN_M = 12.0
_STREET_M = 13.0
_AVENUE_M = 24.0
_AVENUE_EVERY = 4
_BLOCK_M = ((60.0, 100.0), (46.0, 62.0))  # along x, along y
_PAVEMENT_M = 3.5  # width of the pavement
_CURB_M = 0.15  # height of the pavement
_LOT_M = 16.5
_PARKS = 0.09  # fraction of the blocks that are parks


def city(
    triangles: int = 100_000,
    seed: int = 0,
    trees: int = 0,
    cars: int = 0,
) -> Scene:
    """Return a city that has the given number of triangles.

    More triangles make the city larger, not finer. There is a crossing at (0, 0), where a sensor
    can be placed. The ground at z = 0 is an object, and so is the pavement of all blocks. Each
    building, tree, car, and street lamp is an object with a number counted from the center, such as
    building-12.

    Parameters
    ----------
    triangles
        Number of triangles. The scene has up to 2 % fewer triangles.
    seed
        Seed of the random generator. The same arguments always result in the same city.
    trees
        Number of trees with branches and leaves. They replace the simple trees, and are instances
        of the `SPECIES` in plants.py along streets, in yards, and in parks. The ground, buildings,
        and lamps stay the same.
    cars
        Number of cars with windows and wheels. They replace the simple cars, and are instances of
        `lidarscenes.procedural.cars.MODELS` parked along the curbs.

    Raises
    ------
    LidarError
        If a number is out of range, or if there is not enough space for the trees or cars.

    Examples
    --------
    >>> scene = city(20_000)
    >>> scene.names[:2], 19_800 <= len(scene.faces) <= 20_000
    (('ground', 'pavement'), True)
    """
    check_number("triangles", triangles, whole=True, ge=1_000, le=100_000_000)
    check_fits("seed", seed, Seed)
    check_number("trees", trees, whole=True, ge=0, le=MAX_TREES)
    check_number("cars", cars, whole=True, ge=0, le=MAX_CARS)
    kinds = city_kinds.all_kinds(seed)
    solids = [solid for group in kinds.values() for solid in group]
    sizes = np.array([len(solid.faces) for solid in solids])
    objects = _select_objects(kinds, sizes, int((1 - _GROUND_SHARE) * triangles), seed)
    ground = _ground(objects, triangles - int(sizes[objects["kind"]].sum()))
    replaced = [owner for owner, count in ((TREE, trees), (CAR, cars)) if count]
    objects = objects[~np.isin(objects["owner"], replaced)]
    scene = _scene(solids, objects, ground)
    if not replaced:
        return scene
    return Scene.from_meshes([*scene.meshes(), *_furniture(scene, objects, trees, cars, seed)])


def _furniture(
    scene: Scene, objects: AnyArray, trees: int, cars: int, seed: int
) -> list[SceneInstance]:
    """Return detailed trees and cars that fit between the objects of a scene."""
    pavement = objects[objects["owner"] == PAVEMENT]
    blocks = np.stack([pavement["place"][:, :2], pavement["scale"][:, :2]], axis=1)
    prefix = CLASSES[BUILDING] + "-"
    building_rows = [number for number, name in enumerate(scene.names) if name.startswith(prefix)]
    boxes = scene.object_bounds[building_rows][..., :2]
    buildings = objects[objects["owner"] == BUILDING]
    lamps = objects[objects["owner"] == LAMP]
    boxes_by_block = np.split(boxes, np.searchsorted(buildings["block"], pavement["block"][1:]))
    lamp_starts = np.searchsorted(lamps["block"], pavement["block"][1:])
    lamps_by_block = np.split(lamps["place"][:, :2], lamp_starts)
    return [
        *street_trees(blocks, boxes_by_block, lamps_by_block, _CURB_M, trees, seed),
        *parked_cars(blocks, cars, seed),
    ]


def _select_objects(kinds: dict[str, list[Solid]], sizes: Ints, budget: int, seed: int) -> AnyArray:
    """Return objects from the center outward until the triangle budget is used up."""
    rings = 1
    while True:
        objects = _CityBlocks(kinds, rings, seed).objects()
        used = np.cumsum(sizes[objects["kind"]])
        if used[-1] >= budget:
            return objects[: int(np.searchsorted(used, budget, side="right"))]
        # The number of triangles grows with the square of the number of rings.
        rings = max(rings + 1, int(np.sqrt(budget / used[-1]) * rings))


def _ground(objects: AnyArray, triangles: int) -> Solid:
    """Return flat ground below all objects, with at most `triangles` triangles."""
    blocks = objects[objects["owner"] == PAVEMENT]
    reach = (np.abs(blocks["place"]) + blocks["scale"] / 2).max(axis=0) + _MARGIN_M
    rows = max(1, int(np.sqrt(triangles / 2)))
    columns = max(1, triangles // (2 * rows))
    x = np.linspace(-reach[0], reach[0], columns + 1)
    y = np.linspace(-reach[1], reach[1], rows + 1)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=-1)
    return Solid(points.reshape(-1, 3), grid_faces(columns, rows).swapaxes(0, 1).reshape(-1, 3))


def _scene(solids: list[Solid], objects: AnyArray, ground: Solid) -> Scene:
    """Combine the ground and a copy of the solid for each object into a scene."""
    points = np.array([len(solid.vertices) for solid in solids])[objects["kind"]]
    sides = np.array([len(solid.faces) for solid in solids])[objects["kind"]]
    first_point = len(ground.vertices) + np.cumsum(points) - points
    first_face = len(ground.faces) + np.cumsum(sides) - sides
    vertices = np.empty((len(ground.vertices) + int(points.sum()), 3))
    faces = np.empty((len(ground.faces) + int(sides.sum()), 3), np.int32)
    vertices[: len(ground.vertices)] = ground.vertices
    faces[: len(ground.faces)] = ground.faces
    for number, solid in enumerate(solids):
        rows = np.flatnonzero(objects["kind"] == number)
        vertex_rows = first_point[rows, None] + np.arange(len(solid.vertices))
        vertices[vertex_rows] = _copies(solid, objects[rows])
        face_rows = first_face[rows, None] + np.arange(len(solid.faces))
        faces[face_rows] = solid.faces + first_point[rows, None, None]
    ids = np.cumsum(objects["owner"] != PAVEMENT) + 1  # ground is 0, all pavement 1
    ids[objects["owner"] == PAVEMENT] = 1
    owner = np.repeat(np.append(0, ids), np.append(len(ground.faces), sides)).astype(np.int32)
    return Scene(vertices, faces, owner, ("ground", "pavement", *_names(objects)), np.zeros(3))


def _copies(solid: Solid, objects: AnyArray) -> Floats:
    """Return the vertices of each copy of a solid, in meters. Shape (objects, v, 3)."""
    vertices = solid.vertices * objects["scale"][:, None]
    cos = np.cos(objects["yaw"])[:, None]
    sin = np.sin(objects["yaw"])[:, None]
    x = vertices[..., 0].copy()
    y = vertices[..., 1].copy()
    vertices[..., 0] = x * cos - y * sin
    vertices[..., 1] = x * sin + y * cos
    vertices += objects["place"][:, None]
    return vertices


def _names(objects: AnyArray) -> list[str]:
    """Name all objects except pavements, numbered from the center outward."""
    numbers = dict.fromkeys(CLASSES, 0)
    names = []
    for owner in objects["owner"].tolist():
        if owner != PAVEMENT:
            numbers[CLASSES[owner]] += 1
            names.append(f"{CLASSES[owner]}-{numbers[CLASSES[owner]]}")
    return names


class _Lots(NamedTuple):
    """Lots in blocks without a park. They lie back to back in two rows along x."""

    block: Ints  # (n,) number of the block
    size: Floats  # (n, 2) meters
    side: Floats  # (n,) -1 if the street is to the south, 1 if it is to the north
    x: Floats  # (n,) x of the center in meters
    edge: Floats  # (n,) y of the edge at the pavement
    yaw: Floats  # (n,) yaw of buildings
    centrality: Floats  # (n,) 1 at the center of the city, falling to 0


class _StreetPositions(NamedTuple):
    """Positions along the edges of blocks."""

    block: Ints  # (n,) number of the block
    xy: Floats  # (n, 2) meters
    yaw: Floats  # (n,) direction from the block to the street
    along_edge: Floats  # (n, 2) unit vectors along the edge, to the left of that direction


class _CityBlocks:
    """Positions of all objects on and around ``(2 * rings) ** 2`` blocks.

    Parameters
    ----------
    kinds
        Solids by group. They are numbered consecutively over all groups.
    rings
        Number of rings of blocks around the center.
    seed
        Seed of the random generator.
    """

    def __init__(self, kinds: dict[str, list[Solid]], rings: int, seed: int) -> None:
        self._rng = np.random.default_rng(seed)
        self._count = {name: len(group) for name, group in kinds.items()}
        starts = np.cumsum([0, *self._count.values()]).tolist()
        self._start = dict(zip(kinds, starts, strict=False))
        self._lay_blocks(rings)

    def _lay_blocks(self, rings: int) -> None:
        """Set the centers and sizes of the blocks, from the center outward."""
        spans = []
        for min_m, max_m in _BLOCK_M:
            halves = []
            for side in (1, -1):
                streets = np.full(rings, _STREET_M)
                streets[::_AVENUE_EVERY] = _AVENUE_M
                streets[0] /= 2  # half of the central street is on each side
                width = self._rng.uniform(min_m, max_m, rings)
                start = np.cumsum(streets + width) - width
                halves.append((side * (start + width / 2), width))
            spans.append([np.concatenate(parts) for parts in zip(*halves, strict=True)])
        (x, width), (y, depth) = spans
        middle = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        size = np.stack(np.meshgrid(width, depth, indexing="ij"), axis=-1).reshape(-1, 2)
        order = np.argsort(np.hypot(*middle.T), kind="stable")
        park = self._rng.random(len(middle)) < _PARKS
        park[:4] = False  # never at the center
        self._middle = middle[order]
        self._size = size[order]
        self._park = park

    def objects(self) -> AnyArray:
        """Return the objects of each block in random order, except that pavements come first."""
        n = len(self._middle)
        slab = np.column_stack([self._size, np.ones(n)])
        objects = np.concatenate(
            [
                self._rows(
                    PAVEMENT,
                    "pavement",
                    kind=0,
                    block=np.arange(n),
                    xy=self._middle,
                    yaw=0.0,
                    scale=slab,
                    z=0.0,
                ),
                *self._lots(),
                self._park_trees(),
                self._along_streets(TREE, inward=1.6, spacing=9.0, chance=0.55),
                self._along_streets(CAR, inward=-1.3, spacing=6.5, chance=0.35),
                self._along_streets(LAMP, inward=0.6, spacing=26.0, chance=0.95),
            ]
        )
        order = np.where(objects["owner"] == PAVEMENT, -1.0, self._rng.random(len(objects)))
        return objects[np.lexsort((order, objects["block"]))]

    def _rows(
        self,
        owner: int,
        group: str,
        kind: Ints | int,
        block: Ints,
        xy: Floats,
        yaw: Floats | float,
        scale: Floats | float,
        *,
        z: float = _CURB_M,
    ) -> AnyArray:
        """Return table rows for objects that belong to the same class.

        `kind` is the number of the solid within its group.
        """
        rows = np.empty(len(block), _OBJECT)
        rows["kind"] = self._start[group] + kind
        rows["owner"] = owner
        rows["block"] = block
        rows["place"][:, :2] = xy
        rows["place"][:, 2] = z
        rows["yaw"] = yaw
        rows["scale"] = scale
        return rows

    def _lots(self) -> list[AnyArray]:
        """Return towers, houses, and the trees behind houses."""
        lots = self._divide_blocks()
        tower = self._rng.random(len(lots.block)) < 0.9 * lots.centrality
        towers = self._towers(lots, np.flatnonzero(tower))
        house_lots = np.flatnonzero(~tower)
        houses = self._houses(lots, house_lots)
        return [towers, houses, self._yard_trees(lots, np.repeat(house_lots, 2))]

    def _divide_blocks(self) -> _Lots:
        """Divide the blocks that have no park into lots."""
        built = np.flatnonzero(~self._park)
        inner = self._size[built] - 2 * _PAVEMENT_M
        across = np.maximum(2, np.round(inner[:, 0] / _LOT_M)).astype(np.int64)
        block = np.repeat(built, 2 * across)
        number = np.arange(len(block)) - np.repeat(np.cumsum(2 * across) - 2 * across, 2 * across)
        column = number // 2
        back = number % 2
        size = np.repeat(
            np.column_stack([inner[:, 0] / across, inner[:, 1] / 2]), 2 * across, axis=0
        )
        side = 2 * back.astype(np.float64) - 1
        corner = self._middle[block] - np.repeat(inner, 2 * across, axis=0) / 2
        reach = 60 + 0.3 * np.hypot(*self._middle.T).max()
        return _Lots(
            block=block,
            size=size,
            side=side,
            x=corner[:, 0] + (column + 0.5) * size[:, 0],
            edge=self._middle[block, 1] + side * size[:, 1],
            yaw=np.pi * back.astype(np.float64),
            centrality=np.exp(-((np.hypot(*self._middle[block].T) / reach) ** 2)),
        )

    def _towers(self, lots: _Lots, lot_indices: Ints) -> AnyArray:
        """Return towers that stand on the lots with the given indices."""
        rng = self._rng
        n = len(lot_indices)
        height = np.clip(lots.centrality[lot_indices] * rng.uniform(0.2, 1.15, n), 0, 0.999)
        shapes = 4
        floors = (height * (self._count["tower"] // shapes)).astype(np.int64)
        kind = floors * shapes + rng.integers(shapes, size=n)
        scale = np.column_stack(
            [
                (lots.size[lot_indices, 0] - 1.5) / 19 * rng.uniform(0.85, 1, n),
                rng.uniform(0.95, 1.25, n),
                rng.uniform(0.92, 1.08, n),
            ]
        )
        y = lots.edge[lot_indices] - lots.side[lot_indices] * (1 + 8.7 * scale[:, 1])
        xy = np.column_stack([lots.x[lot_indices], y])
        return self._rows(
            BUILDING,
            "tower",
            kind=kind,
            block=lots.block[lot_indices],
            xy=xy,
            yaw=lots.yaw[lot_indices],
            scale=scale,
        )

    def _houses(self, lots: _Lots, lot_indices: Ints) -> AnyArray:
        """Return houses that stand on the lots with the given indices."""
        rng = self._rng
        n = len(lot_indices)
        kind = rng.integers(self._count["house"], size=n)
        scale = rng.uniform(0.88, 1.12, (n, 3))
        set_back = rng.uniform(10.5, 12.5, n)
        x = lots.x[lot_indices] + rng.uniform(-1.5, 1.5, n)
        xy = np.column_stack([x, lots.edge[lot_indices] - lots.side[lot_indices] * set_back])
        return self._rows(
            BUILDING,
            "house",
            kind=kind,
            block=lots.block[lot_indices],
            xy=xy,
            yaw=lots.yaw[lot_indices],
            scale=scale,
        )

    def _yard_trees(self, lots: _Lots, lot_indices: Ints) -> AnyArray:
        """Return trees behind the houses on the lots with the given indices."""
        rng = self._rng
        n = len(lot_indices)
        depth = rng.uniform(0.72, 0.95, n) * lots.size[lot_indices, 1]
        xy = np.column_stack(
            [
                lots.x[lot_indices] + rng.uniform(-0.4, 0.4, n) * lots.size[lot_indices, 0],
                lots.edge[lot_indices] - lots.side[lot_indices] * depth,
            ]
        )
        return self._trees(lots.block[lot_indices], xy)

    def _park_trees(self) -> AnyArray:
        """Return trees that stand in parks."""
        parks = np.flatnonzero(self._park)
        block = np.repeat(parks, (self._size[parks].prod(axis=1) / 50).astype(np.int64))
        room = self._size[block] / 2 - _PAVEMENT_M - 2
        xy = self._middle[block] + room * self._rng.uniform(-1, 1, (len(block), 2))
        return self._trees(block, xy)

    def _trees(self, block: Ints, xy: Floats) -> AnyArray:
        """Return trees at the given positions in blocks."""
        rng = self._rng
        n = len(block)
        kind = rng.integers(self._count["tree"], size=n)
        size = rng.uniform(0.75, 1.3, (n, 1)) * rng.uniform(0.9, 1.1, (n, 3))
        return self._rows(
            TREE,
            "tree",
            kind=kind,
            block=block,
            xy=xy,
            yaw=rng.uniform(0, 2 * np.pi, n),
            scale=size,
        )

    def _along_streets(
        self, owner: int, *, inward: float, spacing: float, chance: float
    ) -> AnyArray:
        """Return objects of one class along all four edges of each block, with gaps."""
        rng = self._rng
        positions = self._street_positions(inward, spacing, chance)
        block = positions.block
        xy = positions.xy
        if owner == TREE:
            return self._trees(block, xy)
        if owner == LAMP:
            return self._rows(
                LAMP, "lamp", kind=0, block=block, xy=xy, yaw=positions.yaw, scale=1.0
            )
        n = len(block)
        kind = rng.integers(self._count["car"], size=n)
        yaw = positions.yaw + np.pi * (rng.integers(2, size=n) - 0.5)
        scale = rng.uniform(0.94, 1.06, (n, 3))
        xy = xy + positions.along_edge * rng.uniform(-0.5, 0.5, (n, 1))
        return self._rows(CAR, "car", kind=kind, block=block, xy=xy, yaw=yaw, scale=scale, z=0.0)

    def _street_positions(self, inward: float, spacing: float, chance: float) -> _StreetPositions:
        """Return random positions along all four edges of each block."""
        n = len(self._middle)
        block = np.tile(np.arange(n), 4)
        yaw = np.repeat(np.array([-0.5, 0.0, 0.5, 1.0]) * np.pi, n)  # from the block to the street
        along_x = np.repeat([True, False, True, False], n)
        size = self._size[block]
        length = np.where(along_x, size[:, 0], size[:, 1]) - 8
        distance = np.where(along_x, size[:, 1], size[:, 0]) / 2 - inward
        count = (length / spacing).astype(np.int64) + 1
        edge = np.repeat(np.arange(4 * n), count)
        step = np.arange(len(edge)) - np.repeat(np.cumsum(count) - count, count)
        used = self._rng.random(len(edge)) < chance
        edge = edge[used]
        step = step[used]
        shift = (step - (count[edge] - 1) / 2) * spacing
        outward = np.column_stack([np.cos(yaw[edge]), np.sin(yaw[edge])])
        along_edge = outward[:, ::-1] * [-1, 1]
        xy = self._middle[block[edge]] + outward * distance[edge, None]
        xy += along_edge * shift[:, None]
        return _StreetPositions(block[edge], xy, yaw[edge], along_edge)
