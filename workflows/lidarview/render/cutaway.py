"""Cutaways of buildings: removes walls and roofs between the camera and the sensors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Ints

from .surface import Surface, dot, spiral

MAX_SENSORS = 8  # sensors whose surroundings are tested
MAX_LAYERS = 12  # walls have two faces, roofs have beams; more surfaces are not a wall
ENCLOSED = 0.7  # share of horizontal rays from indoor sensors that hit the scene
HIDDEN = 0.65  # share of the sensors' hits; below, the camera sees too few of them


@dataclass(frozen=True, eq=False)
class Cutaway:
    """The surfaces to remove.

    A hit is removed if its object surrounds the sensors seen from above, it lies in that object's
    outer shell, and its plane has the camera on one side and most sensors on the other. So both
    faces of near walls and the roof are removed, while far walls, the floor and things inside
    stay, whatever the winding and grouping of triangles.
    """

    surface: Surface
    sensors: Floats  # (p, 3) meters
    eye: Floats  # (3,) the camera
    surrounds: Bools  # (objects,) whether the sensors are within the object, seen from above
    core: Floats  # (objects, 2, 3) box inside each object's shell

    @classmethod
    def from_sensors(cls, surface: Surface, sensors: Floats, eye: Floats) -> Cutaway:
        """Find the surfaces that hide sensors at (p, 3) from a camera at `eye`."""
        core = surface.scene.object_bounds.copy()
        flat = sensors[:, None, :2]
        inside = ((flat > core[None, :, 0, :2]) & (flat < core[None, :, 1, :2])).all(axis=2)
        width = np.where(np.isfinite(core).all(axis=1), core[:, 1] - core[:, 0], 0.0)
        core[:, 0, :2] += 0.06 * width[:, :2]
        core[:, 1, :2] -= 0.06 * width[:, :2]
        # The roof and things under it: all above the middle between sensors and top.
        core[:, 1, 2] = (core[:, 1, 2] + sensors[:, 2].max()) / 2
        # Hills are not walls: objects below the sensors that only face up are ground.
        facing = np.full(len(core), np.inf)
        np.minimum.at(facing, surface.scene.face_object, surface.face_normals[:, 2])
        ground = (facing > 0) & (core[:, 0, 2] < sensors[:, 2].min())
        return cls(surface, sensors, eye, (inside.mean(axis=0) >= 0.5) & ~ground, core)

    def removes(self, points: Floats, triangle: Ints) -> Bools:
        """Mark hits (n,) at points (n, 3) on triangles (n,) that are removed."""
        owner = self.surface.scene.face_object[triangle]
        lower = self.core[owner, 0]
        upper = self.core[owner, 1]
        beside = (points[:, :2] < lower[:, :2]) | (points[:, :2] > upper[:, :2])
        removed: Bools = self.surrounds[owner] & (beside.any(axis=1) | (points[:, 2] > upper[:, 2]))
        indices = np.flatnonzero(removed)
        normal = self.surface.face_normals[triangle[indices]]
        height = dot(normal, points[indices])
        eye_above = normal @ self.eye > height
        sensor_above = normal @ self.sensors.T > height[:, None]
        removed[indices] = (sensor_above != eye_above[:, None]).mean(axis=1) >= 0.5
        return removed


def plan_cutaway(surface: Surface, poses: Floats, eye: Floats) -> Cutaway | None:
    """Return a cutaway that shows the surroundings of sensors at poses (p, 3) to a camera.

    None if the sensors are outdoors, or the camera sees most of their surroundings anyway.
    """
    if not len(poses):
        return None
    sensors = poses[np.linspace(0, len(poses) - 1, min(len(poses), MAX_SENSORS)).astype(int)]
    level = surface.caster.cast(*_probes(sensors, 128, 0.0, 15.0)).distance
    if np.isfinite(level).mean() < ENCLOSED:
        return None
    origins, directions = _probes(sensors, 512, -60.0, 30.0)
    distances = surface.caster.cast(origins, directions).distance
    hit = np.isfinite(distances)
    offset = origins[hit] + distances[hit, None] * directions[hit] - eye
    distance = np.linalg.norm(offset, axis=1)
    nearest = surface.caster.cast(eye, offset / distance[:, None]).distance
    if (nearest >= distance * (1 - 1e-3)).mean() >= HIDDEN:
        return None
    return Cutaway.from_sensors(surface, sensors, eye)


def _probes(sensors: Floats, count: int, low_deg: float, high_deg: float) -> tuple[Floats, Floats]:
    """Return origins and directions (p * count, 3) of rays from sensors, between two elevations."""
    rays = spiral(count, *np.sin(np.radians([low_deg, high_deg])))
    return np.repeat(sensors, count, axis=0), np.tile(rays, (len(sensors), 1))


def cast_through(
    surface: Surface, cutaway: Cutaway | None, eye: Floats, directions: Floats
) -> tuple[Floats, Ints, Floats, Floats]:
    """Cast rays from the eye to the closest surfaces that are not removed.

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
        next_hits = surface.caster.cast(eye + start[:, None] * directions[live], directions[live])
        distance[live] = start + next_hits.distance
        triangle[live] = next_hits.triangle
        u[live] = next_hits.u
        v[live] = next_hits.v
        live = live[triangle[live] >= 0]
    return distance, triangle, u, v


def blocked(
    surface: Surface, cutaway: Cutaway | None, origins: Floats, directions: Floats, reach: float
) -> Bools:
    """Mark rays (n, 3) that hit a surface within `reach` meters that is not removed."""
    hits = surface.caster.cast(origins, directions, t_max=reach)
    is_hit = np.asarray(hits.triangle >= 0)
    if cutaway is not None:
        indices = np.flatnonzero(is_hit)
        points = origins[indices] + hits.distance[indices, None] * directions[indices]
        is_hit[indices] = ~cutaway.removes(
            points, np.asarray(hits.triangle[indices], dtype=np.int64)
        )
    return is_hit
