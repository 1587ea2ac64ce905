"""Build boxes, cylinders, prisms, and painted strips for objects and signals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.numerics.elementary import sin_cos
from lidarsim.numerics.vectors import matmul, matvec, norm
from lidarsim.scene.files.polygons import triangulate_with_holes
from lidarsim.scene.files.scene_graph import Piece

MAX_SEGMENTS = 64
MIN_SEGMENTS = 8
MIN_SIZE_M = 0.01  # minimum size of a box, used if its length or width is zero
# Triangles of a box whose corners are numbered 4 * upper + 2 * left + front.
_BOX = np.array([
    [0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4],
    [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5],
])  # fmt: skip
FRONT_FACES = slice(10, 12)  # triangles of a box that face along x
_CORNERS = np.array([[x, y, z] for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])


def rotation_matrix(heading: float, pitch: float = 0.0, roll: float = 0.0) -> Floats:
    """Return a rotation about x by the roll, then y by the pitch, and then z by the heading.

    Angles are in radians.
    """
    (sh, sp, sr), (ch, cp, cr) = (
        values.tolist() for values in sin_cos(np.array([heading, pitch, roll]))
    )
    about_z = [[ch, -sh, 0.0], [sh, ch, 0.0], [0.0, 0.0, 1.0]]
    about_y = [[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]]
    about_x = [[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]]
    return matmul(matmul(about_z, about_y), about_x)


def transform_points(points: Floats, origin: Floats, turn: Floats) -> Floats:
    """Rotate points by a matrix, and then move them by an origin."""
    return np.asarray(matvec(turn, points) + origin)


def box(size: ArrayLike, origin: Floats, turn: Floats, material: str) -> Piece:
    """Return a rotated box whose bottom face is centered at `origin`."""
    size = np.maximum(size, MIN_SIZE_M)
    return Piece(transform_points(_CORNERS * size, origin, turn), _BOX, material=material)


def cylinder(
    radius: float, height: float, origin: Floats, turn: Floats, material: str, sag_m: float
) -> Piece:
    """Return a cylinder whose base is centered at `origin`.

    `sag_m` is the maximum distance between its circle and the polygon.
    """
    sag_fraction = min(0.5, sag_m / radius)
    count = int(np.clip(np.ceil(np.pi / np.sqrt(2 * sag_fraction)), MIN_SEGMENTS, MAX_SEGMENTS))
    sines, cosines = sin_cos(2 * np.pi * np.arange(count) / count)
    ring = np.stack([radius * cosines, radius * sines, np.zeros(count)], axis=1)
    up = np.array([0, 0, height])
    points = transform_points(np.concatenate([ring, ring + up]), origin, turn)
    lower = np.arange(count)
    following = (lower + 1) % count
    walls = _walls(lower, following, count)
    fan = np.stack([np.zeros(count - 2, np.int64), lower[1:-1], following[1:-1]], axis=1)
    faces = np.concatenate([walls, fan + count, fan[:, ::-1]])
    return Piece(points, faces, material=material)


def prism(rings: Sequence[Floats], heights: Sequence[Floats], closed: bool, material: str) -> Piece:
    """Return walls along outlines, and a roof over them.

    The first outline is the outside, and the others are holes.

    Parameters
    ----------
    rings
        (n, 3) bottom corners of each outline in meters.
    heights
        (n,) heights of the walls at these corners in meters.
    closed
        Whether the outline is a closed ring with a roof. Otherwise, there are only walls.
    material
        Name of the material.
    """
    bottom = np.concatenate(list(rings))
    height = np.concatenate(list(heights))
    count = len(bottom)
    points = np.concatenate([bottom, bottom + height[:, None] * [0, 0, 1]])
    offset = 0
    faces = []
    top_rings = []
    for ring in rings:
        numbers = offset + np.arange(len(ring))
        top_rings.append(numbers + count)
        following = np.roll(numbers, -1)
        if not closed:
            numbers = numbers[:-1]
            following = following[:-1]
        if height.any():
            faces.append(_walls(numbers, following, count))
        offset += len(ring)
    if closed:
        top_rings = [row for row in top_rings if len(row) > 2]
        faces += [triangulate_with_holes(points, top_rings)] if top_rings else []
    triangles = np.concatenate(faces) if faces else np.zeros((0, 3), np.int64)
    return Piece(points, triangles, material=material)


def extrude_sections(sections: Floats, material: str, *, capped: bool = True) -> Piece:
    """Return the surface that connects cross sections, each of which is a ring of corners.

    The cross sections have shape (k, c, 3). The ends are closed if `capped` is set.
    """
    count, corners, _ = sections.shape
    numbers = np.arange(count * corners).reshape(count, corners)
    following = np.roll(numbers, -1, axis=1)
    a = numbers[:-1]
    b = following[:-1]
    c = following[1:]
    d = numbers[1:]
    sides = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    if not capped:
        return Piece(sections.reshape(-1, 3), sides, material=material)
    fan = np.stack(
        [np.zeros(corners - 2, np.int64), np.arange(1, corners - 1), np.arange(2, corners)], axis=1
    )
    faces = np.concatenate([sides, fan[:, ::-1], fan + numbers[-1, 0]])
    return Piece(sections.reshape(-1, 3), faces, material=material)


def merge_pieces(pieces: Sequence[Piece]) -> Piece:
    """Merge pieces with the same material."""
    counts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)]).tolist()
    return Piece(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([piece.faces + k for piece, k in zip(pieces, counts, strict=False)]),
        material=pieces[0].material,
    )


def painted_strips(starts: Floats, stops: Floats, width: float, material: str) -> Piece:
    """Return level strips of the given width around the lines from `starts` to `stops`."""
    along = stops - starts
    size = np.maximum(norm(along), 1e-9)[:, None]
    left = np.stack([-along[:, 1], along[:, 0], np.zeros(len(along))], axis=1) / size * (width / 2)
    points = np.concatenate([starts - left, stops - left, stops + left, starts + left])
    strip_indices = np.arange(len(starts))
    a, b, c, d = (strip_indices + k * len(starts) for k in range(4))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Piece(points, faces, material=material)


def zebra_stripes(ring: Floats, stripe_m: float, material: str) -> Piece:
    """Divide a convex outline into stripes across its longest side. Return every other one."""
    following = np.roll(ring, -1, axis=0)
    sides = following - ring
    longest = int(norm(sides).argmax())
    direction = sides[longest] / max(float(norm(sides)[longest]), 1e-9)
    along = ((ring - ring[longest]) * direction).sum(axis=1)
    points: list[Floats] = []
    faces: list[Ints] = []
    offset = 0
    first = float(along.min())
    count = min(int((float(along.max()) - first) / stripe_m), 1000)
    for k in range(0, count, 2):
        stripe = _clipped(ring, along, first + k * stripe_m, first + (k + 1) * stripe_m)
        if len(stripe) > 2:
            fan = np.arange(1, len(stripe) - 1)
            faces.append(offset + np.stack([np.zeros_like(fan), fan, fan + 1], axis=1))
            points.append(stripe)
            offset += len(stripe)
    if not points:
        return Piece(ring, np.zeros((0, 3), np.int64), material=material)
    return Piece(np.concatenate(points), np.concatenate(faces), material=material)


def _clipped(ring: Floats, along: Floats, lower: float, upper: float) -> Floats:
    """Return the part of a convex outline that lies between two positions along a direction."""
    corners = ring
    positions = along
    for sign, bound in ((1, lower), (-1, upper)):
        clipped = []
        kept_positions = []
        for k in range(len(corners)):
            here = sign * (positions[k] - bound)
            ahead = sign * (positions[(k + 1) % len(corners)] - bound)
            if here >= 0:
                clipped.append(corners[k])
                kept_positions.append(positions[k])
            if (here >= 0) != (ahead >= 0):
                fraction = here / (here - ahead)
                step = corners[(k + 1) % len(corners)] - corners[k]
                clipped.append(corners[k] + fraction * step)
                kept_positions.append(bound)
        corners = np.array(clipped).reshape(-1, 3)
        positions = np.array(kept_positions)
    return np.asarray(corners)


def _walls(numbers: Ints, following: Ints, upper: int) -> Ints:
    """Return triangles of walls that connect consecutive corners to the corners above them."""
    return np.concatenate(
        [
            np.stack([numbers, following, following + upper], axis=1),
            np.stack([numbers, following + upper, numbers + upper], axis=1),
        ]
    )
