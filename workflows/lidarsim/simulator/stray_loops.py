"""Loops over rays that receive other light: see stray_light.py and crosstalk.py."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np

from raybeam.compiled import compiled, inlined, stage
from raybeam.embree_rays import any_axes

from ..base.elementary_loops import arctan2, sin_cos
from ..sensor.optics import LIGHT_M_NS
from .surface_loops import at_right_angles

CELL_RAYS = 1 << 8  # consecutive rays that are compared with retro-reflectors at a time
STRAY_MOST = math.radians(30.0)  # no stray light comes from farther aside
INWARDS = 0.02  # of the way to the middle of a triangle: rays to its edge end there, to hit it


@inlined
def _angle(cosine):
    """Angle with a cosine, which may be rounded."""
    cosine = min(max(cosine, -1.0), 1.0)
    return arctan2(math.sqrt((1 - cosine) * (1 + cosine)), cosine)


@compiled()
def cones(starts, ahead, out):
    """Write cones around cells of rays (3, n), (c, 5): axis, half angle, and how far they move."""
    count = starts.shape[1]
    for c in range(len(out)):
        begin = c * CELL_RAYS
        end = min((c + 1) * CELL_RAYS, count)
        x = y = z = far = 0.0
        for k in range(begin, end):
            x = x + ahead[0, k]
            y = y + ahead[1, k]
            z = z + ahead[2, k]
            a = starts[0, k] - starts[0, begin]
            b = starts[1, k] - starts[1, begin]
            d = starts[2, k] - starts[2, begin]
            far = max(far, (a * a + b * b) + d * d)
        length = max(math.sqrt((x * x + y * y) + z * z), 1e-9)
        x = x / length
        y = y / length
        z = z / length
        least = 1.0
        for k in range(begin, end):
            least = min(least, (x * ahead[0, k] + y * ahead[1, k]) + z * ahead[2, k])
        out[c, 0] = x
        out[c, 1] = y
        out[c, 2] = z
        out[c, 3] = _angle(least)
        out[c, 4] = math.sqrt(far)


@stage
def _nearest(corners, t, ray):
    """Find where a triangle is nearest to a ray by angle, seen from its start, and its tangent.

    That is -1 if the triangle is not in front of the ray.
    """
    ox, oy, oz, dx, dy, dz = ray
    (a, b, c, d, e, f), best, place = any_axes(dx, dy, dz), np.inf, (0.0, 0.0, 0.0)
    left = right = True
    for one in range(3):
        other = one + 1 if one < 2 else 0
        # Of the two corners: seen from the start, depth, and place on a plane at a distance of 1.
        px = corners[t, one, 0] - ox
        py = corners[t, one, 1] - oy
        pz = corners[t, one, 2] - oz
        qx = corners[t, other, 0] - ox
        qy = corners[t, other, 1] - oy
        qz = corners[t, other, 2] - oz
        p = (px * dx + py * dy) + pz * dz
        q = (qx * dx + qy * dy) + qz * dz
        if not (p > 0 and q > 0):
            return -1.0, place
        x = ((px * a + py * b) + pz * c) / p
        y = ((px * d + py * e) + pz * f) / p
        u = ((qx * a + qy * b) + qz * c) / q - x
        v = ((qx * d + qy * e) + qz * f) / q - y
        turn = x * v - y * u
        left = left and turn >= 0
        right = right and turn <= 0
        along = min(max(-(x * u + y * v) / max(u * u + v * v, 1e-300), 0.0), 1.0)
        off = math.sqrt((x + along * u) * (x + along * u) + (y + along * v) * (y + along * v))
        if off < best:
            # A step on the plane is not the same share of the way between the corners.
            share = along * p / (along * p + (1 - along) * q)
            place = px + share * (qx - px), py + share * (qy - py), pz + share * (qz - pz)
            best = off
    return (0.0 if left or right else best), place


@compiled()
def leaks(starts, ahead, cells, corners, middles, middle, radius, back, few, nearest_m, share,
          faintest, extinction, best, ends, new):  # fmt: skip
    """Keep where rays (3, n) receive more light of near triangles than `best` (n,), and mark them.

    `back` (t,) is what triangles at a distance of 10 m return of a beam. The light comes from the
    point of the triangles that is nearest to a ray by angle, which is written to `ends` (n, 3). Of
    many triangles, those nearest to a ray are asked, as many as `few` has room for.
    """
    count = starts.shape[1]
    triangles = len(corners)
    for c in range(len(cells)):
        begin = c * CELL_RAYS
        end = min((c + 1) * CELL_RAYS, count)
        x = middle[0] - starts[0, begin]
        y = middle[1] - starts[1, begin]
        z = middle[2] - starts[2, begin]
        size = radius + cells[c, 4]
        far = math.sqrt((x * x + y * y) + z * z)
        wide = math.pi
        off = 0.0
        if far > size:
            sine = size / far
            wide = arctan2(sine, math.sqrt((1 - sine) * (1 + sine)))
            off = _angle(((cells[c, 0] * x + cells[c, 1] * y) + cells[c, 2] * z) / far)
        # The angle at which the light becomes too faint.
        whole = back[0] * at_right_angles(max(far - size, max(nearest_m, 1e-3)), extinction)
        reach = math.radians(math.sqrt(share / (faintest / max(whole, 1e-300))))
        reach = min(reach, STRAY_MOST) + wide
        if off > cells[c, 3] + reach:
            continue
        _, cosine = sin_cos(min(reach, math.pi))
        for k in range(begin, end):
            x = middle[0] - starts[0, k]
            y = middle[1] - starts[1, k]
            z = middle[2] - starts[2, k]
            ox = starts[0, k]
            oy = starts[1, k]
            oz = starts[2, k]
            dx = ahead[0, k]
            dy = ahead[1, k]
            dz = ahead[2, k]
            if (x * dx + y * dy) + z * dz < cosine * math.sqrt((x * x + y * y) + z * z):
                continue
            chosen = min(triangles, len(few))
            for number in range(chosen):
                few[number] = number
            if triangles > chosen:  # those whose middles are nearest
                for number in range(chosen):
                    most = -2.0
                    for t in range(triangles):
                        taken = False
                        for before in range(number):
                            taken |= few[before] == t
                        x = middles[t, 0] - ox
                        y = middles[t, 1] - oy
                        z = middles[t, 2] - oz
                        towards = (x * dx + y * dy) + z * dz
                        towards = towards / math.sqrt((x * x + y * y) + z * z)
                        if not taken and towards > most:
                            most = towards
                            few[number] = t
            for number in range(chosen):
                t = few[number]
                off, place = _nearest(corners, t, (ox, oy, oz, dx, dy, dz))
                angle = math.degrees(arctan2(off, 1.0))
                if not 0 < angle < math.degrees(STRAY_MOST):
                    continue
                x = place[0] + INWARDS * ((middles[t, 0] - ox) - place[0])
                y = place[1] + INWARDS * ((middles[t, 1] - oy) - place[1])
                z = place[2] + INWARDS * ((middles[t, 2] - oz) - place[2])
                distance = math.sqrt((x * x + y * y) + z * z)
                energy = min(share / (angle * angle), 1.0) * (
                    back[t] * at_right_angles(distance, extinction)
                )
                if energy > best[k]:
                    best[k] = energy
                    new[k] = True
                    ends[k, 0] = x
                    ends[k, 1] = y
                    ends[k, 2] = z


@compiled()
def received(spots, low, high, order, fired, starts, ahead, times, places, cosine, nearest_m,
             farthest_m, row, spot, distance, far):  # fmt: skip
    """Write rays that receive the light of spots, from where it seems to come; returns how many.

    Rays `order[low]` to `order[high]` may see each of `spots` (k,). Starts, directions and places
    are (n, 3); times are nanoseconds, of firing and of when the spots are lit.
    """
    count = 0
    for pair in range(len(spots)):
        s = spots[pair]
        for k in range(low[pair], high[pair]):
            r = order[k]
            x = places[s, 0] - starts[r, 0]
            y = places[s, 1] - starts[r, 1]
            z = places[s, 2] - starts[r, 2]
            away = math.sqrt((x * x + y * y) + z * z)
            along = (x * ahead[r, 0] + y * ahead[r, 1]) + z * ahead[r, 2]
            seems = (times[s] + away / LIGHT_M_NS - fired[r]) * (LIGHT_M_NS / 2)
            if away > 0 and along >= cosine * away and nearest_m <= seems <= farthest_m:
                row[count] = r
                spot[count] = s
                distance[count] = seems
                far[count] = away
                count += 1
    return count
