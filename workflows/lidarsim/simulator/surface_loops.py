"""Loops over hits: what surfaces they are on, how these lie, and what light they send back."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from raybeam.compiled import compiled, inlined
from raybeam.rays import UNIT_SLACK

from ..base.elementary_loops import exp, sin_cos
from ..sensor.materials import GLASS_INDEX, NEAREST_M, REFERENCE_M, RETRO_GAIN, WATER_INDEX
from ..sensor.materials import fresnel as fresnel_of_arrays
from ..sensor.materials import within_water as within_water_of_arrays

fresnel = inlined(fresnel_of_arrays)
within_water = inlined(within_water_of_arrays)


@inlined
def _product(x, y, z, a, b, c):
    """As `motion.products`."""
    return (x * a + y * b) + z * c


@inlined
def _instance(t, begins):
    """Find the last instance whose triangles begin at or before one, by halves."""
    low = 0
    high = len(begins) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if begins[middle] <= t:
            low = middle
        else:
            high = middle
    return low


@compiled()
def find(triangle, begins, owners, shared, firsts, to_kept, standing, rows, objects, which):
    """Write rows among the triangles that are kept once, objects, and instances or -1.

    Triangles of instances begin at `begins`, whose last is where those of actors begin; `shared`
    and `firsts` are objects and first rows of instances.
    """
    plain = begins[0]
    actors = begins[-1]
    for k in range(len(triangle)):
        t = np.int64(triangle[k])
        which[k] = -1
        if t < plain:
            rows[k] = t
            objects[k] = owners[t]
        elif t >= actors:
            owner = owners[t - (actors - plain)]
            rows[k] = t + to_kept[owner - standing]
            objects[k] = owner
        else:
            low = _instance(t, begins)
            rows[k] = firsts[low] + t - begins[low]
            objects[k] = shared[low]
            which[k] = low


@compiled()
def meet(
    rows, kinds, which, directions, turns, table, own, run, poses, reflectance, retro,
    normals, along, back,
):  # fmt: skip
    """Write unit normals (3, n), their products with directions (3, n), and light sent back.

    Normals in `table` (f, 3), or `own` at `~row` for rows below 0, are turned by
    instances, and by poses (12, m) of each `run`. The light
    is what surfaces send back that are neither textured nor rough, at a distance of 10 m. No view
    of an array is made: it would be counted, which takes five times as long as all the rest.
    """
    for k in range(len(rows)):
        row = rows[k]
        i = which[k]
        kind = kinds[k]
        if row >= 0:
            x = table[row, 0]
            y = table[row, 1]
            z = table[row, 2]
        else:
            x = own[~row, 0]
            y = own[~row, 1]
            z = own[~row, 2]
        x = np.float64(x)
        y = np.float64(y)
        z = np.float64(z)
        if i >= 0:  # in one order of rounding, that of columns.cu
            a = _product(turns[i, 0, 0], turns[i, 0, 1], turns[i, 0, 2], x, y, z)
            b = _product(turns[i, 1, 0], turns[i, 1, 1], turns[i, 1, 2], x, y, z)
            c = _product(turns[i, 2, 0], turns[i, 2, 1], turns[i, 2, 2], x, y, z)
            length = np.sqrt((a * a + b * b) + c * c)
            x = a / length
            y = b / length
            z = c / length
        if len(run) and run[k] >= 0:
            p = run[k]
            x, y, z = (
                _product(poses[3, p], poses[4, p], poses[5, p], x, y, z),
                _product(poses[6, p], poses[7, p], poses[8, p], x, y, z),
                _product(poses[9, p], poses[10, p], poses[11, p], x, y, z),
            )
        cosine = _product(x, y, z, directions[0, k], directions[1, k], directions[2, k])
        normals[0, k] = x
        normals[1, k] = y
        normals[2, k] = z
        along[k] = cosine
        back[k] = reflectance[kind] * (RETRO_GAIN if retro[kind] else abs(cosine))


@inlined
def at_right_angles(distance, extinction):
    """As `materials.at_right_angles`, of one distance."""
    far = max(distance, NEAREST_M)
    nearer = REFERENCE_M / far
    nearer = nearer * nearer
    return nearer * exp(-2 * extinction * far) if extinction else nearer


@compiled()
def fade(distance, extinction, energy):
    """Multiply energies by what `at_right_angles` says of distances."""
    for k in range(len(energy)):
        energy[k] *= at_right_angles(distance[k], extinction)


@compiled()
def soak(up, along, kinds, dry, shares, level, wet, film, back):
    """Mark where there may be water, and multiply the light sent back by what is below it.

    It is where z of the normals `up`, of the side that is seen, is at least `level`, but on kinds
    of surfaces that are `dry`; `shares` of light are scattered.
    """
    for k in range(len(up)):
        upright = up[k] if along[k] < 0 else -up[k]
        film[k] = upright >= level and not dry[kinds[k]]
        if film[k]:
            mirrored = fresnel(abs(along[k]), WATER_INDEX)
            back[k] *= 1 - wet * (1 - within_water(mirrored, shares[k]))


@compiled()
def onward(
    on, off, kinds, along, shares, wet, film, before, distance, specular, passes, straight, leafy,
    brightest, extinction, faintest, share,
):  # fmt: skip
    """Find what light goes on from rows `on` of hits, through surfaces or `off` them.

    Where light is not `straight`, it is refracted: what a surface mirrors is then neither taken off
    nor alone. A share `wet` of what has a `film` is below water. Light that can return no more than
    `faintest` is dropped: writes the other rows, and the `share` that is left of that `before`, out
    and back; returns how many.
    """
    count = 0
    for j in range(len(on)):
        k = on[j]
        kind = kinds[k]
        cosine = abs(along[k])
        first = specular[kind]
        grazing = 1 - min(cosine, 1.0)
        square = grazing * grazing
        mirrors = first + (1 - first) * (grazing * (square * square)) if first > 0 else 0.0
        if passes[kind]:
            mirrors = fresnel(cosine, GLASS_INDEX)
        goes = mirrors if off[j] else 1 - mirrors if passes[kind] else 1.0
        goes = goes if straight[kind] else 1.0
        goes *= 1.0 if leafy[kind] else 1 - shares[j]
        if len(film) and film[k]:
            goes = (1 - wet) * goes + wet * fresnel(cosine, WATER_INDEX)
        goes = before[k] * (goes * goes)
        if goes * (brightest * at_right_angles(distance[k], extinction)) > faintest:
            on[count] = k
            off[count] = off[j]
            share[count] = goes
            count += 1
    return count


@compiled()
def set_off(origins, directions, step, away, starts, ahead):
    """Write where light starts `away` from its ends, and make its directions units; all (3, n)."""
    for k in range(len(step)):
        for axis in range(3):
            end = origins[axis, k] + step[k] * directions[axis, k]
            starts[axis, k] = end + away[k] * ahead[axis, k]
        x = ahead[0, k]
        y = ahead[1, k]
        z = ahead[2, k]
        if abs((x * x + y * y) + z * z - 1) > UNIT_SLACK:  # as `Pattern` does, for all at a time
            most = max(max(abs(x), abs(y)), abs(z))
            x = x / most
            y = y / most
            z = z / most
            length = np.sqrt((x * x + y * y) + z * z)
            ahead[0, k] = x / length
            ahead[1, k] = y / length
            ahead[2, k] = z / length


@compiled()
def times(ray, start, subrays, begins, delays, out):
    """Write when rays are fired, of which `subrays` are of a beam, from beam `start` on."""
    low = 0
    firing = -1
    each = len(delays)
    for k in range(len(ray)):  # they follow each other
        beam = start + ray[k] // subrays
        if firing < 0 or not low <= beam < low + each:
            firing = int(beam // each)
            low = firing * each
        out[k] = begins[firing] + delays[beam - low]


@compiled()
def merge(
    ray, triangle, nearest, body, instance, on_body, parts, shape, firsts, out, out_m, out_triangle
):
    """Write hits in the order of rays, those on bodies in place of others; returns how many.

    `nearest` and those after it are as of `raybeam.crossing.Nearest`, of all rays; triangles of
    bodies begin at `firsts`, and those of their `parts` from there, by `shape`.
    """
    i = 0
    count = 0
    for k in range(len(body)):
        own = body[k]
        hit = i < len(ray) and ray[i] == k
        if own >= 0:
            out_triangle[count] = on_body[k] + parts[shape[own], instance[k]] + firsts[own]
        elif hit:
            out_triangle[count] = triangle[i]
        i += int(hit)
        if hit or own >= 0:
            out[count] = k
            out_m[count] = nearest[k]
            count += 1
    return count


@compiled()
def runs(number, times, first, run):
    """Write for each actor's time its run, and the first of each; returns how many runs.

    In a run, actors and times are equal; numbers below 0 are in none.
    """
    count = 0
    last = -1
    for k in range(len(number)):
        run[k] = -1
        if number[k] < 0:
            continue
        if last < 0 or number[k] != number[last] or times[k] != times[last]:
            first[count] = k
            count += 1
        run[k] = count - 1
        last = k
    return count


@compiled()
def on_tracks(
    number, times_ns, member, first, count, limits, times, start, speed, turn, rates, out
):
    """Write poses (12, n) on straight tracks, with the operations of `Track.poses`.

    Returns the first row whose time is not within its track, or -1; leaves other ways out.
    """
    for k in range(len(number)):
        way = member[number[k]]
        if way < 0:
            continue
        if k and number[k] == number[k - 1] and times_ns[k] == times_ns[k - 1]:
            for part in range(12):
                out[part, k] = out[part, k - 1]
            continue
        at = times_ns[k] / 1e9 + limits[0, way]
        low = limits[1, way]
        high = limits[2, way]
        strict = limits[3, way]
        if max(low - at, at - high) > strict:
            return k
        if strict == np.inf:
            at = min(max(at, low), high)
        # the last that has begun, by halves
        segment = first[way]
        room = count[way] - 1
        while room:
            half = (room + 1) // 2
            if times[segment + half] <= at:
                segment = segment + half
                room = room - half
            else:
                room = half - 1
        since = at - times[segment]
        for axis in range(3):
            out[axis, k] = speed[axis, segment] * since + start[axis, segment]
        sine, cosine = sin_cos(since * rates[segment])
        for part in range(9):
            out[3 + part, k] = (
                turn[0, part, segment] + sine * turn[1, part, segment]
            ) + cosine * turn[2, part, segment]
    return -1
