"""Scenes and rays for the GPU benchmark, made with NumPy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
Float = NDArray[np.float64]


def grid_faces(rows: int, columns: int, wrap: bool = False) -> NDArray[np.int64]:
    """Return two triangles for each cell in a grid of vertices."""
    i = np.arange(rows - 1)[:, None] * columns
    j = np.arange(columns if wrap else columns - 1)[None, :]
    k = (j + 1) % columns
    quad = np.stack(np.broadcast_arrays(i + j, i + k, i + columns + k, i + columns + j), axis=-1)
    return np.concatenate([quad[..., [0, 1, 2]], quad[..., [0, 2, 3]]]).reshape(-1, 3)


def joined(meshes: list[Mesh]) -> Mesh:
    """Concatenate several meshes."""
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in meshes])
    return (
        np.concatenate([vertices for vertices, _ in meshes]),
        np.concatenate([f + start for (_, f), start in zip(meshes, starts, strict=False)]),
    )


def six_objects() -> Mesh:
    """Make six surfaces of revolution with 80 by 80 vertices, as in the default survey."""
    polar = np.linspace(0, np.pi, 80)[:, None]
    azimuth = np.arange(80) * 2 * np.pi / 80
    radius = 2 * np.sin(polar) * (0.75 + 0.25 * np.cos(3 * polar))
    height = np.broadcast_to(2 - 2 * np.cos(polar), (80, 80))
    vertices = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], -1).reshape(
        -1, 3
    )
    positions = [(-20, -20), (20, -20), (-20, 20), (20, 20), (-10, -5), (5, 5)]
    faces = grid_faces(80, 80, wrap=True)
    return joined([(vertices + np.array([x, y, 0]), faces) for x, y in positions])


def ball(radius_m: float, rows: int = 40, columns: int = 60) -> Mesh:
    """Make a closed sphere around the origin."""
    polar = np.linspace(0, np.pi, rows)[:, None]
    azimuth = np.arange(columns) * 2 * np.pi / columns
    ring = np.sin(polar)
    ring[[0, -1]] = 0
    parts = (ring * np.cos(azimuth), ring * np.sin(azimuth), np.cos(polar))
    points = np.stack(np.broadcast_arrays(*parts), axis=-1).reshape(-1, 3)
    return radius_m * points, grid_faces(rows, columns, wrap=True)


def soup(kind: str) -> Mesh:
    """Make unconnected triangles within 20 m of the origin.

    The kind is random, sliver, huge or tiny.
    """
    rng = np.random.default_rng(0)
    count = 5000 if kind in ("sliver", "tiny") else 300
    first_corner = rng.uniform(-20, 20, (count, 1, 3))
    edges = rng.normal(size=(count, 2, 3))
    if kind == "sliver":
        edges *= 8
        edges[:, 1] = edges[:, 0] * rng.uniform(0.1, 1, (count, 1)) + 1e-2 * edges[:, 1]
    else:
        edges *= {"random": 4.0, "huge": 1e3, "tiny": 0.2}[kind]
    points = np.concatenate([first_corner, first_corner + edges], axis=1).reshape(-1, 3)
    return points, np.arange(3 * count).reshape(-1, 3)


def city(triangles: int, seed: int = 0) -> Mesh:
    """Make streets of box-shaped buildings on flat ground, with about `triangles` triangles."""
    rng = np.random.default_rng(seed)
    panels = 4
    pitch = 20.0
    # Odd: there is a crossing at (pitch / 2, pitch / 2), where sensors stand.
    side = 2 * round((np.sqrt(triangles / (5 * 2 * panels**2 + 2)) - 1) / 2) + 1
    box, faces = panelled_box(panels)
    x, y = (c.ravel() for c in np.meshgrid(np.arange(side), np.arange(side), indexing="ij"))
    count = side * side
    middle = pitch * (np.stack([x, y], axis=-1) - (side - 1) / 2)
    half = rng.uniform(4, 7.5, (count, 2))
    height = rng.gamma(3, 6, count) + 3
    vertices = np.empty((count, len(box), 3))
    vertices[..., :2] = middle[:, None] + box[:, :2] * half[:, None]
    vertices[..., 2] = (box[:, 2] + 1) / 2 * height[:, None]
    buildings = faces + len(box) * np.arange(count)[:, None, None]
    return joined(
        [
            (vertices.reshape(-1, 3), buildings.reshape(-1, 3)),
            flat_ground(side, pitch),
        ]
    )


def panelled_box(panels: int) -> Mesh:
    """Make a box from -1 to 1 without a floor.

    Each face has `panels` x `panels` squares.
    """
    line = np.linspace(-1, 1, panels + 1)
    a, b = (x.ravel() for x in np.meshgrid(line, line, indexing="ij"))
    unit = np.ones_like(a)
    sides = [(a, b, unit), (a, unit, b), (a, -unit, b), (unit, a, b), (-unit, a, b)]
    face = grid_faces(panels + 1, panels + 1)
    return joined([(np.stack(points, axis=-1), face) for points in sides])


def flat_ground(side: int, pitch: float) -> Mesh:
    """Make a square of `side` x `side` cells at z = 0."""
    edge = pitch * (np.arange(side + 1) - side / 2)
    x, y = np.meshgrid(edge, edge, indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    return vertices, grid_faces(side + 1, side + 1)


def tree(leaves: int) -> Mesh:
    """Make a tree crown of triangles around a point 6 m above the ground."""
    rng = np.random.default_rng(1)
    middle = rng.normal(size=(leaves, 1, 3)) * [1.5, 1.5, 2] + [0, 0, 6]
    corners = middle + 0.04 * rng.normal(size=(leaves, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * leaves).reshape(-1, 3)


def tree_transforms(trees: int) -> Float:
    """Make transforms (trees, 3, 4) on a square grid, with random yaw angles and scales."""
    rng = np.random.default_rng(2)
    pitch = 8.0
    side = int(np.ceil(np.sqrt(trees)))
    angle = rng.uniform(0, 2 * np.pi, trees)
    size = rng.uniform(0.8, 1.2, trees)
    number = np.arange(trees)
    transforms = np.zeros((trees, 3, 4))
    transforms[:, 0, 0] = transforms[:, 1, 1] = size * np.cos(angle)
    transforms[:, 1, 0] = size * np.sin(angle)
    transforms[:, 0, 1] = -transforms[:, 1, 0]
    transforms[:, 2, 2] = size
    transforms[:, 0, 3] = pitch * (number % side)
    transforms[:, 1, 3] = pitch * (number // side)
    transforms[:, :2, 3] -= pitch * (side - 1) / 2
    return transforms


def revolution(rays: int, layers: int = 128) -> Float:
    """Return the unit directions of a lidar revolution with a 60 degree field of view."""
    azimuth = 2 * np.pi * np.arange(max(1, rays // layers))[:, None] / max(1, rays // layers)
    elevation = np.radians(np.linspace(-30, 30, layers))
    level = np.cos(elevation)
    parts = (np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation))
    return np.stack(np.broadcast_arrays(*parts), axis=-1).reshape(-1, 3)


def beam_directions(beams: int, rays: int) -> Float:
    """Return unit directions (n, 3) in firing order, for elevations from -15 to 45 degrees."""
    azimuth = np.linspace(0, 2 * np.pi, max(1, rays // beams), endpoint=False)[:, None]
    elevation = np.radians(np.linspace(-15, 45, beams))
    flat = np.cos(elevation)
    x = np.cos(azimuth) * flat
    y = np.sin(azimuth) * flat
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).reshape(-1, 3)


def track(firings: int) -> tuple[Float, Float]:
    """Return positions (k, 3) and rotations (k, 3, 3) of a head that moves 1 m and turns 5 degrees.

    The head is tilted by 2 degrees, so that it does not rotate about a coordinate axis.
    """
    part = np.linspace(-0.5, 0.5, firings)
    yaw = np.radians(5) * part
    tilt = np.radians(2)
    rotations = np.zeros((firings, 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = np.cos(yaw)
    rotations[:, 1, 0] = np.sin(yaw)
    rotations[:, 0, 1] = -rotations[:, 1, 0]
    rotations[:, 2, 2] = 1
    c = np.cos(tilt)
    s = np.sin(tilt)
    positions = np.column_stack([10 + part, 10 + 0.3 * part, np.full(firings, 20.0)])
    return positions, rotations @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
