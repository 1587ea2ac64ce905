"""Build each kind of object in a city from closed shapes."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.scene_mesh import stack_meshes
from lidarsim.scene.shapes import revolve


class Solid(NamedTuple):
    """Triangles of an object that stands on z = 0, in local coordinates in meters.

    `vertices` are float64 (v, 3), and `faces` int64 (f, 3), counterclockwise as seen from outside.
    """

    vertices: Floats
    faces: Ints

    def translate(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Solid:
        """Return a copy that is moved by the given distances."""
        return Solid(self.vertices + np.array([x, y, z]), self.faces)


FLOOR_M = 3.3
TOWER_FLOORS = (6, 9, 13, 18, 25)


def all_kinds(seed: int = 0) -> dict[str, list[Solid]]:
    """Return the solid for each kind of object, by group."""
    return {
        "pavement": [box(1, 1, 0.15)],
        "tower": _towers(),
        "house": _houses(),
        "tree": _trees(seed),
        "car": _cars(),
        "lamp": [_lamp()],
    }


def _towers() -> list[Solid]:
    """Return square, stepped, round, and L-shaped office towers that have `TOWER_FLOORS` floors."""
    corner = np.array([[0, 0], [0, 8], [-9, 8], [-9, -8], [9, -8], [9, 0]], dtype=np.float64)
    return [
        tower
        for floors in TOWER_FLOORS
        for tower in (
            _with_plant_room(loft(rectangle(18, 16), _facade_profile(floors)), floors),
            _stepped(floors),
            _with_plant_room(loft(regular_polygon(14, 8.5), _facade_profile(floors)), floors),
            loft(corner, _facade_profile(floors)),
        )
    ]


def _facade_profile(
    floors: int, base: float = 0.0, inset: float = 0.0
) -> list[tuple[float, float]]:
    """Return the profile of a facade with a parapet and with recessed windows on each floor.

    The profile consists of (height, inset) pairs in meters.
    """
    line = [(base, inset)]
    for floor in range(floors):
        z = base + floor * FLOOR_M
        line += [(z + 0.9, inset), (z + 0.9, inset + 0.3)]
        line += [(z + 2.7, inset + 0.3), (z + 2.7, inset)]
    top = base + floors * FLOOR_M
    return [*line, (top + 0.8, inset), (top + 0.8, inset + 0.4), (top, inset + 0.4)]


def _with_plant_room(tower: Solid, floors: int) -> Solid:
    """Add plant rooms and a mast to a tower's roof."""
    top = floors * FLOOR_M
    return join_solids([
        tower,
        box(5, 4, 3).translate(1.5, -1, top),
        box(2, 2, 1.4).translate(-3, 2.5, top),
        loft(regular_polygon(6, 0.12), [(0, 0), (6, 0)]).translate(3, -1, top + 3),
    ])  # fmt: skip


def _stepped(floors: int) -> Solid:
    """Return a tower of three parts, each of which is narrower than the one below."""
    counts = [floors - 2 * (floors // 3), floors // 3, floors // 3]
    parts = []
    base = 0.0
    for step, count in enumerate(counts):
        parts.append(loft(rectangle(18, 16), _facade_profile(count, base, 2.0 * step)))
        base += count * FLOOR_M
    return join_solids([*parts, box(4, 4, 3).translate(0, 0, base)])


def _houses() -> list[Solid]:
    """Return houses that have one to three floors and gabled or hipped roofs.

    Each house exists with and without a wing.
    """
    houses = []
    for stories in (1, 2, 3):
        for hip in (0.0, 3.0):
            body = _dwelling(11, 8.5, stories, hip)
            houses.append(
                join_solids(
                    [body, *_front(stories), box(0.8, 0.8, 2.6).translate(2.6, 1, _eaves(stories))]
                )
            )
            wing = _dwelling(6, 5, max(1, stories - 1), 0.0)
            turned = Solid(wing.vertices[:, [1, 0, 2]] * [-1, 1, 1], wing.faces)
            houses.append(join_solids([body, *_front(stories), turned.translate(2.4, -6, 0)]))
    return houses


def _eaves(stories: int) -> float:
    """Return the eaves height of a house in meters."""
    return 0.4 + 2.8 * stories


def _dwelling(width: float, depth: float, stories: int, hip: float) -> Solid:
    """Return a house's walls and roof.

    `hip` is the inset of both ends of the ridge.
    """
    eaves = _eaves(stories)
    walls = loft(rectangle(width, depth), [(0, -0.15), (0.4, -0.15), (0.4, 0), (eaves, 0)])
    roof = gable(width + 1, depth + 1, eaves - 0.05, 0.42 * depth, hip)
    return join_solids([walls, roof])


def _front(stories: int) -> list[Solid]:
    """Return slightly protruding windows for the long sides, and a door with a step."""
    door = [
        box(1.1, 0.3, 2.1).translate(-1.2, -4.3, 0.3),
        box(1.8, 1.2, 0.3).translate(-1.2, -4.8, 0),
    ]
    window = box(1.3, 0.25, 1.4)
    positions = itertools.product((-4.0, 1.0, 4.0), (-4.25, 4.25), range(stories))
    return [*door, *(window.translate(x, y, 1.3 + 2.8 * story) for x, y, story in positions)]


def _trees(seed: int) -> list[Solid]:
    """Return deciduous trees with several outlines, and conifers."""
    rng = np.random.default_rng(seed)
    return [_broadleaf(rng, height_ratio) for height_ratio in (0.9, 1.1, 1.35, 1.6)] + [
        _conifer(3),
        _conifer(4),
    ]


def _broadleaf(rng: np.random.Generator, height_ratio: float) -> Solid:
    """Return a deciduous tree whose crown has the given ratio of height to width."""
    trunk = loft(regular_polygon(6, 0.22), [(0, -0.1), (0.3, 0), (3, 0.08)])
    angle = np.linspace(-np.pi / 2, np.pi / 2, 8)
    crown = revolve(
        np.stack([2.2 * np.cos(angle), 2.2 * height_ratio * (1 + np.sin(angle))], axis=1), 10
    )
    bumps = 1 + rng.uniform(-0.22, 0.22, (len(crown.vertices), 1))
    middle = np.array([0, 0, 2.2 * height_ratio])
    leaves = Solid((crown.vertices - middle) * bumps + middle, crown.faces)
    return join_solids([trunk, leaves.translate(0, 0, 2)])


def _conifer(tiers: int) -> Solid:
    """Return a conifer with several tiers of branches."""
    parts = [loft(regular_polygon(6, 0.2), [(0, 0), (1.4, 0)])]
    for tier in range(tiers):
        radius = 2.0 - 1.3 * tier / tiers
        base = 1.1 + 1.7 * tier
        parts.append(loft(regular_polygon(9, radius), [(base, 0), (base + 2.6, radius * 0.93)]))
    return join_solids(parts)


def _cars() -> list[Solid]:
    """Return a sedan, a hatchback, and a van."""
    saloon = [(0, 0.3), (2.2, 0.3), (2.25, 0.8), (1.1, 0.95), (0.55, 1.45), (-0.9, 1.45)]
    hatchback = [(0, 0.3), (2.0, 0.3), (2.0, 0.8), (1.0, 1.0), (0.4, 1.5), (-1.6, 1.5)]
    van = [(0, 0.35), (2.4, 0.35), (2.4, 1.0), (1.9, 1.2), (1.5, 2.1), (-2.3, 2.1)]
    tails = [[(-1.6, 0.95), (-2.2, 0.9), (-2.2, 0.3)], [(-1.95, 0.9), (-1.95, 0.3)], [(-2.4, 0.35)]]
    return [
        _car([*nose, *tail]) for nose, tail in zip((saloon, hatchback, van), tails, strict=True)
    ]


def _car(side: list[tuple[float, float]]) -> Solid:
    """Return a car with the given side outline, as (x, z) points in meters."""
    body = lay_down(loft(side, [(-0.85, 0.08), (-0.75, 0), (0.75, 0), (0.85, 0.08)]))
    wheel = lay_down(loft(regular_polygon(8, 0.33), [(-0.12, 0), (0.12, 0)]))
    wheels = [wheel.translate(x, y, 0.31) for x in (-1.35, 1.35) for y in (-0.8, 0.8)]
    return join_solids([body, *wheels])


def _lamp() -> Solid:
    """Return a street lamp with an arm along x."""
    pole = loft(regular_polygon(6, 0.09), [(0, -0.06), (0.5, 0), (6.2, 0.04)])
    return join_solids(
        [
            pole,
            box(1.6, 0.1, 0.1).translate(0.8, 0, 6.1),
            box(0.7, 0.3, 0.15).translate(1.6, 0, 6),
        ]
    )


def join_solids(solids: Iterable[Solid]) -> Solid:
    """Join several solids into one.

    Touching or overlapping parts keep their surfaces.
    """
    return Solid(*stack_meshes(solids))


def loft(outline: ArrayLike, profile: Sequence[tuple[float, float]]) -> Solid:
    """Extrude an outline along z with varying insets, and close both ends.

    `outline` (n, 2) is a counterclockwise polygon that is completely visible from its first point.
    `profile` consists of heights and the insets of the outline at these heights, in meters. The
    solid has ``2 * n * len(profile) - 4`` triangles.
    """
    points = np.asarray(outline, dtype=np.float64)
    n = len(points)
    height, inset = np.asarray(profile, dtype=np.float64).T
    tangent = np.roll(points, -1, axis=0) - points
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    inward = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    previous_inward = np.roll(inward, 1, axis=0)
    # Each corner moves so that both adjacent sides move by the inset.
    miter = (inward + previous_inward) / (1 + (inward * previous_inward).sum(axis=1, keepdims=True))
    rings = np.empty((len(height), n, 3))
    rings[..., :2] = points + inset[:, None, None] * miter
    rings[..., 2] = height[:, None]
    corners = np.arange(len(height) * n).reshape(-1, n)
    next_corners = np.roll(corners, -1, axis=1)
    fan = np.arange(1, n - 1)
    lid = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    faces = [
        np.stack([corners[:-1], next_corners[:-1], next_corners[1:]], axis=-1).reshape(-1, 3),
        np.stack([corners[:-1], next_corners[1:], corners[1:]], axis=-1).reshape(-1, 3),
        lid[:, ::-1],
        lid + corners[-1, 0],
    ]
    return Solid(rings.reshape(-1, 3), np.concatenate(faces))


def rectangle(width: float, depth: float) -> Floats:
    """Return the outline of a rectangle centered at the origin. Shape (4, 2)."""
    return np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, depth / 2]


def regular_polygon(sides: int, radius: float) -> Floats:
    """Return the outline of a regular polygon centered at the origin. Shape (sides, 2)."""
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def box(width: float, depth: float, height: float) -> Solid:
    """Return a box whose bottom face lies at z = 0."""
    return loft(rectangle(width, depth), [(0, 0), (height, 0)])


def gable(width: float, depth: float, eaves: float, rise: float, hip: float = 0.0) -> Solid:
    """Return a pitched roof of eight triangles over a rectangle at the height `eaves`.

    The ridge runs along x, `rise` above the eaves, and is shorter by `hip` at both ends.
    """
    x = width / 2
    y = depth / 2
    ridge = [[hip - x, 0, rise], [x - hip, 0, rise]]
    corners = [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0], *ridge]
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    return Solid(np.array(corners, dtype=np.float64), np.array(faces)).translate(z=eaves)


def lay_down(solid: Solid) -> Solid:
    """Return a solid in which the y and z axes are swapped."""
    return Solid(solid.vertices[:, [0, 2, 1]], solid.faces[:, ::-1])
