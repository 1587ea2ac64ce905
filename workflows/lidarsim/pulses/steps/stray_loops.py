"""Compiled loops for stray light (stray_light.py) and crosstalk (crosstalk.py)."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined, noinline
from raybeam.ray_loops import perpendicular_axes

from ...casting.surface_loops import normal_incidence_energy
from ...numerics.arrays import Bools, Floats, Ints
from ...numerics.elementary_loops import arctan2, sin_cos
from ...sensor.optics import LIGHT_M_NS

CELL_RAYS = 1 << 8  # number of consecutive rays that are compared with retroreflectors at a time
MAX_STRAY = math.radians(30.0)  # maximum angle between a ray and stray light
# Rays to an edge of a triangle are moved towards its center by this fraction of the distance, so
# that they hit the triangle.
INWARDS = 0.02


class RayCells(NamedTuple):
    """Rays, and the cones around cells of `CELL_RAYS` consecutive rays."""

    origins: Floats  # (3, n)
    directions: Floats  # (3, n)
    # (c, 5): axis, half angle in radians, and largest distance in meters from the first origin.
    cones: Floats


class RetroTriangles(NamedTuple):
    """Cluster of retroreflecting triangles."""

    corners: Floats  # (t, 3, 3)
    centers: Floats  # (t, 3): centers of the triangles
    center: Floats  # (3,): center of the bounding sphere
    radius: float  # radius of the bounding sphere, meters
    # (t,): energy that a beam at normal incidence returns from 10 m, relative to a white surface.
    back: Floats


class StrayLimits(NamedTuple):
    """Detection limits of stray light."""

    min_range_m: float
    share_at_degree: (
        float  # energy at an angle of 1 degree, as a fraction of the energy in the beam
    )
    faintest: float  # minimum energy that may be detected
    extinction: float  # 1/m


class StrayLight(NamedTuple):
    """Strongest stray light on each ray, written by compiled loops."""

    energy: Floats  # (n,)
    # (n, 3), meters: from the ray's origin to the source of the light, along the axes in which rays
    # and triangles were given.
    points: Floats
    new: Bools  # (n,): True where a loop has written light


class SpotPairs(NamedTuple):
    """Pairs of a spot and the rays that may see it.

    All arrays have shape (p,).
    """

    spot: Ints  # row of `LitSpots`
    first: Ints  # first ray, as a row of `ReceivingRays.order`
    stop: Ints  # one past the last ray


class ReceivingRays(NamedTuple):
    """Rays of a receiver, in the scene frame."""

    order: Ints  # (n,): rows sorted by firing time
    fired_ns: Floats  # (n,)
    origins: Floats  # (n, 3)
    directions: Floats  # (n, 3)


class LitSpots(NamedTuple):
    """Spots on surfaces that pulses of other sensors illuminate, in the scene frame."""

    time_ns: Floats  # (s,): when the pulse illuminates the spot
    positions: Floats  # (s, 3), meters


class ReceptionLimits(NamedTuple):
    """Limits within which a receiver detects pulses of other sensors."""

    cosine: float  # cosine of the largest angle between a ray and a spot
    min_range_m: float  # minimum apparent distance of a spot
    max_range_m: float


class ReceivedSpots(NamedTuple):
    """Output arrays for rays that receive the light of spots.

    All arrays have shape (k,).
    """

    row: Ints  # row of the ray, in `ReceivingRays`
    spot: Ints  # row of `LitSpots`
    distance: Floats  # apparent distance of the spot, meters
    range_m: Floats  # actual distance of the spot, meters

    def first(self, count: int) -> ReceivedSpots:
        """Return views of the first `count` rows."""
        return ReceivedSpots(
            self.row[:count], self.spot[:count], self.distance[:count], self.range_m[:count]
        )


@inlined
def _angle(cosine):
    """Return the angle, in radians, of a cosine that rounding may have moved beyond 1."""
    cosine = min(max(cosine, -1.0), 1.0)
    return arctan2(math.sqrt((1 - cosine) * (1 + cosine)), cosine)


@compiled()
def bound_cells(origins, directions, cones):
    """Write the cones that bound cells of rays for `RayCells`."""
    count = origins.shape[1]
    for c in range(len(cones)):
        first = c * CELL_RAYS
        stop = min((c + 1) * CELL_RAYS, count)
        x = y = z = max_square = 0.0
        for k in range(first, stop):
            x = x + directions[0, k]
            y = y + directions[1, k]
            z = z + directions[2, k]
            a = origins[0, k] - origins[0, first]
            b = origins[1, k] - origins[1, first]
            d = origins[2, k] - origins[2, first]
            max_square = max(max_square, (a * a + b * b) + d * d)
        length = max(math.sqrt((x * x + y * y) + z * z), 1e-9)
        x = x / length
        y = y / length
        z = z / length
        min_cosine = 1.0
        for k in range(first, stop):
            cosine = (x * directions[0, k] + y * directions[1, k]) + z * directions[2, k]
            min_cosine = min(min_cosine, cosine)
        cones[c, 0] = x
        cones[c, 1] = y
        cones[c, 2] = z
        cones[c, 3] = _angle(min_cosine)
        cones[c, 4] = math.sqrt(max_square)


@noinline
def _nearest_point(corners, t, ray):  # noqa: PLR0914 - a compiled loop
    """Return the angle between a ray and a triangle, as a tangent, and the nearest point.

    The nearest point is the point of the triangle at the smallest angle to the ray. `ray` is an
    origin and a direction. The point is a vector from the ray's origin. The tangent is 0 if the ray
    hits the triangle, and -1 if the triangle is not in front of the ray.
    """
    ox, oy, oz, dx, dy, dz = ray
    a, b, c, d, e, f = perpendicular_axes(dx, dy, dz)
    min_tangent = np.inf
    nearest = (0.0, 0.0, 0.0)
    all_left = True
    all_right = True
    for corner in range(3):
        next_corner = corner + 1 if corner < 2 else 0
        # p and q are the two corners relative to the origin, and p_depth and q_depth are their
        # depths. On a plane at distance 1, (x, y) is the first corner and (u, v) leads to the
        # second.
        px = corners[t, corner, 0] - ox
        py = corners[t, corner, 1] - oy
        pz = corners[t, corner, 2] - oz
        qx = corners[t, next_corner, 0] - ox
        qy = corners[t, next_corner, 1] - oy
        qz = corners[t, next_corner, 2] - oz
        p_depth = (px * dx + py * dy) + pz * dz
        q_depth = (qx * dx + qy * dy) + qz * dz
        if not (p_depth > 0 and q_depth > 0):
            return -1.0, nearest
        x = ((px * a + py * b) + pz * c) / p_depth
        y = ((px * d + py * e) + pz * f) / p_depth
        u = ((qx * a + qy * b) + qz * c) / q_depth - x
        v = ((qx * d + qy * e) + qz * f) / q_depth - y
        cross_product = x * v - y * u
        all_left = all_left and cross_product >= 0
        all_right = all_right and cross_product <= 0
        step = min(max(-(x * u + y * v) / max(u * u + v * v, 1e-300), 0.0), 1.0)
        tangent = math.sqrt((x + step * u) * (x + step * u) + (y + step * v) * (y + step * v))
        if tangent < min_tangent:
            # A step on the plane corresponds to a different fraction of the edge in space.
            fraction = step * p_depth / (step * p_depth + (1 - step) * q_depth)
            nearest = (
                px + fraction * (qx - px),
                py + fraction * (qy - py),
                pz + fraction * (qz - pz),
            )
            min_tangent = tangent
    return (0.0 if all_left or all_right else min_tangent), nearest


@inlined
def _reach_of_cell(rays, c, triangles, limits):
    """Return whether rays of a cell may receive light from triangles, and up to which angle.

    The angle is returned as a cosine. It is the largest angle between a ray of the cell and the
    center of the triangles at which the ray may receive light. At larger angles, the light of the
    nearest triangle is too faint. All triangles are assumed to return as much light as the first.
    """
    cones = rays.cones
    first = c * CELL_RAYS
    x = triangles.center[0] - rays.origins[0, first]
    y = triangles.center[1] - rays.origins[1, first]
    z = triangles.center[2] - rays.origins[2, first]
    size = triangles.radius + cones[c, 4]
    distance = math.sqrt((x * x + y * y) + z * z)
    half_angle = math.pi
    axis_angle = 0.0
    if distance > size:
        sine = size / distance
        half_angle = arctan2(sine, math.sqrt((1 - sine) * (1 + sine)))
        axis_angle = _angle(((cones[c, 0] * x + cones[c, 1] * y) + cones[c, 2] * z) / distance)
    nearest_m = max(distance - size, max(limits.min_range_m, 1e-3))
    in_beam_energy = triangles.back[0] * normal_incidence_energy(nearest_m, limits.extinction)
    reach_angle = math.radians(
        math.sqrt(limits.share_at_degree / (limits.faintest / max(in_beam_energy, 1e-300)))
    )
    reach_angle = min(reach_angle, MAX_STRAY) + half_angle
    _, cosine = sin_cos(min(reach_angle, math.pi))
    return axis_angle <= cones[c, 3] + reach_angle, cosine


@inlined
def _choose_triangles(centers, ray, chosen):
    """Write the triangles whose centers are at the smallest angles to a ray. Return their number.

    `centers` has shape (t, 3). The length of `chosen` is the number of triangles to choose.
    """
    ox, oy, oz, dx, dy, dz = ray
    count = min(len(centers), len(chosen))
    for number in range(count):
        chosen[number] = number
    if len(centers) > count:
        for number in range(count):
            max_cosine = -2.0
            for t in range(len(centers)):
                is_chosen = False
                for earlier in range(number):
                    is_chosen |= chosen[earlier] == t
                x = centers[t, 0] - ox
                y = centers[t, 1] - oy
                z = centers[t, 2] - oz
                cosine = (x * dx + y * dy) + z * dz
                cosine = cosine / math.sqrt((x * x + y * y) + z * z)
                if not is_chosen and cosine > max_cosine:
                    max_cosine = cosine
                    chosen[number] = t
    return count


@inlined
def _add_light(k, t, ray, triangles, limits, strongest):
    """Replace row `k` of `strongest` with the light of triangle `t` if that is stronger."""
    centers = triangles.centers
    tangent, nearest = _nearest_point(triangles.corners, t, ray)
    angle = math.degrees(arctan2(tangent, 1.0))
    if 0 < angle < math.degrees(MAX_STRAY):
        x = nearest[0] + INWARDS * ((centers[t, 0] - ray[0]) - nearest[0])
        y = nearest[1] + INWARDS * ((centers[t, 1] - ray[1]) - nearest[1])
        z = nearest[2] + INWARDS * ((centers[t, 2] - ray[2]) - nearest[2])
        distance = math.sqrt((x * x + y * y) + z * z)
        in_beam_energy = triangles.back[t] * normal_incidence_energy(distance, limits.extinction)
        energy = min(limits.share_at_degree / (angle * angle), 1.0) * in_beam_energy
        if energy > strongest.energy[k]:
            strongest.energy[k] = energy
            strongest.new[k] = True
            strongest.points[k, 0] = x
            strongest.points[k, 1] = y
            strongest.points[k, 2] = z


@compiled()
def find_stray_light(rays, triangles, limits, chosen, strongest):  # noqa: PLR0914 - a compiled loop
    """Replace rows of `strongest` with the light of `triangles` where that is stronger.

    `rays` is a `RayCells`, `triangles` a `RetroTriangles` in the frame of the rays, `limits` a
    `StrayLimits`, and `strongest` a `StrayLight`. The light comes from the point on the triangles
    that is nearest to a ray by angle. Only the triangles nearest to a ray are compared with it.
    Their number is the length of `chosen`, which is scratch memory.
    """
    center = triangles.center
    origins = rays.origins
    directions = rays.directions
    count = origins.shape[1]
    for c in range(len(rays.cones)):
        in_reach, cosine = _reach_of_cell(rays, c, triangles, limits)
        if not in_reach:
            continue
        for k in range(c * CELL_RAYS, min((c + 1) * CELL_RAYS, count)):
            ox = origins[0, k]
            oy = origins[1, k]
            oz = origins[2, k]
            dx = directions[0, k]
            dy = directions[1, k]
            dz = directions[2, k]
            x = center[0] - ox
            y = center[1] - oy
            z = center[2] - oz
            if (x * dx + y * dy) + z * dz < cosine * math.sqrt((x * x + y * y) + z * z):
                continue
            ray = (ox, oy, oz, dx, dy, dz)
            for number in range(_choose_triangles(triangles.centers, ray, chosen)):
                _add_light(k, chosen[number], ray, triangles, limits, strongest)


@compiled()
def receive(pairs, rays, spots, limits, output):
    """Write the rays that receive the light of spots to `output`. Return their number.

    `pairs` is a `SpotPairs`, `rays` a `ReceivingRays`, `spots` a `LitSpots`, `limits` a
    `ReceptionLimits`, and `output` a `ReceivedSpots`. The apparent distance of a spot is computed
    as if the ray had emitted the pulse.
    """
    origins = rays.origins
    directions = rays.directions
    positions = spots.positions
    count = 0
    for pair in range(len(pairs.spot)):
        s = pairs.spot[pair]
        for k in range(pairs.first[pair], pairs.stop[pair]):
            r = rays.order[k]
            x = positions[s, 0] - origins[r, 0]
            y = positions[s, 1] - origins[r, 1]
            z = positions[s, 2] - origins[r, 2]
            range_m = math.sqrt((x * x + y * y) + z * z)
            ahead = (x * directions[r, 0] + y * directions[r, 1]) + z * directions[r, 2]
            delay_ns = spots.time_ns[s] + range_m / LIGHT_M_NS - rays.fired_ns[r]
            distance = delay_ns * (LIGHT_M_NS / 2)
            in_view = range_m > 0 and ahead >= limits.cosine * range_m
            if in_view and limits.min_range_m <= distance <= limits.max_range_m:
                output.row[count] = r
                output.spot[count] = s
                output.distance[count] = distance
                output.range_m[count] = range_m
                count += 1
    return count
