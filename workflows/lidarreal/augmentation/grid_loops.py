"""Compiled loops that arrange the returns of a sweep in a grid of firings and channels."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidarsim.numerics.arrays import Bools, Floats, Ints
from raybeam.compiled import compiled, inlined

SECTORS = 360  # azimuth sectors, in which all rings may be empty
_SAME_PULSE_RAD = 1e-4  # maximum angle between the returns of a pulse
_TURN = 2 * np.pi


class ChannelTables(NamedTuple):
    """Properties of the c channels of a sensor."""

    sin_elevation: Floats
    cos_elevation: Floats
    offset_rad: Floats  # azimuth relative to the firing
    stride: Ints  # number of firings from one pulse to the next
    residue: Ints  # first firing with a pulse
    in_view: Bools  # (c, SECTORS)


class SweepRotation(NamedTuple):
    """SweepRotation of the sensor during a sweep."""

    sign: float  # 1 for a counterclockwise rotation, otherwise -1
    step_rad: float  # azimuth between firings
    phase_rad: float  # rotation from azimuth 0 at firing 0
    firings: int


class SweepReturns(NamedTuple):
    """Returns of a sweep. All arrays have n rows."""

    points: Floats  # (n, 3): meters
    azimuth: Floats
    range_m: Floats
    channel: Ints  # -1 if it is unknown


class GridReturns(NamedTuple):
    """Output arrays for returns that are sorted by cell and range."""

    firing: Ints  # (n,): in the order of the sweep
    cell: Ints  # (n,)
    order: Ints  # (n,): rows of the returns in the sweep


@compiled()
def locate_returns(returns, tables, rotation, has_several, output):  # noqa: C901, PLR0914, PLR0915 - a compiled loop
    """Assign returns to firings, and sort them by cell and range.

    A channel fires every `stride` firings. Each return gets a pulse of its own, unless
    `has_several` is true and another return has the same azimuth. A return whose firing is occupied
    gets the next free firing of its channel, or an additional firing at the end. Returns the number
    of additional firings.
    """
    channels = len(tables.stride)
    firings = rotation.firings
    count = len(returns.channel)
    occupied = np.full(firings * channels, -1, np.int64)
    extra_of = np.zeros(channels, np.int64)
    extra = 0
    for k in range(count):
        ring = returns.channel[k]
        chosen = -1
        if ring >= 0:
            step = tables.stride[ring]
            turn = rotation.sign * (returns.azimuth[k] - tables.offset_rad[ring])
            position = (turn - rotation.phase_rad) / rotation.step_rad
            exact = (position - tables.residue[ring]) / step
            nearest = int(np.rint(exact))
            side = 1 if exact >= nearest else -1
            for attempt in range(3):
                shift = 0 if attempt == 0 else (side if attempt == 1 else -side)
                firing = tables.residue[ring] + (nearest + shift) * step
                while firing < 0:  # faster than the modulo
                    firing += firings
                while firing >= firings:
                    firing -= firings
                other = occupied[firing * channels + ring]
                if other < 0 or (
                    has_several
                    and attempt == 0
                    and abs(returns.azimuth[other] - returns.azimuth[k]) < _SAME_PULSE_RAD
                    and returns.range_m[other] != returns.range_m[k]
                ):
                    chosen = firing
                    break
        if chosen < 0:
            row = max(ring, 0)
            chosen = firings + extra_of[row]
            extra_of[row] += 1
            extra = max(extra, extra_of[row])
        else:
            occupied[chosen * channels + ring] = k
        output.firing[k] = chosen
    starts = np.zeros((firings + extra) * channels + 1, np.int64)
    for k in range(count):
        starts[output.firing[k] * channels + max(returns.channel[k], 0) + 1] += 1
    for cell in range(1, len(starts)):
        starts[cell] += starts[cell - 1]
    filled = np.zeros(len(starts), np.int64)
    for k in range(count):
        cell = output.firing[k] * channels + max(returns.channel[k], 0)
        index = starts[cell] + filled[cell]
        range_m = returns.range_m[k]
        while index > starts[cell] and returns.range_m[output.order[index - 1]] > range_m:
            output.order[index] = output.order[index - 1]
            index -= 1
        output.order[index] = k
        output.cell[starts[cell] + filled[cell]] = cell
        filled[cell] += 1
    return extra


@compiled()
def mark_fired(returns, tables, rotation, min_rings, grid, fired):
    """Mark the pulses that were fired.

    A pulse was fired if it has a return, or if its channel can receive returns from its sector of
    azimuth, and at least `min_rings` channels have returns in this sector of the sweep. `fired` (f,
    c) is written.
    """
    channels = len(tables.stride)
    returned = np.zeros((channels, SECTORS), np.bool_)
    for k in range(len(returns.channel)):
        if returns.channel[k] >= 0:
            sector = int(np.floor(returns.azimuth[k] * (SECTORS / _TURN))) % SECTORS
            returned[returns.channel[k], sector] = True
    for sector in range(SECTORS):
        rings = 0
        for ring in range(channels):
            rings += returned[ring, sector]
        for ring in range(channels):
            is_in_view = tables.in_view[ring, sector] or returned[ring, sector]
            returned[ring, sector] = is_in_view and rings >= min_rings
    for firing in range(len(fired)):
        azimuth = rotation.sign * (firing * rotation.step_rad + rotation.phase_rad)
        for ring in range(channels):
            pulse_azimuth = azimuth + tables.offset_rad[ring]
            sector = int(np.floor(pulse_azimuth * (SECTORS / _TURN))) % SECTORS
            stride = tables.stride[ring]
            fired[firing, ring] = (
                returned[ring, sector]
                and firing < rotation.firings
                and (stride == 1 or (firing - tables.residue[ring]) % stride == 0)
            )
    pulses = fired.reshape(-1)
    for k in range(len(grid.cell)):
        pulses[grid.cell[k]] = True


@compiled()
def aim_pulses(ray, returns, tables, grid, firing_sines, directions):
    """Write the directions of pulses.

    A pulse with returns points to the farthest one. `ray` (k,) are the cells of the pulses,
    `firing_sines` (2, f) the sines and cosines of the azimuths of firings, and `directions` (k, 3)
    is written.
    """
    channels = len(tables.stride)
    last = np.full(firing_sines.shape[1] * channels, -1, np.int64)
    for k in range(len(grid.cell)):
        last[grid.cell[k]] = grid.order[k]
    offset_sines = np.empty((2, channels))
    for ring in range(channels):
        offset_sines[0, ring] = np.sin(tables.offset_rad[ring])
        offset_sines[1, ring] = np.cos(tables.offset_rad[ring])
    for k in range(len(ray)):
        row = last[ray[k]]
        if row >= 0:
            for axis in range(3):
                directions[k, axis] = returns.points[row, axis] / returns.range_m[row]
        else:
            firing = ray[k] // channels
            ring = ray[k] - firing * channels
            sine = firing_sines[0, firing]
            cosine = firing_sines[1, firing]
            level = tables.cos_elevation[ring]
            sine_of = offset_sines[0, ring]
            cosine_of = offset_sines[1, ring]
            directions[k, 0] = level * (cosine * cosine_of - sine * sine_of)
            directions[k, 1] = level * (sine * cosine_of + cosine * sine_of)
            directions[k, 2] = tables.sin_elevation[ring]


@inlined
def _return_of_other_channel(ray, firsts, lasts, cell, shape):
    """Return the closest return of the closest channels, if the channel of a ray has no returns.

    `firsts` and `lasts` (c,) are the first and last return of each channel, or -1.
    """
    firings, channels = shape
    lower = ray % channels
    upper = lower
    while lower >= 0 and lasts[lower] < 0:
        lower -= 1
    while upper < channels and firsts[upper] < 0:
        upper += 1
    if lower < 0 or upper == channels:
        return firsts[upper] if lower < 0 else lasts[lower]
    # A channel is farther away than any return of the next channel.
    after = (upper - ray % channels) * 3 * firings + cell[firsts[upper]] // channels
    before = (ray % channels - lower) * 3 * firings - cell[lasts[lower]] // channels
    firing = ray // channels
    return lasts[lower] if before + firing <= after - firing else firsts[upper]


@compiled()
def sort_points(ray, source, cell, row, shape, nearest, order):  # noqa: C901, PLR0915 - a compiled loop
    """Sort points by the row of a recorded return that serves as their template.

    The template of a recorded return is itself. That of an added return is the recorded return of
    the same channel that is closest in time. Added returns follow their template.

    Parameters
    ----------
    ray, source
        (m,): rays of the returns in ascending order, and recorded return of each, or -1.
    cell, row
        (n,): cells of the recorded returns in ascending order, and their rows in the sweep.
    shape
        Number of firings and channels.
    nearest, order
        (m,): recorded return that is the template of each point, and return of each point.
    """
    channels = shape[1]
    count = len(ray)
    channel = np.empty(len(cell), np.int64)
    begin = 0  # first cell of the firing, which saves divisions
    for k in range(len(cell)):
        while cell[k] >= begin + channels:
            begin += channels
        channel[k] = cell[k] - begin
    template = np.empty(count, np.int64)
    lasts = np.full(channels, -1, np.int64)  # last return of each channel before a ray
    k = 0
    for index in range(count):
        template[index] = source[index]
        if source[index] < 0:
            while k < len(cell) and cell[k] < ray[index]:
                lasts[channel[k]] = k
                k += 1
            template[index] = lasts[ray[index] % channels]
    while k < len(cell):
        lasts[channel[k]] = k
        k += 1
    firsts = np.full(channels, -1, np.int64)  # first return of each channel from a ray on
    k = len(cell) - 1
    for index in range(count - 1, -1, -1):
        if source[index] < 0:
            while k >= 0 and cell[k] >= ray[index]:
                firsts[channel[k]] = k
                k -= 1
            before = template[index]
            after = firsts[ray[index] % channels]
            if before < 0 or (after >= 0 and cell[after] - ray[index] < ray[index] - cell[before]):
                template[index] = after
    while k >= 0:
        firsts[channel[k]] = k
        k -= 1
    starts = np.zeros(2 * row.max() + 4, np.int64)
    for index in range(count):
        if template[index] < 0:
            template[index] = _return_of_other_channel(ray[index], firsts, lasts, cell, shape)
        starts[2 * row[template[index]] + int(source[index] < 0) + 1] += 1
    for key in range(1, len(starts)):
        starts[key] += starts[key - 1]
    for index in range(count):
        key = 2 * row[template[index]] + int(source[index] < 0)
        order[starts[key]] = index
        nearest[starts[key]] = template[index]
        starts[key] += 1
