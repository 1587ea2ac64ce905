"""Check whether a position is inside a scene, inside an object, or outside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lidarsim.numerics.arrays import Bools, Floats
from lidarsim.scene.scene import Scene
from raybeam import RayCaster, available_backends

from .floor import triangles_in_box

RAYS = 1000  # number of rays from each position, and from outside
HAND_M = 0.1  # closer hits are ignored
CLEAR_M = 0.5  # required clearance around a sensor
BLOCK_FACES = 1 << 18  # triangles whose areas are added up at a time

# Fractions of rays. Of the downward rays from 1, 2, and 3 m above a patch of ground 5 m wide, a
# fraction of 0.4 hits the patch.
_GROUND = 0.4
_SKY = 0.3
_ENCLOSED = 0.95
_CLOSED = 0.8
_UPRIGHT = 0.9
_FLOOR = 0.3
_OPEN = 0.1  # surfaces with a larger openness are open
_LEAVES = 0.4  # maximum openness of leaves
# Limits for a room, which is a closed body with a floor and upright walls inside.
_MIN_ROOM_WIDTH_M = 2.0
_MAX_ROOM_HEIGHT_M = 15.0
_WHOLE = 0.9  # a body that spans this fraction of each side is the whole scene
# A room spans at least this fraction of the scene along each axis. Smaller bodies are objects in
# it.
_SPANS = 1 / 3
# Limits for the z component of directions more than 10 degrees above the horizon, within 60 degrees
# of straight up, and within 30 degrees of straight down. The fractions apply to the rays that hit a
# cover.
_RAISED = 0.17
_UPWARD = 0.5
_DOWNWARD = -0.87
_COVERED = 0.9
_WIDELY_COVERED = 0.95
# Minimum fraction of directions with surfaces inside a body. A flat surface covers at most half.
_AROUND = 0.6
# Distances, and number of directions, at which free positions are searched for.
_STEPS_M = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0)
_DIRECTIONS = 16


def is_obstructed(scene: Scene, positions: ArrayLike) -> bool:
    """Return True if any of the local positions is within `CLEAR_M` of a surface."""
    points = np.asarray(positions, np.float64).reshape(-1, 3)
    nearby = triangles_in_box(scene, points.min(axis=0) - CLEAR_M, points.max(axis=0) + CLEAR_M)
    if not len(nearby):
        return False
    caster = RayCaster(scene.vertices, scene.faces[nearby], "numpy")
    directions = np.tile(sphere_directions(RAYS), (len(points), 1))
    return bool(caster.cast(np.repeat(points, RAYS, axis=0), directions, t_max=CLEAR_M).hit.any())


@dataclass(frozen=True, eq=False)
class Views:
    """Hits of rays that are cast in all directions from a list of positions."""

    directions: Floats  # (n, 3) unit vectors
    distance: Floats  # (n,) in meters, infinite without a hit
    back: Bools  # (n,) whether the back of a triangle was hit
    normals: Floats  # (n, 3) unit normals of the triangles hit, 0 without a hit
    heights: Floats  # (n,) local z of the hits

    @property
    def hit(self) -> Bools:
        """Mask of the rays that hit a surface farther away than `HAND_M`."""
        return np.isfinite(self.distance) & (self.distance > HAND_M)

    @property
    def is_inside_body(self) -> bool:
        """Whether the positions are inside a body, so that rays only hit backs of surfaces."""
        enclosed = np.mean(np.isfinite(self.distance)) > _AROUND
        return bool(enclosed and self.hit.any() and np.mean(self.back[self.hit]) > 1 - 1 / RAYS)


@dataclass(frozen=True, eq=False)
class EnclosingBody:
    """An object that surrounds a position."""

    name: str
    bounds: Floats  # (2, 3) lower and upper corner, local coordinates in meters
    is_whole_scene: bool  # whether the scene contains hardly anything else


class PlacementChecker:
    """Checks positions in a scene without actors, by casting a few thousand rays."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        # CUDA is avoided, because its context would remain in this process.
        backend = "numpy" if available_backends()["tiles"] else "tiles"
        self._caster = RayCaster(scene.vertices, scene.faces, backend)

    def cast_around(self, positions: ArrayLike) -> Views:
        """Cast rays in all directions from the given local positions."""
        points = np.asarray(positions, np.float64).reshape(-1, 3)
        directions = sphere_directions(RAYS)
        return self.cast(np.repeat(points, RAYS, axis=0), np.tile(directions, (len(points), 1)))

    def cast_from_outside(self) -> Views:
        """Cast rays at the scene from outside, in all directions."""
        lower, upper = self._scene.bounds
        across = float(np.linalg.norm(upper - lower))
        toward = -sphere_directions(RAYS)
        # Aim at a grid of points in the box, because parallel rays would rarely hit thin objects.
        shares = np.stack([np.arange(RAYS) * step % 1.0 for step in (0.755, 0.57, 0.431)], axis=1)
        return self.cast(lower + shares * (upper - lower) - 2 * across * toward, toward)

    def is_object(self, views: Views) -> bool:
        """Return whether a scene is a single object, given the views from positions inside it.

        A scene is an object if almost no ray hits a surface, or if all its sides face outward and
        the positions are inside it, rather than on ground or in a room with a floor.
        """
        down = views.directions[:, 2] < 0
        below = np.mean(views.hit[down])
        above = np.mean(views.hit[~down])
        if below < _GROUND and above < _GROUND:
            return True
        outside = self.cast_from_outside()
        back = np.mean(outside.back[outside.hit])
        if back > 1 - _CLOSED:
            # This is a terrain seen from below, or the walls of a room. Half of all leaves and
            # surfels are seen from behind, but ground made of surfels is only below the sensor.
            leaves = back < _CLOSED and _openness(self._scene) < _LEAVES and above >= _SKY
            return bool(leaves and not _has_floor(views))
        if np.mean(np.isfinite(views.distance)) < _ENCLOSED:
            ground = np.mean((views.hit & ~views.back)[down]) >= _GROUND
            # A machine with openings also has surfaces above the sensor.
            return not (ground and (above < _SKY or _has_floor(views)))
        return not self._is_room(views)

    def is_inside_body(self, position: ArrayLike) -> bool:
        """Return whether a local position is inside a closed body other than a room.

        A body that stands on the ground may lack a bottom.
        """
        views = self.cast_around(position)
        hit_points = views.distance[views.hit, None] * views.directions[views.hit]
        sides = np.ptp(hit_points, axis=0) if len(hit_points) else np.zeros(3)
        spans = bool((sides >= _SPANS * np.ptp(self._scene.bounds, axis=0)).all())
        if views.is_inside_body:
            return not (spans and self._is_room(views))
        raised = views.directions[:, 2] > _RAISED
        closed = np.isfinite(views.distance[raised]).all() and views.hit[raised].any()
        return bool(closed and not spans and np.mean(views.back[raised & views.hit]) > 1 - 1 / RAYS)

    def find_enclosing_body(self, position: ArrayLike) -> EnclosingBody:
        """Return the object that most rays from a local position (3,) hit.

        At least one surface must be visible from the position.
        """
        points = np.tile(np.asarray(position, np.float64).reshape(3), (RAYS, 1))
        hits = self._caster.cast(points, sphere_directions(RAYS))
        owner = int(np.bincount(self._scene.face_object[hits.triangle[hits.hit]]).argmax())
        faces = self._scene.faces[self._scene.face_object == owner]
        corners = self._scene.vertices[faces].reshape(-1, 3)
        bounds = np.array([corners.min(axis=0), corners.max(axis=0)])
        sides = np.ptp(bounds, axis=0)
        whole = bool((sides >= _WHOLE * np.ptp(self._scene.bounds, axis=0)).all())
        return EnclosingBody(self._scene.names[owner], bounds, is_whole_scene=whole)

    def find_free_position(self, position: ArrayLike) -> Floats | None:
        """Return the free position (3,) that is closest to a local position, or None.

        Candidates are at the same height and within the scene. At a free position, the ground or a
        floor is visible below, and no surface is close.
        """
        start = np.asarray(position, np.float64).reshape(3)
        lower, upper = self._scene.bounds
        for step_m in _STEPS_M:
            for angle in np.arange(_DIRECTIONS) * 2 * np.pi / _DIRECTIONS:
                moved = start + step_m * np.array([np.cos(angle), np.sin(angle), 0.0])
                if ((moved > lower) & (moved < upper))[:2].all() and self.is_free(moved):
                    return moved
        return None

    def is_free(self, position: ArrayLike) -> bool:
        """Return whether a local position (3,) has ground below it and is not enclosed.

        No surface may be within `CLEAR_M`.
        """
        views = self.cast_around(position)
        below = np.mean((views.hit & ~views.back)[views.directions[:, 2] < 0])
        return bool(
            below >= _GROUND
            and views.distance.min() >= CLEAR_M
            and not self.is_inside_body(position)
            and not self.is_covered(position)
        )

    def is_covered(self, position: ArrayLike) -> bool:
        """Return whether a local position (3,) is below the scene.

        This is the case if nothing is straight below, and the backs of surfaces such as ground
        without thickness are above. It is also the case if the position is lower than the scene and
        objects, such as a bridge, are above in almost all directions.
        """
        views = self.cast_around(position)
        up = views.directions[:, 2]
        hits = np.isfinite(views.distance)
        if hits[up < _DOWNWARD].any():
            return False
        above = up > _UPWARD
        backs = views.back[above & hits]
        if np.mean(hits[above]) >= _COVERED and np.mean(backs) >= _COVERED:
            return True
        lower = np.asarray(position, np.float64).reshape(3)[2] < self._scene.bounds[0, 2]
        return bool(lower and np.mean(hits[up > _RAISED]) >= _WIDELY_COVERED)

    def _is_room(self, views: Views) -> bool:
        """Return whether positions are in a room, for a scene whose sides all face outward."""
        if not _has_floor(views):
            return False
        if np.mean(views.back) < 1 - _CLOSED:  # the walls have a thickness
            return True
        upright = np.abs(views.normals[:, 2]) < 0.01
        sides = np.ptp(self._scene.bounds, axis=0)
        fits = sides[:2].min() >= _MIN_ROOM_WIDTH_M and sides[2] <= _MAX_ROOM_HEIGHT_M
        return bool(fits and np.mean(_is_level(views) | upright) >= _UPRIGHT)

    def cast(self, origins: Floats, directions: Floats) -> Views:
        """Cast rays from the given local origins along unit directions."""
        hits = self._caster.cast(origins, directions)
        a, b, c = self._scene.vertices[self._scene.faces[hits.triangle]].transpose(1, 0, 2)
        normals = np.cross(b - a, c - a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        normals[~hits.hit] = 0.0
        heights = origins[:, 2] + np.where(hits.hit, hits.distance, 0.0) * directions[:, 2]
        back = (normals * directions).sum(axis=1) > 0
        return Views(directions, hits.distance, back, normals, heights)


def _is_level(views: Views) -> Bools:
    """Return a mask of the rays that hit a level surface."""
    return np.asarray(np.abs(views.normals[:, 2]) > 0.99)


def _has_floor(views: Views) -> bool:
    """Return whether steep downward rays hit level surfaces at similar heights."""
    steep = (views.directions[:, 2] < -0.7) & np.isfinite(views.distance)
    heights = views.heights[steep & _is_level(views)]
    floor = np.sum(np.abs(heights - np.median(heights)) < 0.3) if len(heights) else 0
    return int(floor) >= _FLOOR * int(np.sum(steep))


def is_open(scene: Scene) -> bool:
    """Return whether the surfaces in a scene are open, like those of a terrain.

    No rays are cast.
    """
    return _openness(scene) > _OPEN


def _openness(scene: Scene) -> float:
    """Return how open the surfaces in a scene are, from 0 to 1.

    This is the length of the sum of all area vectors, divided by the sum of their lengths.

    Area vectors point along the normals. The area vectors of a closed surface add up to zero.
    """
    total = np.zeros(3)
    area = 0.0
    for begin in range(0, len(scene.faces), BLOCK_FACES):
        a, b, c = scene.vertices[scene.faces[begin : begin + BLOCK_FACES]].transpose(1, 0, 2)
        areas = np.cross(b - a, c - a)
        total += areas.sum(axis=0)
        area += float(np.linalg.norm(areas, axis=1).sum())
    return float(np.linalg.norm(total)) / max(area, 1e-300)


def sphere_directions(count: int) -> Floats:
    """Return unit vectors that are evenly distributed along a Fibonacci spiral on a sphere."""
    numbers: Any = np.arange(count) + 0.5
    z = 1 - 2 * numbers / count
    angle = np.pi * (1 + np.sqrt(5)) * numbers
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
