"""Cutaways of buildings: removes walls and roofs between the camera and the sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Ints

from .surface import Surface, dot, spiral

MOST_SENSORS = 8  # sensors that are tested for what they see
MAX_LAYERS = 12  # walls have two faces, roofs have beams; more surfaces are not a wall
ENCLOSED = 0.7  # share of horizontal rays from indoor sensors that hit the scene
HIDDEN = 0.65  # the camera sees less than this share of what the sensors see


@dataclass(frozen=True, eq=False)
class Cutaway:
    """The surfaces to remove.

    A hit is removed if its object surrounds the sensors seen from above, it lies in that object's
    outer shell, and its plane has the camera on one side and most sensors on the other. So both
    faces of near walls and the roof are removed, while far walls, the floor and things inside
    stay, whatever the winding and grouping of triangles.
    """

    surface: Surface
    sensors: Floats  # (p, 3) metres
    eye: Floats  # (3,) the camera
    surrounds: Bools  # (objects,) whether the sensors are within it, seen from above
    core: Floats  # (objects, 2, 3) box inside each object's shell

    @classmethod
    def around(cls, surface: Surface, sensors: Floats, eye: Floats) -> Cutaway:
        """Find the surfaces that hide sensors at (p, 3) from a camera at `eye`."""
        core = surface.scene.object_bounds.copy()
        flat = sensors[:, None, :2]
        inside = ((flat > core[None, :, 0, :2]) & (flat < core[None, :, 1, :2])).all(axis=2)
        width = np.where(np.isfinite(core).all(axis=1), core[:, 1] - core[:, 0], 0.0)
        core[:, 0, :2] += 0.06 * width[:, :2]
        core[:, 1, :2] -= 0.06 * width[:, :2]
        # The roof and things under it: all above the middle between sensors and top.
        core[:, 1, 2] = (core[:, 1, 2] + sensors[:, 2].max()) / 2
        # Hills are no walls: what only faces up, from below the sensors, is ground.
        facing = np.full(len(core), np.inf)
        np.minimum.at(facing, surface.scene.face_object, surface.face_normals[:, 2])
        ground = (facing > 0) & (core[:, 0, 2] < sensors[:, 2].min())
        return cls(surface, sensors, eye, (inside.mean(axis=0) >= 0.5) & ~ground, core)

    def removes(self, points: Floats, triangle: Ints) -> Bools:
        """Whether hits at points (n, 3) on triangles (n,) are removed."""
        owner = self.surface.scene.face_object[triangle]
        low = self.core[owner, 0]
        high = self.core[owner, 1]
        beside = (points[:, :2] < low[:, :2]) | (points[:, :2] > high[:, :2])
        out: Bools = self.surrounds[owner] & (beside.any(axis=1) | (points[:, 2] > high[:, 2]))
        which = np.flatnonzero(out)
        normal = self.surface.face_normals[triangle[which]]
        height = dot(normal, points[which])
        eye_above = normal @ self.eye > height
        sensor_above = normal @ self.sensors.T > height[:, None]
        out[which] = (sensor_above != eye_above[:, None]).mean(axis=1) >= 0.5
        return out


def plan_cutaway(surface: Surface, poses: Floats, eye: Floats) -> Cutaway | None:
    """Decide whether to remove surfaces to show what the sensors at poses (p, 3) see.

    None if the sensors are outdoors, or the camera sees most of it anyway.
    """
    if not len(poses):
        return None
    sensors = poses[np.linspace(0, len(poses) - 1, min(len(poses), MOST_SENSORS)).astype(int)]
    level = surface.caster.cast(*_probes(sensors, 128, 0.0, 15.0)).distance
    if np.isfinite(level).mean() < ENCLOSED:
        return None
    origins, directions = _probes(sensors, 512, -60.0, 30.0)
    seen = surface.caster.cast(origins, directions).distance
    hit = np.isfinite(seen)
    offset = origins[hit] + seen[hit, None] * directions[hit] - eye
    distance = np.linalg.norm(offset, axis=1)
    nearest = surface.caster.cast(eye, offset / distance[:, None]).distance
    if (nearest >= distance * (1 - 1e-3)).mean() >= HIDDEN:
        return None
    return Cutaway.around(surface, sensors, eye)


def _probes(sensors: Floats, count: int, low_deg: float, high_deg: float) -> tuple[Floats, Floats]:
    """Origins and directions (p * count, 3) of `count` rays from each, between two elevations."""
    rays = spiral(count, *np.sin(np.radians([low_deg, high_deg])))
    return np.repeat(sensors, count, axis=0), np.tile(rays, (len(sensors), 1))


def cast_through(
    surface: Surface, cutaway: Cutaway | None, eye: Floats, directions: Floats
) -> tuple[Floats, Ints, Floats, Floats]:
    """Closest hits on surfaces that are not removed.

    Returns
    -------
    distance, triangle, u, v
        (n,) each; a miss is at infinity with triangle -1.
    """
    hits = surface.caster.cast(eye, directions)
    distance = np.array(hits.distance, dtype=np.float64)
    triangle = np.array(hits.triangle, dtype=np.int64)
    u = np.array(hits.u, dtype=np.float64)
    v = np.array(hits.v, dtype=np.float64)
    if cutaway is None:
        return distance, triangle, u, v
    live = np.flatnonzero(triangle >= 0)
    for _ in range(MAX_LAYERS):
        points = eye + distance[live, None] * directions[live]
        live = live[cutaway.removes(points, triangle[live])]
        if not len(live):
            break
        start = distance[live] * (1 + 1e-6)
        again = surface.caster.cast(eye + start[:, None] * directions[live], directions[live])
        distance[live] = start + again.distance
        triangle[live] = again.triangle
        u[live] = again.u
        v[live] = again.v
        live = live[triangle[live] >= 0]
    return distance, triangle, u, v


def blocked(
    surface: Surface, cutaway: Cutaway | None, origins: Floats, directions: Floats, reach: float
) -> Bools:
    """Whether rays (n, 3) hit a surface within `reach` metres that is not removed."""
    hits = surface.caster.cast(origins, directions, t_max=reach)
    met = np.asarray(hits.triangle >= 0)
    if cutaway is not None:
        which = np.flatnonzero(met)
        points = origins[which] + hits.distance[which, None] * directions[which]
        met[which] = ~cutaway.removes(points, np.asarray(hits.triangle[which], dtype=np.int64))
    return met
