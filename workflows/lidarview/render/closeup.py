"""Choose the part of a scene to show.

The part surrounds trajectories and ends below a roof.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarsim.numerics.arrays import Floats, Ints
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import triangle_areas
from raybeam import RayCaster

from .surface import golden_spiral

# The margin around a trajectory is the largest of a fraction of its length, a multiple of its
# height above the lowest point of the scene, and a minimum in meters.
_MARGIN_SHARE = 0.35
_MARGIN_HEIGHTS = 2.0
_MIN_MARGIN_M = 25.0
_MAX_SHARE = 0.5  # the whole scene is shown if the box covers a larger fraction of its area

_MIN_ROOF_SHARE = 0.7  # minimum fraction of steep upward rays that hit the scene below a roof
_STEEP_DEG = 60.0
_RAYS = 64
_MAX_SPREAD = 0.5  # heights above a sensor with a larger relative spread are a tree, not a roof
_CONTACT = 1e-3  # distance of ray starts from a sensor's surface, as a fraction of the diagonal
_MAX_POSITIONS = 8  # sensor positions from which rays are cast


def surrounding_box(bounds: Floats, trajectories: Sequence[Floats]) -> Floats | None:
    """Return a box around trajectories, or None if the box covers most of the scene.

    `bounds` (2, 3) is the bounding box of the scene, and each trajectory has shape (k, 3), in
    meters. The box extends down to the lowest point of the scene.
    """
    if not trajectories:
        return None
    positions = np.concatenate(trajectories)
    lower = positions.min(axis=0)
    upper = positions.max(axis=0)
    length = float(np.linalg.norm((upper - lower)[:2]))
    margin = max(
        _MARGIN_SHARE * length, _MARGIN_HEIGHTS * float(upper[2] - bounds[0, 2]), _MIN_MARGIN_M
    )
    box = np.stack([lower - margin, upper + margin]).clip(*bounds)
    box[0, 2] = bounds[0, 2]
    box_area, scene_area = (float(np.prod((b[1] - b[0])[:2])) for b in (box, bounds))
    return box if box_area < _MAX_SHARE * scene_area else None


def floor_and_cut_heights(
    scene: Scene, caster: RayCaster, positions: Floats
) -> tuple[float | None, float | None]:
    """Return the floor height below positions and the height at which to cut the scene.

    `positions` has shape (p, 3), and all values are in meters. The cut height is halfway up to the
    roof, or None if there is no roof. The floor height is None if there is no surface below a
    position.
    """
    sampled = positions[
        np.linspace(0, len(positions) - 1, min(len(positions), _MAX_POSITIONS)).astype(int)
    ]
    floor = (
        sampled[:, 2] - caster.cast(sampled, np.tile([0.0, 0.0, -1.0], (len(sampled), 1))).distance
    )
    rays = golden_spiral(_RAYS, np.sin(np.radians(_STEEP_DEG)))
    start_m = _CONTACT * float(np.linalg.norm(np.ptp(scene.bounds, axis=0)))
    hits = caster.cast(
        np.repeat(sampled, _RAYS, axis=0), np.tile(rays, (len(sampled), 1)), t_min=start_m
    )
    clearance = hits.distance.reshape(-1, _RAYS) * rays[:, 2]
    is_hit = np.isfinite(clearance)
    cut_height = None
    if (
        is_hit.mean() >= _MIN_ROOF_SHARE
        and np.median([_relative_spread(a[m]) for a, m in zip(clearance, is_hit, strict=True)])
        <= _MAX_SPREAD
    ):
        heights = sampled[:, 2, None] + clearance
        cut_height = float(positions[:, 2].max() + np.median(heights[is_hit])) / 2
    return (float(floor.min()) if np.isfinite(floor).all() else None), cut_height


def _relative_spread(heights: Floats) -> float:
    """Return the interquartile range of heights divided by their median.

    The result is 0 if there are no heights.
    """
    if not len(heights):
        return 0.0
    lower, middle, upper = np.percentile(heights, [25, 50, 75])
    return float((upper - lower) / middle)


@dataclass(frozen=True, eq=False)
class ScenePart:
    """Triangles of a part of a scene, mapped to the triangles of the entire scene."""

    scene: Scene
    parents: Ints  # (f,) triangle of the uncut scene from which each triangle is cut
    shares: Floats  # (f,) fraction of the parent's area

    @classmethod
    def from_scene(cls, scene: Scene) -> ScenePart:
        """Return the whole scene as a part."""
        return cls(scene, np.arange(len(scene.faces)), np.ones(len(scene.faces)))

    def cut(self, box: Floats) -> ScenePart:
        """Return the part inside a box, or the entire part if the inside is empty.

        Objects narrower than the box are kept completely if their center is inside. Wider objects,
        such as the ground, are cut at the sides of the box. All objects are cut at the top, because
        towers would hide the trajectory. Objects keep their numbers even if they have no triangle
        left.
        """
        scene = self.scene
        boxes = scene.object_bounds[:, :, :2]
        middle = boxes.mean(axis=1)
        narrow = ((boxes[:, 1] - boxes[:, 0]) <= (box[1] - box[0])[:2]).all(axis=1)
        inside = ((middle >= box[0, :2]) & (middle <= box[1, :2])).all(axis=1)
        uncut_faces = np.flatnonzero((narrow & inside)[scene.face_object])
        vertices = scene.vertices
        parents = np.flatnonzero(~narrow[scene.face_object])
        faces = scene.faces[parents].astype(np.int64)
        for axis in (0, 1):
            for sign, limit in ((1.0, box[1, axis]), (-1.0, box[0, axis])):
                vertices, faces, parents = _clip_triangles(
                    vertices, faces, parents, axis, sign, limit
                )
        faces = np.concatenate([scene.faces[uncut_faces], faces])
        parents = np.append(uncut_faces, parents)
        vertices, faces, parents = _clip_triangles(vertices, faces, parents, 2, 1.0, box[1, 2])
        if not len(faces):
            return self
        face_object = scene.face_object[parents]
        colors = scene.colors and scene.colors.take(parents)
        part = Scene(
            vertices,
            faces.astype(np.int32),
            face_object,
            scene.names,
            scene.origin,
            colors=colors,
        )
        full_areas = triangle_areas(scene.vertices[scene.faces[parents]])
        areas = triangle_areas(vertices[faces])
        fractions = np.divide(areas, full_areas, out=np.ones(len(full_areas)), where=full_areas > 0)
        return ScenePart(part, self.parents[parents], self.shares[parents] * fractions)


def _clip_triangles(
    vertices: Floats, faces: Ints, parents: Ints, axis: int, sign: float, limit: float
) -> tuple[Floats, Ints, Ints]:
    """Clip triangles to the half-space ``sign * (coordinate - limit) <= 0``.

    A triangle with one corner inside becomes a smaller triangle, and a triangle with two corners
    inside becomes two triangles. The result contains vertices (v, 3), faces (f, 3), and the parent
    (f,) of each face.
    """
    beyond = sign * (vertices[:, axis] - limit)
    outside = beyond[faces] > 0  # (f, 3)
    count = outside.sum(axis=1)
    clipped = [faces[count == 0]]
    piece_parents = [parents[count == 0]]
    for corners_outside in (1, 2):
        rows = np.flatnonzero(count == corners_outside)
        # Start with the corner that is alone on its side of the plane.
        first = np.argmax(outside[rows] == (corners_outside == 1), axis=1)
        a, b, c = (faces[rows, (first + k) % 3] for k in range(3))
        ab = len(vertices) + np.arange(len(rows))
        ac = ab + len(rows)
        crossings = [_crossing(vertices, beyond, a, corner) for corner in (b, c)]
        vertices = np.concatenate([vertices, *crossings])
        beyond = np.append(beyond, np.zeros(2 * len(rows)))
        pieces = [(ab, b, c), (ab, c, ac)]
        if corners_outside == 2:
            pieces = [(a, ab, ac)]
        clipped += [np.stack(piece, axis=1) for piece in pieces]
        piece_parents += [parents[rows]] * len(pieces)
    return vertices, np.concatenate(clipped), np.concatenate(piece_parents)


def _crossing(vertices: Floats, beyond: Floats, start: Ints, stop: Ints) -> Floats:
    """Return the points where edges cross a plane.

    `beyond` (v,) contains the signed distances of all vertices from the plane.
    """
    fraction = beyond[start] / (beyond[start] - beyond[stop])
    return vertices[start] + fraction[:, None] * (vertices[stop] - vertices[start])
