"""Convert SDFormat primitives, polylines, height maps, and roads to meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.io.allowance import Allowance
from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.vectors import matmul, norm
from lidarsim.scene.files.polygons import triangulate_with_holes
from lidarsim.scene.masks import read_heights
from lidarsim.scene.scene_mesh import SceneMesh, stack_meshes
from lidarsim.scene.shapes import capsule, revolve

from ..files.unit_shapes import SIDES, UNIT_BALL, UNIT_BOX, UNIT_CYLINDER
from .frames import child_numbers, parse_numbers

_PIXEL_BYTES = 72  # memory per pixel of a height map, for a vertex and two triangles
_PARALLEL = 1e-12  # unit vectors are parallel if 1 minus their cosine is smaller


def shape_mesh(shape: Element) -> SceneMesh | None:
    """Return a primitive shape as a mesh in its own frame, or None if its size is zero.

    Raises
    ------
    LidarError
        If values are missing or invalid.
    KeyError
        If the shape is unknown.
    """
    return _SHAPES[shape.tag](shape)


def _sizes(shape: Element, name: str, count: int, default: str = "") -> Floats:
    """Read `count` sizes of a shape, which must not be negative."""
    return child_numbers(shape, name, count, default, at_least=0.0)


def _scaled(mesh: SceneMesh, factors: Sequence[float] | Floats) -> SceneMesh | None:
    """Return a mesh that is scaled along the axes, or None if a factor is zero."""
    scale = np.asarray(factors, np.float64)
    return mesh.affine_transform(mesh.name, np.diag(scale), np.zeros(3)) if scale.all() else None


def _box(shape: Element) -> SceneMesh | None:
    return _scaled(UNIT_BOX, _sizes(shape, "size", 3, "1 1 1"))


def _sphere(shape: Element) -> SceneMesh | None:
    return _scaled(UNIT_BALL, np.full(3, _sizes(shape, "radius", 1, "1").item()))


def _ellipsoid(shape: Element) -> SceneMesh | None:
    return _scaled(UNIT_BALL, _sizes(shape, "radii", 3, "1 1 1"))


def _cylinder(shape: Element) -> SceneMesh | None:
    radius = _sizes(shape, "radius", 1, "1").item()
    return _scaled(UNIT_CYLINDER, [radius, radius, _sizes(shape, "length", 1, "1").item()])


def _cone(shape: Element) -> SceneMesh | None:
    radius = _sizes(shape, "radius", 1, "0.5").item()
    cone = revolve([(0, -0.5), (1, -0.5), (0, 0.5)], SIDES, "cone")
    return _scaled(cone, [radius, radius, _sizes(shape, "length", 1, "1").item()])


def _capsule(shape: Element) -> SceneMesh | None:
    radius = _sizes(shape, "radius", 1, "0.5").item()
    height = _sizes(shape, "length", 1, "1").item()
    return capsule(radius, height, SIDES, "capsule") if radius else None


def _plane(shape: Element) -> SceneMesh | None:
    """Return a rectangle that is perpendicular to the given normal."""
    normal = child_numbers(shape, "normal", 3, "0 0 1")
    size = norm(normal)
    if not size > 0:
        raise LidarError("<normal> of a <plane> has zero length.")
    x, y = (_sizes(shape, "size", 2, "1 1") / 2).tolist()
    if not x or not y:
        return None
    corners = np.array([[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]])
    rotation = _from_z(normal / size)
    return SceneMesh("plane", matmul(corners, rotation.T), np.array([[0, 1, 2], [0, 2, 3]]))


def _from_z(normal: Floats) -> Floats:
    """Return the shortest rotation that moves the z axis to a unit vector."""
    x, y, z = normal.tolist()
    if 1 + z < _PARALLEL:  # rotate by 180 degrees about x
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])
    return np.asarray(np.eye(3) + cross + matmul(cross, cross) / (1 + z))


def _no_shape(shape: Element) -> SceneMesh | None:
    return None


_SHAPES: dict[str, Callable[[Element], SceneMesh | None]] = {
    "box": _box,
    "capsule": _capsule,
    "cone": _cone,
    "cylinder": _cylinder,
    "ellipsoid": _ellipsoid,
    "empty": _no_shape,
    "plane": _plane,
    "sphere": _sphere,
}


def polyline_mesh(polylines: Sequence[Element]) -> SceneMesh | None:
    """Extrude outlines along z by the height of the first one. Return None for an empty shape.

    Outlines inside another outline are holes.
    """
    rings = [_ring(polyline) for polyline in polylines]
    rings = [ring for ring in rings if len(ring) > 2]
    height = _sizes(polylines[0], "height", 1, "1").item()
    if not rings or not height:
        return None
    parts = []
    for outline, holes in _grouped(rings):
        members = [outline, *holes]
        starts = np.cumsum([0, *map(len, members)])
        flat = np.concatenate([np.pad(ring, ((0, 0), (0, 1))) for ring in members])
        rows = [np.arange(a, b) for a, b in pairwise(starts.tolist())]
        bottom = triangulate_with_holes(flat, rows)[:, ::-1]  # outlines are counterclockwise
        top = bottom[:, ::-1] + len(flat)
        walls = [_wall(ring, len(flat)) for ring in rows]
        vertices = np.concatenate([flat, flat + np.array([0, 0, height])])
        parts.append((vertices, np.concatenate([bottom, top, *walls])))
    vertices, faces = stack_meshes(parts)
    return SceneMesh("polyline", vertices, faces) if len(faces) else None


def _ring(polyline: Element) -> Floats:
    """Return the points of a polyline without repeated points."""
    texts = [point.text or "" for point in polyline.findall("point")]
    points = np.array([parse_numbers(text, "<point>", 2) for text in texts]).reshape(-1, 2)
    follows = np.ones(len(points), np.bool_)
    follows[1:] = (points[1:] != points[:-1]).any(axis=1)
    points = points[follows]
    return points[:-1] if len(points) > 1 and (points[0] == points[-1]).all() else points


def _area(ring: Floats) -> float:
    """Return a ring's signed area, which is positive if the ring is counterclockwise."""
    x, y = (ring - ring[0]).T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def _grouped(rings: Sequence[Floats]) -> list[tuple[Floats, list[Floats]]]:
    """Return counterclockwise outlines with their clockwise holes, the largest outline first."""
    by_size = sorted(rings, key=lambda ring: -abs(_area(ring)))
    groups: list[tuple[Floats, list[Floats]]] = []
    for ring in by_size:
        upright = ring if _area(ring) > 0 else ring[::-1]
        holes = next((holes for outline, holes in groups if _contains(outline, ring[0])), None)
        if holes is None:
            groups.append((upright, []))
        else:
            holes.append(upright[::-1])
    return groups


def _contains(ring: Floats, point: Floats) -> bool:
    """Return whether a point is inside a ring."""
    a = ring - point
    b = np.roll(a, -1, axis=0)
    crosses = (a[:, 1] > 0) != (b[:, 1] > 0)
    side = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    return bool((crosses & ((side > 0) == (b[:, 1] > a[:, 1]))).sum() % 2)


def _wall(ring: Ints, above: int) -> Ints:
    """Return the faces that connect two rings of vertices.

    `ring` (n,) contains the vertices of the first ring. The vertices of the second ring have the
    same order and are `above` larger.
    """
    following = np.roll(ring, -1)
    lower = np.stack([ring, following, following + above], axis=1)
    upper = np.stack([ring, following + above, ring + above], axis=1)
    return np.concatenate([lower, upper])


def height_map_mesh(shape: Element, image: Path, allowance: Allowance) -> SceneMesh:
    """Return the surface of a height map as a mesh.

    The brightest pixel has the full height, and the first row of the image has the largest y.

    Raises
    ------
    LidarError
        If values are invalid, or the map has too many pixels.
    lidarsim.scene.masks.MaskError
        If the image cannot be read.
    """
    size = _sizes(shape, "size", 3, "1 1 1")
    offset = child_numbers(shape, "pos", 3, "0 0 0")
    values = read_heights(image, allowance, _PIXEL_BYTES)
    rows, columns = values.shape
    if min(rows, columns) < 2 or not size[:2].all():
        raise LidarError("a <heightmap> has no area.")
    fractions = values / max(float(values.max()), 1e-9)
    x = np.linspace(-size[0] / 2, size[0] / 2, columns)
    y = np.linspace(size[1] / 2, -size[1] / 2, rows)
    grid = np.stack([*np.meshgrid(x, y), fractions * size[2]], axis=-1).reshape(-1, 3)
    numbers = np.arange(rows * columns).reshape(rows, columns)
    upper_left = numbers[:-1, :-1].ravel()
    lower_left = numbers[1:, :-1].ravel()
    faces = np.concatenate(
        [
            np.stack([lower_left, lower_left + 1, upper_left], axis=1),
            np.stack([lower_left + 1, upper_left + 1, upper_left], axis=1),
        ]
    )
    return SceneMesh("heightmap", grid + offset, faces)


def road_mesh(road: Element) -> SceneMesh | None:
    """Return a strip that follows the points of a road and has the road's width.

    Returns None if the road has fewer than two distinct points.
    """
    width = _sizes(road, "width", 1, "1").item()
    texts = [point.text or "" for point in road.findall("point")]
    points = np.array([parse_numbers(text, "<point>", 3) for text in texts]).reshape(-1, 3)
    follows = np.ones(len(points), np.bool_)
    follows[1:] = (points[1:, :2] != points[:-1, :2]).any(axis=1)
    points = points[follows]
    if len(points) < 2 or not width:
        return None
    steps = np.gradient(points[:, :2], axis=0)
    lengths = norm(steps)[:, None]
    directions = np.where(lengths > 0, steps / np.where(lengths > 0, lengths, 1), [1.0, 0.0])
    across = np.column_stack([-directions[:, 1], directions[:, 0], np.zeros(len(points))])
    across *= width / 2
    left_rim = np.arange(len(points))
    right_rim = left_rim + len(points)
    faces = np.concatenate(
        [
            np.stack([right_rim[:-1], right_rim[1:], left_rim[:-1]], axis=1),
            np.stack([right_rim[1:], left_rim[1:], left_rim[:-1]], axis=1),
        ]
    )
    return SceneMesh("road", np.concatenate([points + across, points - across]), faces)
