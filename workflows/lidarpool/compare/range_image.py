"""Range images of two sweeps of one sensor on common cells: rings and steps of azimuth.

Recorded pulses have jitter, a step that does not divide the turn, and a seam, so a fixed grid would
have cells with two pulses or none: the phase of each ring's pulses is found every 10°. Two programs
may number rings in opposite directions: rings are matched by the elevation of their points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarsim.base.arrays import Bools, Floats, Indices, Ints
from lidarsim.base.errors import LidarError
from lidarsim.base.words import plural

from .recordings import RecordedPoints

_TILT_DEG = 1.0  # width of the middle half of a ring's elevations, of rings near each other
_SAME = 0.15  # by how much single steps may differ from their mean
_ALIKE = 0.01  # by how much steps of azimuth may differ that are meant to be the same
_SECTOR_DEG = 90.0  # a gap as wide as this in all rings is outside the field of view
_BLOCKS = 36  # of a turn, in each of which the pulses of a ring are evenly spaced
_AGREE = 0.7  # share of rings from whose numbers the others' follow
_FINEST_DEG = 1e-3  # points nearer in azimuth are of one pulse


@dataclass(frozen=True, eq=False)
class RangeImages:
    """Ranges of two sweeps in the same cells, (rings, columns)."""

    rings: Ints  # (r,): as B numbers them, the highest first
    elevation_deg: Floats  # (r,): medians of the points
    step_deg: float  # width of a column
    start_deg: float  # azimuth of the first
    # (2, 4, r, c): range, intensity, azimuth and elevation, degrees, in A and in B; NaN if unknown
    images: Floats
    hidden_shares: tuple[
        float, float
    ]  # shares of points of A and B that others in their cells hide
    notes: tuple[str, ...]
    row: Ints  # (k,): of all cells, or of all rays that have a return
    compared: Floats  # (2, 2, k): range and intensity of these in A and in B, NaN where unknown
    paired_by: str = "cells"  # or "rays"

    @property
    def ranges(self) -> Floats:
        """Of A and B, (2, r, c) in metres; NaN without a return."""
        return self.images[:, 0]

    @property
    def there(self) -> tuple[Bools, Bools]:
        """Where A and B have returns."""
        return np.isfinite(self.ranges[0]), np.isfinite(self.ranges[1])


@dataclass(frozen=True, eq=False)
class _Polar:
    """A sweep in polar coordinates."""

    azimuth: Floats  # (n,): degrees, 0 to 360
    up: Floats  # (n,): elevations, degrees
    ranges: Floats
    ring: Ints  # (n,): index into `rings`
    light: Floats | None
    rings: Ints  # (r,): numbers
    elevation: Floats  # (r,): medians, degrees

    @classmethod
    def of(cls, turn: RecordedPoints, name: str) -> _Polar:
        """Convert a sweep; LidarError if it has no rings, or they are not around its zero."""
        if turn.rings is None:
            raise LidarError(f"{name} has no rings: the range image needs a column ring or channel")
        x, y, z = turn.points.T
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
        rings, index = np.unique(turn.rings, return_inverse=True)
        order = np.lexsort((elevation, index))
        ends = np.searchsorted(index[order], np.arange(len(rings) + 1))
        sizes = np.diff(ends)
        low, middle, high = (
            elevation[order][ends[:-1] + (share * (sizes - 1)).astype(np.intp)]
            for share in (0.25, 0.5, 0.75)
        )
        if np.median(high - low) > max(_TILT_DEG, _spacing(middle) / 2):
            raise LidarError(
                f"{name} has rings that are no cones around zero, which the range image needs: its "
                "points are in the world's axes, or of several poses, or its sensor has no rings, "
                "as a Livox"
            )
        ranges = np.linalg.norm(turn.points, axis=1)
        azimuth = np.degrees(np.arctan2(y, x)) % 360
        return cls(azimuth, elevation, ranges, index, turn.light, rings, middle)

    def step(self) -> float:
        """Typical step from a pulse to the next of its ring, degrees."""
        order = np.lexsort((self.azimuth, self.ring))
        steps = np.diff(self.azimuth[order])[np.diff(self.ring[order]) == 0]
        steps = steps[steps > _FINEST_DEG]
        if not len(steps):
            return 1.0
        counts, edges = np.histogram(np.log(steps), bins=100)
        found = np.exp(edges[counts.argmax() : counts.argmax() + 2].mean())

        def alike(step: float) -> Floats:
            return steps[np.abs(steps / step - 1) < _SAME]

        for parts in (4, 3, 2):  # where most returns are lost, double steps may be the most
            if len(alike(found / parts)) > len(alike(found)) / 4:
                found /= parts
                break
        for _ in range(10):  # the mean of those that are alike knows more than the bin
            found = alike(found).mean()
        return float(found)

    def phases(self, rows: Ints, count: int, step: float) -> Floats:
        """Where pulses are within a step, in steps: (count, blocks), NaN where there are none."""
        place = rows[self.ring] * _BLOCKS + self._block
        turn = np.exp(2j * np.pi * self.azimuth / step)
        real, imaginary = (
            np.bincount(place, part, count * _BLOCKS) for part in (turn.real, turn.imag)
        )
        none = np.bincount(place, minlength=count * _BLOCKS) == 0
        phases = np.angle(real + 1j * imaginary) / (2 * np.pi)
        return np.where(none, np.nan, phases).reshape(count, _BLOCKS)

    @property
    def _block(self) -> Ints:
        return (self.azimuth * (_BLOCKS / 360)).astype(np.int64).clip(0, _BLOCKS - 1)

    def image(
        self, rows: Ints, phases: Floats, step: float, shape: tuple[int, int]
    ) -> tuple[Floats, float]:
        """Return `RangeImages.images` of one sweep, and the share of points hidden in cells.

        `rows` (r,) are those of its rings, `phases` as the method gives them. Of several points in
        a cell, the one nearest to the middle is taken, and of several returns of a pulse the
        nearest.
        """
        place = self.azimuth / step - phases[rows[self.ring], self._block]
        column = np.round(place)
        off = np.round(np.abs(place - column), 3)
        cell = rows[self.ring] * shape[1] + column.astype(np.int64) % shape[1]
        order = np.lexsort((self.ranges, off, cell))
        chosen = order[np.diff(cell[order], prepend=-1) > 0]
        image = np.full((4, shape[0] * shape[1]), np.nan)
        for row, values in enumerate((self.ranges, self.light, self.azimuth, self.up)):
            if values is not None:
                image[row, cell[chosen]] = values[chosen]
        return image.reshape(4, *shape), 1 - len(chosen) / len(cell)


def range_images(
    a: RecordedPoints, b: RecordedPoints, names: tuple[str, str], azimuth_deg: float | None = None
) -> RangeImages:
    """Put two sweeps of one sensor into the same cells.

    A column is as wide as the step of azimuth from pulse to pulse, the coarser of the two. Each
    ring's cells have their middles where its pulses are, in every 10 degrees, so that
    none falls between two although heads turn unevenly; a pulse of A is in the cell of the pulse of
    B that is nearest. LidarError if one has no rings, is not in the axes of its sensor, or they
    are not of sensors with the same rings; a clause without a full stop.
    """
    first = _Polar.of(a, names[0])
    second = _Polar.of(b, names[1])
    rings, elevation, rows_a, rows_b, notes = _common(first, second, names)
    count = len(rings)
    steps = [first.step(), second.step()]
    alike = abs(steps[0] / steps[1] - 1) < _ALIKE
    step = azimuth_deg or (steps[1] if alike else max(steps))
    phases_a = first.phases(rows_a, count, step)
    phases_b = second.phases(rows_b, count, step)
    own, other = (phases_b, phases_a) if alike or steps[0] < steps[1] else (phases_a, phases_b)
    blocks = np.arange(_BLOCKS)
    middle = np.where(np.isnan(own), other, own)
    for row in middle:  # from block to block as the head turns on
        known = np.flatnonzero(~np.isnan(row))
        row[:] = np.interp(blocks, known, np.unwrap(row[known], period=1))
    apart = phases_a - middle
    for row in apart:
        known = np.flatnonzero(~np.isnan(row))
        if len(known):
            row[known] = np.unwrap(row[known], period=1)
            row -= np.round(np.median(row[known]))
    # Several pulses in a cell have no phase of their own.
    phases_a = middle + apart if alike and abs(step / steps[1] - 1) < _SAME else middle
    columns = max(round(360 / step - float(np.median(middle[:, -1] - middle[:, 0]))), 1)
    shape = count, columns
    image_a, hidden_a = first.image(rows_a, phases_a, step, shape)
    image_b, hidden_b = second.image(rows_b, middle, step, shape)
    images = np.stack([image_a, image_b])
    seen = np.flatnonzero(np.isfinite(images[:, 0]).any(axis=(0, 1)))
    order, begin = _field(seen, columns, step)
    images = images[..., order]
    return RangeImages(
        rings, elevation, step, begin, images, (hidden_a, hidden_b),
        notes, np.repeat(np.arange(count), len(order)), images[:, :2].reshape(2, 2, -1),
    )  # fmt: skip


def paired_images(
    a: RecordedPoints, b: RecordedPoints, names: tuple[str, str], azimuth_deg: float | None = None
) -> RangeImages:
    """Pair the ranges of each ray of two sweeps with the same rays; otherwise as `range_images`.

    Pulses that look into the same cell are often not of the same ray where the sensor moves.
    """
    assert a.rays is not None and b.rays is not None and a.rings is not None and b.rings is not None
    _common(_Polar.of(a, names[0]), _Polar.of(b, names[1]), names)  # refuses another sensor
    _, first, ray = np.unique(np.append(a.rays, b.rays), return_index=True, return_inverse=True)
    values = np.full((2, 3, len(first) + 1), np.nan)  # the last is of no ray
    for k, turn, own in ((0, a, ray[: len(a)]), (1, b, ray[len(a) :])):
        values[k, 0, own] = np.linalg.norm(turn.points, axis=1)
        values[k, 1, own] = np.nan if turn.light is None else turn.light
    points = np.concatenate([a.points, b.points])[first]
    rings = np.append(a.rings, b.rings)[first]
    every = RecordedPoints(points, rings, np.arange(len(first), dtype=np.float64))
    found = range_images(every, every, names, azimuth_deg)
    shown = np.nan_to_num(found.images[0, 1], nan=-1).astype(int)
    row = (rings[:, None] == found.rings).argmax(axis=1)
    images = values[..., shown]
    compared = values[:, :2, :-1]
    return replace(found, images=images, row=row, compared=compared, paired_by="rays")


def _spacing(elevation: Floats) -> float:
    """Typical distance between rings, degrees."""
    apart = np.diff(np.sort(elevation))
    return float(np.median(apart)) if len(apart) else 1.0


def _common(
    a: _Polar, b: _Polar, names: tuple[str, str]
) -> tuple[Ints, Floats, Ints, Ints, tuple[str, ...]]:
    """Put rings of A and B that look at the same elevation into common rows, the highest first.

    Some programs count from below, others from above or from 1: if one count can be had from the
    other, rings of which only A or B has returns have a row, too. Returns the rings as B numbers
    them and their elevations, (r,) each; the rows of each ring of A, and of B; and notes.
    """
    apart = np.abs(a.elevation[:, None] - b.elevation)
    near = max(_spacing(b.elevation) / 2, 0.05)
    of_a = apart.argmin(axis=0)
    of_b = np.flatnonzero(apart[of_a].argmin(axis=1) == np.arange(len(b.rings)))
    of_a = of_a[of_b]
    notes = []
    for sign in (1, -1):
        zero = int(np.median(b.rings[of_b] - sign * a.rings[of_a]))
        numbers = sign * a.rings + zero
        if np.mean(np.abs(numbers[of_a] - b.rings[of_b]) <= 1) >= _AGREE:
            if sign < 0 or zero:
                other = f"n {'+-'[zero < 0]} {abs(zero)}" if sign > 0 else f"{zero} - n"
                notes.append(f"ring n of A is ring {other} of B")
            break
    else:
        there = apart[of_a, of_b] <= near
        numbers = -1 - np.arange(len(a.rings))
        numbers[of_a[there]] = b.rings[of_b[there]]
        notes.append("the rings are numbered in other orders, and matched by elevation")
    if (alone := len(np.setxor1d(numbers, b.rings))) > 0:
        notes.append(f"only one of the two has returns of {plural(alone, 'ring')}")
    rings, first = np.unique(np.append(b.rings, numbers), return_index=True)
    elevation = np.append(b.elevation, a.elevation)[first]
    both, in_a, in_b = np.intersect1d(numbers, b.rings, return_indices=True)
    off = np.abs(a.elevation[in_a] - b.elevation[in_b])
    if len(both) < min(len(a.rings), len(b.rings)) / 2 or np.median(off) > 2 * near:
        raise LidarError(
            f"the rings of {names[0]} look at {a.elevation.min():.1f}° to {a.elevation.max():.1f}° "
            f"and those of {names[1]} at {b.elevation.min():.1f}° to {b.elevation.max():.1f}°, at "
            "other angles: they are not of the same sensor"
        )
    order = np.argsort(-elevation, kind="stable")
    row = np.empty(len(order), np.int64)
    row[order] = np.arange(len(order))
    rows_a, rows_b = (row[np.searchsorted(rings, one)] for one in (numbers, b.rings))
    return rings[order], elevation[order], rows_a, rows_b, tuple(notes)


def _field(seen: Indices, columns: int, step: float) -> tuple[Ints, float]:
    """Columns within the field of view, and the azimuth of the first, -180 to 180 degrees."""
    gaps = np.diff(seen, append=seen[:1] + columns)
    widest = int(gaps.argmax())
    if gaps[widest] * step < _SECTOR_DEG:  # all around, from straight behind
        first = round(180 / step)
        count = columns
    else:
        first = int(seen[(widest + 1) % len(seen)])
        count = columns - int(gaps[widest]) + 1
    order = (first + np.arange(count)) % columns
    begin = first * step
    return order, begin - 360 if begin >= 180 - step / 2 else begin
