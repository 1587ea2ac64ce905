"""Loops over pulses: particles and spray that they meet, and the returns that a receiver reports.

Each is compiled when it is first called. Random numbers are those of `lidarsim.sensor.noise.raw`,
of which `starts` are the beginnings.
"""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from raybeam.compiled import compiled, inlined, stage

from ..base.elementary_loops import exp

ALL, FIRST, LAST, STRONGEST, DUAL = range(5)  # modes
_GUIDE = 1024  # parts of a table in which a column is looked up
_CLUMPS = 255  # of spray that a beam meets at most: a ray has so many random numbers
SLOPE = 0.5  # of the distance between neighbouring hits: what the slopes of one surface may miss

_30, _27, _31, _11, _48 = (np.uint64(shift) for shift in (30, 27, 31, 11, 48))
_ONE, _OTHER = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_GAMMA, _NUMBERS, _NEXT = np.uint64(0x9E3779B97F4A7C15), np.uint64(256), np.uint64(1)


@inlined
def _mixed(x):
    """As `noise._mixed`, of one number."""
    x = (x ^ (x >> _30)) * _ONE
    x = (x ^ (x >> _27)) * _OTHER
    return x ^ (x >> _31)


@inlined
def _bits(start, scan, ray, number):
    """64 random bits."""
    begin = _mixed(start + np.uint64(scan) * _GAMMA)
    return _mixed(begin + (np.uint64(ray) * _NUMBERS + np.uint64(number) + _NEXT) * _GAMMA)


@inlined
def _uniform(start, scan, ray, number):
    return np.float64(_bits(start, scan, ray, number) >> _11) * 2.0**-53


@inlined
def _beam(ray, each):
    return ray if each == 1 else ray // each  # a division takes as long as all else


@inlined
def _scan_of(begins, ray, scan):
    """Row of the scan of a ray, from that of a ray before."""
    while scan + 1 < len(begins) and begins[scan + 1] <= ray:
        scan += 1
    return scan


@compiled()
def particles(
    beam, stop, each, step, counts, tables, exponential,
    starts, scan, begins, first, reach, ray, distance, energy,
):  # fmt: skip
    """Draw the particles of a kind that beams meet, from one on, while there is room for them.

    `counts` are cumulative probabilities of numbers of particles; rows of `tables` are distance,
    smallest diameter, range of ranks, energy of 1 mm, and most. Writes sub-rays, distances and
    energies; returns the first beam that is left, and how many were written.
    """
    count, row = 0, 0
    while beam < stop and count + len(counts) <= len(ray):
        row = _scan_of(begins, first + beam, row)
        own, number = scan + row, first + beam - begins[row]
        chance, particle = _uniform(starts[0], own, number, 0), 0
        while counts[particle] <= chance:  # the last is 1
            place = np.int64(_bits(starts[1], own, number, particle) >> _48)
            where = beam * each
            if each > 1:
                where += np.int64(_bits(starts[2], own, number, particle) % np.uint64(each))
            if tables[0, place] < reach[where]:
                rank = _uniform(starts[3], own, number, particle) * tables[2, place]
                longer = step * exponential[np.int64(rank * len(exponential))]
                diameter = tables[1, place] + longer
                ray[count], distance[count] = where, tables[0, place]
                light = tables[3, place] * diameter * diameter
                energy[count] = each * min(light, tables[4, place])
                count += 1
            particle += 1
        beam += 1
    return beam, count


@compiled()
def fog(
    each, begin_m, end_m, cell_m, energies, peaks,
    starts, scan, begins, first, reach, ray, distance, energy,
):  # fmt: skip
    """Draw the peaks of fog in beams; writes as `particles` does, returns how many."""
    count, row, cells = 0, 0, len(energies)
    for beam in range(len(reach) // each):
        free = (min(reach[beam * each], end_m) - begin_m) / cell_m
        if not free >= 1:
            continue
        whole = cells if free >= cells else np.int64(free)
        row = _scan_of(begins, first + beam, row)
        own, number = scan + row, first + beam - begins[row]
        chance = whole + _uniform(starts[0], own, number, 0)
        low, high = 0, cells  # the cell, by halves
        while low < high:
            middle = (low + high) // 2
            if peaks[whole * cells + middle] <= chance:
                low = middle + 1
            else:
                high = middle
        place = _uniform(starts[1], own, number, 0)
        ray[count], distance[count] = beam * each, begin_m + (low + place) * cell_m
        energy[count] = each * energies[low]
        count += 1
    return count


@compiled()
def crossings(
    rays, times, far, size, cell, which, boxes, there, density, lasts, decay, beam, found
):
    """Write beams, and where each enters and leaves a box and the density in it, (3, k).

    Beams end at `far` (n,). Cells of `size` rays (6, n) and boxes are as of
    `raybeam.moving.near_boxes`, in the order of cells; boxes last so long, and densities decay by
    their age over `decay`. Returns how many there are, of which it writes what there is room for.
    """
    count, begin, radii = 0, 0, np.zeros(len(boxes))
    for b in range(len(boxes)):
        for side in range(3, 12):
            radii[b] += boxes[b, side] * boxes[b, side]
        radii[b] = 1.001 * np.sqrt(radii[b])
    while begin < len(cell):
        end = begin
        while end < len(cell) and cell[end] == cell[begin]:
            end += 1
        for k in range(cell[begin] * size, min((cell[begin] + 1) * size, len(times))):
            u, v, w, time = rays[3, k], rays[4, k], rays[5, k], times[k]
            for pair in range(begin, end):
                b = which[pair]
                p, q, r = (
                    boxes[b, 0] - rays[0, k],
                    boxes[b, 1] - rays[1, k],
                    boxes[b, 2] - rays[2, k],
                )
                along, reach = (p * u + q * v) + r * w, radii[b]
                off = (p * p + q * q) + r * r - along * along
                if off > reach * reach or along > far[k] + reach:
                    continue  # it misses the ball around the box
                if not there[b, 0] <= time <= there[b, 1]:
                    continue
                low, high = 0.0, far[k]
                for side in range(3, 12, 3):
                    x, y, z = boxes[b, side], boxes[b, side + 1], boxes[b, side + 2]
                    half = (x * x + y * y) + z * z
                    along = (x * u + y * v) + z * w
                    off = (x * p + y * q) + z * r
                    if along != 0:
                        one, other = (off - half) / along, (off + half) / along
                        low, high = max(low, min(one, other)), min(high, max(one, other))
                    elif abs(off) > half:
                        high = -1.0
                if low < high:
                    if count < len(beam):
                        beam[count], found[0, count], found[1, count] = k, low, high
                        found[2, count] = density[b] * exp((there[b, 1] - lasts - time) / decay)
                    count += 1
        begin = end
    return count


@stage
def _column(places, guide, width, place):
    """Find the first column that is not below a place; numba's search takes long to compile."""
    column = guide[np.int64(min(place / width, _GUIDE))]
    while column < len(places) and places[column] < place:
        column += 1
    return column


@compiled()
def spray(
    k, beam, crossed, each, mean, step, tables, exponential,
    starts, scan, begins, first, reach, ray, distance, energy,
):  # fmt: skip
    """Draw the clumps of spray that beams meet in boxes, from crossing `k` on, while there is room.

    Crossings (3, k) of a beam follow each other. Depths between clumps are exponential; `mean` is
    how many a beam would meet at a density of 1, of which each column of `tables` has an equal
    share. Writes as `particles` does; returns the first crossing left, and how many.
    """
    count, row, places, guide = 0, 0, tables[0], np.zeros(_GUIDE + 4, np.int64)
    width, share = places[-1] / _GUIDE, mean / len(places)
    for part in range(1, len(guide)):
        guide[part] = _column(places, guide[part - 1 :], np.inf, width * (part - 1))
    while k < len(beam) and count + _CLUMPS <= len(ray):
        this = beam[k]
        row = _scan_of(begins, first + this, row if begins[row] <= first + this else 0)
        own, number, clump = scan + row, first + this - begins[row], 0
        left = exponential[np.int64(_bits(starts[0], own, number, 0) >> _48)]
        begin, most = k, 0.0
        while k < len(beam) and beam[k] == this:  # most beams meet too little, by a rough bound
            near, ends = min(crossed[0, k] / width, _GUIDE), min(crossed[1, k] / width, _GUIDE)
            most += crossed[2, k] * (guide[np.int64(ends) + 3] - guide[np.int64(near)])
            k += 1
        if left > 1.001 * most * share:
            continue
        k = begin
        while k < len(beam) and beam[k] == this:
            rate, end = crossed[2, k] * share, _column(places, guide, width, crossed[1, k])
            place = np.float64(_column(places, guide, width, crossed[0, k]))
            while left < (end - place) * rate and clump < _CLUMPS:
                place += left / rate
                at = np.int64(place)
                where = this * each
                if each > 1:
                    where += np.int64(_bits(starts[1], own, number, clump) % np.uint64(each))
                if places[at] < reach[where]:
                    rank = _uniform(starts[2], own, number, clump) * tables[2, at]
                    diameter = tables[1, at] + step * exponential[np.int64(rank * len(exponential))]
                    ray[count], distance[count] = where, places[at]
                    energy[count] = each * min(tables[3, at] * diameter * diameter, tables[4, at])
                    count += 1
                clump += 1
                left = exponential[np.int64(_bits(starts[0], own, number, clump) >> _48)]
            left -= (end - place) * rate
            k += 1
    return k, count


@compiled()
def veil(beam, crossed, each, extinction, reach, ray, distance, energy):
    """Multiply energies of hits by what spray before them leaves."""
    first = np.full(len(reach) // each, len(beam))  # of each beam
    for c in range(len(beam)):
        first[beam[c]] = min(c, first[beam[c]])
    for k in range(len(ray)):
        this, depth = _beam(ray[k], each), 0.0
        c = first[this]
        while c < len(beam) and beam[c] == this:
            end = min(min(distance[k], reach[ray[k]]), crossed[1, c])
            depth += crossed[2, c] * max(end - crossed[0, c], 0.0)
            c += 1
        if depth > 0:
            energy[k] *= exp(-2 * extinction * depth)


@inlined
def _half_way(this, that, near, normals, directions):
    """Range half-way to another hit, on the plane of the first."""
    x, y, z = normals[0, this], normals[1, this], normals[2, this]
    there = x * directions[0, that] + y * directions[1, that] + z * directions[2, that]
    here = x * directions[0, this] + y * directions[1, this] + z * directions[2, this]
    most = 1 + there / here
    if most < 1e-9:  # and not if it is unknown
        most = 1e-9
    return 2 / (near * most)


@stage
def _joined(
    begin, stop, new, still, ray, distance, solid, row, gap_m, each, pairs, normals, directions,
    table, changes,
):  # fmt: skip
    """Unmark in `still` where a surface of a beam continues, by returns that begin at `new`.

    Two neighbouring sub-rays hit one surface if the planes through the two hits meet half-way
    between them, within the gap or half of the distance between the hits. The inverse range of a
    plane is linear in the ray's direction, so two hits on one plane always meet, whatever the
    angle; half of the distance allows for rough ground. Returns are in the order of distances.
    """
    count = stop - begin
    panes = 0
    for k in range(count * each):
        table[k] = -1
    for k in range(begin, stop):  # the hit of each sub-ray, after so many panes of glass
        changes[k - begin] = 0
        if solid[k]:
            pane = 0
            while table[pane * each + ray[k] % each] >= 0:
                pane += 1
            table[pane * each + ray[k] % each] = k
            panes = max(panes, pane + 1)
    changes[count] = 0
    which = begin
    for k in range(begin, stop):  # the return of each hit
        if new[k]:
            which = k
        row[k, 1] = which
    for pane in range(panes):
        for pair in range(len(pairs)):
            one = table[pane * each + pairs[pair, 0]]
            other = table[pane * each + pairs[pair, 1]]
            if one < 0 or other < 0 or row[one, 1] == row[other, 1]:
                continue
            i, j = row[one, 0], row[other, 0]
            here = _half_way(i, j, 1 / distance[one], normals, directions)
            there = _half_way(j, i, 1 / distance[other], normals, directions)
            apart = abs(distance[one] - distance[other])
            if abs(here - there) <= max(gap_m, SLOPE * apart):
                changes[min(one, other) + 1 - begin] += 1
                changes[max(one, other) + 1 - begin] -= 1
    inside = 0
    for k in range(begin, stop):
        inside += changes[k - begin]
        if inside > 0:
            still[k] = False


@stage
def _mark(energy, begin, stop, mode, there):
    """Mark what a mode reports of the returns of a pulse; of equally strong ones the nearest."""
    best, second = begin, -1
    for k in range(begin + 1, stop):
        if energy[k] > energy[best]:
            best = k
    if mode == DUAL and best == stop - 1:
        for k in range(begin, stop - 1):
            if second < 0 or energy[k] > energy[second]:
                second = k
    for k in range(begin, stop):
        there[k] = mode == ALL or k == second
    there[begin] |= mode == FIRST
    there[stop - 1] |= mode in (LAST, DUAL)
    there[best] |= mode in (STRONGEST, DUAL)


@compiled()
def reported(ray, energy, mode, there):
    """Mark what a mode reports of returns."""
    begin = 0
    while begin < len(ray):
        stop = begin + 1
        while stop < len(ray) and ray[stop] == ray[begin]:
            stop += 1
        _mark(energy, begin, stop, mode, there)
        begin = stop


@compiled()
def filled(ray, full, height, front, back, distance, energy, there):
    """Join the returns of a pulse that overlap if one of them is full; marks those that are left.

    `front` and `back` (n,) are edges of pulses. Of joined returns the highest is left, with the
    energy of all, and with the edges and the least distance of the full ones, which are written.
    """
    begin = 0
    for k in range(len(ray)):
        if ray[k] != ray[begin]:
            begin = k
        there[k], last = True, k
        for j in range(k - 1, begin - 1, -1):
            if not (there[j] and (full[j] or full[last]) and back[j] >= front[last]):
                continue
            last, gone = (j, last) if height[j] >= height[last] else (last, j)
            there[gone] = False
            energy[last] += energy[gone]
            if full[gone]:
                front[last] = min(front[last], front[gone])
                back[last] = max(back[last], back[gone])
                distance[last] = min(distance[last], distance[gone])


@compiled()
def counted(ray, begins, every, counts, rows, number, returns):
    """Count the returns of scans, which begin at some rays, and write those that are kept.

    Of these it writes the rows, the numbers in their pulses from 1, and how many a pulse has, at
    most 255; returns how many are kept.
    """
    count, scan, begin, stop = 0, 0, 0, 0
    for k in range(len(ray)):
        if k == stop:
            begin, scan = k, _scan_of(begins, ray[k], scan)
            while stop < len(ray) and ray[stop] == ray[begin]:
                stop += 1
        if every == 1 or counts[scan] % every == 0:
            rows[count], number[count] = k, min(k + 1 - begin, 255)
            returns[count] = min(stop - begin, 255)
            count += 1
        counts[scan] += 1
    return count


@compiled()
def left(ray, times, spans, firing, channel, rows):
    """Write rows of returns that no fault takes, of firings or channels; returns how many.

    Faults are there for `spans` (f, 2) of times. They take returns of some firings, (f, firings),
    and channels, (f, channels).
    """
    count, number, begin, each = 0, 0, 0, channel.shape[1]
    for k in range(len(ray)):
        while ray[k] >= begin + each:  # they follow each other
            number, begin = number + 1, begin + each
        rows[count], gone = k, False
        for f in range(len(spans)):
            if spans[f, 0] <= times[k] < spans[f, 1]:
                gone |= firing[f, number] or channel[f, ray[k] - begin]
        count += int(not gone)
    return count


@stage
def _most(ray, each):
    """Return how many hits a beam has at most."""
    most, begin, end = 0, 0, -1
    for k in range(len(ray)):
        if ray[k] >= end:
            begin, end = k, (_beam(ray[k], each) + 1) * each
        most = max(most, k + 1 - begin)
    return most


@stage
def _room(size, each):
    """Make scratch memory for hits of a beam."""
    numbers, flags = np.int64, np.bool_
    return (
        np.empty((size, 2), numbers), np.empty(size, numbers),
        np.empty(size), np.empty(size), np.empty(size),
        np.empty(size, flags), np.empty(size, flags), np.empty(size, flags),
        np.empty(size * each, numbers), np.empty(size + 1, numbers),
    )  # fmt: skip


@inlined
def _kept(whole, real, k, count):
    """Keep a return as the last of so many; returns how many there are then."""
    whole[0, count], whole[1, count] = whole[0, k], whole[1, k]
    real[0, count], real[1, count], real[2, count] = real[0, k], real[1, k], real[2, k]
    return count + 1


@compiled()
def returns(
    each, gap_m, mode, ray, distance, energy, solid,
    velocity, air_ray, air_distance, air_energy, air_velocity, pairs,
    normals, directions, dropout, threshold, sigmas, starts, quantiles,
    scan, begins, first, whole, real,
):  # fmt: skip
    """Make the returns of beams, see `separation.separated`; returns how many there are.

    Hits of surfaces and of the air are in the order of sub-rays. Writes beams and rows of the
    strongest hits to `whole` (2, k), those of the air as -1, -2, …, and distances, energies and
    velocities to `real` (3, k).
    """
    i, j, count, number_row, moves = 0, 0, 0, 0, len(velocity) + len(air_velocity) > 0
    size = _most(ray, each) + _most(air_ray, each)
    own, sub, far, light, speed, hard, new, there, table, changes = _room(size, each)
    while i < len(ray) or j < len(air_ray):
        beam = _beam(ray[i] if i < len(ray) else air_ray[j], each)
        if j < len(air_ray):
            beam = min(beam, _beam(air_ray[j], each))
        end = (beam + 1) * each
        last, last_air = i, j
        while last < len(ray) and ray[last] < end:
            last += 1
        while last_air < len(air_ray) and air_ray[last_air] < end:
            last_air += 1
        begin, n, least, most, best = count, 0, np.inf, -np.inf, i
        sum_, mean, drift = 0.0, 0.0, 0.0
        for k in range(i, last):
            if energy[k] > 0:
                least, most = min(least, distance[k]), max(most, distance[k])
                sum_ += energy[k]
                mean += energy[k] * distance[k]
                if moves:
                    drift += energy[k] * velocity[k]
                if n == 0 or energy[k] > energy[best]:
                    best = k
                n += 1
        if j == last_air and most - least <= gap_m:  # most beams meet one surface, and no air
            i = last
            if n == 0:
                continue
            whole[0, count], whole[1, count] = beam, best
            real[0, count], real[1, count] = mean / sum_, sum_ / each
            if moves:
                real[2, count] = drift / sum_
            count += 1
        else:
            n, least, most = 0, np.inf, -np.inf
            while i < last or j < last_air:  # what is in the air first
                if j < last_air and (i == last or air_ray[j] <= ray[i]):
                    own[n, 0], far[n], light[n] = -1 - j, air_distance[j], air_energy[j]
                    j += 1
                else:
                    own[n, 0], far[n], light[n] = i, distance[i], energy[i]
                    i += 1
                if light[n] > 0:
                    least, most = min(least, far[n]), max(most, far[n])
                    n += 1
            if n == 0:
                continue
            apart, several, surface, number = most - least > gap_m, False, -1, 0
            for k in range(1, n if apart else 0):  # few beams hit an edge or graze a surface
                a, b, place = own[k, 0], far[k], k
                while place > 0 and far[place - 1] > b:
                    own[place, 0], far[place] = own[place - 1, 0], far[place - 1]
                    place -= 1
                own[place, 0], far[place] = a, b
            for k in range(n):
                row = own[k, 0]
                hard[k] = row >= 0 and solid[row]
                sub[k] = ray[row] if row >= 0 else air_ray[-1 - row]
                light[k] = energy[row] if row >= 0 else air_energy[-1 - row]
                if moves:
                    speed[k] = velocity[row] if row >= 0 else air_velocity[-1 - row]
                new[k] = k == 0 or (apart and far[k] - far[k - 1] > gap_m)
                number += int(new[k])
                if hard[k]:  # surfaces can only continue if they are in several returns
                    several |= surface >= 0 and surface != number
                    surface = number
            if several and len(pairs):
                _joined(
                    0, n, new, new, sub, far, hard, own, gap_m, each, pairs, normals, directions,
                    table, changes,
                )  # fmt: skip
            k = 0
            while k < n:  # a return
                best, sum_, mean, drift = k, 0.0, 0.0, 0.0
                while True:
                    sum_ += light[k]
                    mean += light[k] * far[k]
                    if moves:
                        drift += light[k] * speed[k]
                    if light[k] > light[best]:
                        best = k
                    k += 1
                    if k == n or new[k]:
                        break
                whole[0, count], whole[1, count] = beam, own[best, 0]
                real[0, count], real[1, count] = mean / sum_, sum_ / each
                if moves:
                    real[2, count] = drift / sum_
                count += 1
        stop = count
        if len(starts):  # those that are detected
            number_row = _scan_of(begins, first + beam, number_row)
            key, at = scan + number_row, first + beam - begins[number_row]
            count = begin
            for k in range(begin, stop):
                seen = dropout == 0 or _uniform(starts[0], key, at, k - begin) >= dropout
                if seen and threshold > 0:
                    above = sigmas * (real[1, k] / threshold - 1)
                    seen = above + quantiles[0] > 0  # whatever is drawn
                    if not seen and above + quantiles[-1] > 0:
                        drawn = np.int64(_bits(starts[1], key, at, k - begin) >> _48)
                        seen = above + quantiles[drawn] > 0
                if seen:
                    count = _kept(whole, real, k, count)
            stop = count
        if mode != ALL and stop - begin > 1:
            for k in range(begin, stop):
                light[k - begin] = real[1, k]
            _mark(light, 0, stop - begin, mode, there)
            count = begin
            for k in range(begin, stop):
                if there[k - begin]:
                    count = _kept(whole, real, k, count)
    return count
