"""Remove the walls and roofs between the camera and the sensors in a building."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints

from .surface import RenderMesh, dot, golden_spiral

MAX_SENSORS = 8  # number of sensors whose surroundings are tested
MAX_LAYERS = 12  # number of removed surfaces on a ray; walls have two faces, and roofs have beams
ENCLOSED = 0.7  # minimum fraction of horizontal rays that hit the scene if sensors are indoors
HIDDEN = 0.65  # a cutaway is made if the camera sees a smaller fraction of the sensors' hits


@dataclass(frozen=True, eq=False)
class Cutaway:
    """A rule that selects the surfaces to remove.

    A hit is removed if its object surrounds the sensors in plan view, the hit is in the outer shell
    of the object, and its plane has the camera on one side and most sensors on the other. Both
    faces of the walls in front and the roof are therefore removed. The walls at the back, the
    floor, and objects inside are kept. This does not depend on the winding and grouping of
    triangles.
    """

    surface: RenderMesh
    sensors: Floats  # (p, 3) meters
    eye: Floats  # (3,) the camera
    surrounds: Bools  # (objects,) whether the object surrounds the sensors in plan view
    core: Floats  # (objects, 2, 3) box inside each object's shell

    @classmethod
    def from_sensors(cls, surface: RenderMesh, sensors: Floats, eye: Floats) -> Cutaway:
        """Determine the surfaces that hide the given sensor positions from a camera at `eye`."""
        core = surface.scene.object_bounds.copy()
        flat = sensors[:, None, :2]
        inside = ((flat > core[None, :, 0, :2]) & (flat < core[None, :, 1, :2])).all(axis=2)
        width = np.where(np.isfinite(core).all(axis=1), core[:, 1] - core[:, 0], 0.0)
        core[:, 0, :2] += 0.06 * width[:, :2]
        core[:, 1, :2] -= 0.06 * width[:, :2]
        # The roof and objects below it are everything above the middle between sensors and top.
        core[:, 1, 2] = (core[:, 1, 2] + sensors[:, 2].max()) / 2
        # Hills are not walls. An object below the sensors that only faces up is ground.
        facing = np.full(len(core), np.inf)
        np.minimum.at(facing, surface.scene.face_object, surface.face_normals[:, 2])
        ground = (facing > 0) & (core[:, 0, 2] < sensors[:, 2].min())
        return cls(surface, sensors, eye, (inside.mean(axis=0) >= 0.5) & ~ground, core)

    def is_removed(self, points: Floats, triangle: Ints) -> Bools:
        """Return a mask of the removed hits, given their points and triangles."""
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


def plan_cutaway(surface: RenderMesh, poses: Floats, eye: Floats) -> Cutaway | None:
    """Plan a cutaway that lets a camera see the surroundings of the given sensor positions.

    Returns None if the sensors are outdoors, or if the camera sees enough without a cutaway.
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
    """Return the origins and directions of rays from sensors between two elevations."""
    rays = golden_spiral(count, *np.sin(np.radians([low_deg, high_deg])))
    return np.repeat(sensors, count, axis=0), np.tile(rays, (len(sensors), 1))


def cast_with_cutaway(
    surface: RenderMesh, cutaway: Cutaway | None, eye: Floats, directions: Floats
) -> tuple[Floats, Ints, Floats, Floats]:
    """Cast rays from the eye to the closest surfaces that are not removed.

    Returns
    -------
    distance, triangle, u, v
        (n,) each. A miss has an infinite distance and the triangle -1.
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
        live = live[cutaway.is_removed(points, triangle[live])]
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


def is_blocked(
    surface: RenderMesh, cutaway: Cutaway | None, origins: Floats, directions: Floats, reach: float
) -> Bools:
    """Return a mask of the rays that hit a surface within `reach` meters.

    Removed surfaces do not block rays.
    """
    hits = surface.caster.cast(origins, directions, t_max=reach)
    is_hit = np.asarray(hits.triangle >= 0)
    if cutaway is not None:
        indices = np.flatnonzero(is_hit)
        points = origins[indices] + hits.distance[indices, None] * directions[indices]
        is_hit[indices] = ~cutaway.is_removed(
            points, np.asarray(hits.triangle[indices], dtype=np.int64)
        )
    return is_hit
