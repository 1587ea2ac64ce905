"""Range images of two sweeps from the same sensor, with common rings and azimuth steps.

A fixed grid would have cells with two pulses or none, because recorded pulses have jitter, the
azimuth step does not divide the revolution, and there is a seam. Therefore the phase of each ring's
pulses is determined every 10°. Since two programs may number the rings in opposite directions,
rings are matched by the elevation of their points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Bools, Floats, Indices, Ints

from .compared_sweep import RAY_KEY

_TILT_DEG = 1.0  # maximum interquartile range of the elevations in a ring, for dense rings
_STEP_TOLERANCE = 0.15  # maximum relative difference between single steps and their mean
_MEAN_STEP_TOLERANCE = 0.01  # maximum relative difference of mean steps in the same sensor mode
_SECTOR_DEG = 90.0  # a gap as wide as this in all rings is outside the field of view
_BLOCKS = 36  # number of azimuth blocks, in which the pulses of a ring are evenly spaced
_MIN_SHARE = 0.7  # minimum fraction of rings whose numbers must follow a common rule
_FINEST_DEG = 1e-3  # points closer in azimuth belong to the same pulse
_MAX_RANGE_M = 20_000.0  # beyond the range of any lidar with rings, so not in the sensor frame


@dataclass(frozen=True, eq=False)
class RangeImages:
    """Range images of two sweeps with the same cells.

    Rows are rings, and columns are azimuth steps.
    """

    rings: Ints  # (r,): ring numbers of B, by descending elevation
    elevation_deg: Floats  # (r,): median elevation of the points
    step_deg: float  # width of a column
    start_deg: float  # azimuth of the first column
    # (2, 4, r, c): range, intensity, and azimuth and elevation in degrees, in A and in B, NaN if
    # unknown. Images of paired rays contain only range and intensity: (2, 2, r, c).
    images: Floats
    hidden_shares: tuple[float, float]  # fractions of points that share a cell with a used point
    notes: tuple[str, ...]
    cell_rows: Ints  # (k,): row of each cell, or of each ray that has a return
    # (2, 2, k): range and intensity at `cell_rows` in A and in B, NaN where unknown.
    compared: Floats
    paired_by: str = "cells"  # "cells" or "rays"

    @property
    def ranges(self) -> Floats:
        """Ranges of A and B in meters, or NaN where there is no return.

        The array has shape (2, r, c).
        """
        return self.images[:, 0]

    @property
    def return_masks(self) -> tuple[Bools, Bools]:
        """Two masks, of the cells with a return in A and of those with a return in B.

        Each mask has shape (r, c).
        """
        return np.isfinite(self.ranges[0]), np.isfinite(self.ranges[1])


class _Cells(NamedTuple):
    shape: tuple[int, int]  # rows, columns
    step_deg: float


@dataclass(frozen=True, eq=False)
class _PolarSweep:
    """Points of a sweep in polar coordinates, with their rings."""

    azimuth: Floats  # (n,): degrees, 0 to 360
    elevation: Floats  # (n,): degrees
    ranges: Floats  # (n,): meters
    ring_index: Ints  # (n,): index into `rings`
    intensities: Floats | None  # (n,)
    rings: Ints  # (r,): numbers
    ring_elevation: Floats  # (r,): medians, degrees

    @classmethod
    def from_points(cls, sweep: Sweep, name: str) -> _PolarSweep:
        """Convert the points of a sweep to polar coordinates.

        Raises LidarError if the sweep has no rings, or if its origin is not the sensor. In the
        latter case, the rings are not cones around the origin, or the points are too far away.
        """
        has_column = "channel" in sweep.columns
        rings = sweep.rings
        if rings is None:
            raise LidarError(f"{name} has no ring column, such as `ring` or `channel`")
        if not has_column and (rings < 0).any():  # some points belong to no ring
            return cls.from_points(sweep.select(rings >= 0), name)
        ranges = np.linalg.norm(sweep.points, axis=1)
        if np.median(ranges) > _MAX_RANGE_M:
            raise LidarError(
                f"the points of {name} are {np.median(ranges) / 1000:,.0f} km from the origin, so "
                "they are in world coordinates instead of the sensor frame"
            )
        x, y, z = sweep.points.T
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
        rings, index = np.unique(rings, return_inverse=True)
        order = np.lexsort((elevation, index))
        offsets = np.searchsorted(index[order], np.arange(len(rings) + 1))
        counts = np.diff(offsets)
        lower, middle, upper = (
            elevation[order][offsets[:-1] + (fraction * (counts - 1)).astype(np.intp)]
            for fraction in (0.25, 0.5, 0.75)
        )
        if np.median(upper - lower) > max(_TILT_DEG, _spacing(middle) / 2):
            raise LidarError(
                f"the elevation angles within the rings of {name} vary, so either the sensor "
                "does not scan in rings, as is the case for airborne and Livox sensors, or the "
                "points are not in the sensor frame"
            )
        azimuth = np.degrees(np.arctan2(y, x)) % 360
        return cls(
            azimuth=azimuth,
            elevation=elevation,
            ranges=ranges,
            ring_index=index,
            intensities=sweep.intensity,
            rings=rings,
            ring_elevation=middle,
        )

    def step(self) -> float:
        """Estimate the azimuth step between consecutive pulses of a ring, in degrees."""
        order = np.lexsort((self.azimuth, self.ring_index))
        steps = np.diff(self.azimuth[order])[np.diff(self.ring_index[order]) == 0]
        steps = steps[steps > _FINEST_DEG]
        if not len(steps):
            return 1.0
        counts, edges = np.histogram(np.log(steps), bins=100)
        step = np.exp(edges[counts.argmax() : counts.argmax() + 2].mean())

        def similar_steps(step: float) -> Floats:
            return steps[np.abs(steps / step - 1) < _STEP_TOLERANCE]

        # If most returns are lost, a multiple of the step may be the most frequent difference.
        for divisor in (4, 3, 2):
            if len(similar_steps(step / divisor)) > len(similar_steps(step)) / 4:
                step /= divisor
                break
        for _ in range(10):  # the mean of similar steps is more accurate than the histogram bin
            step = similar_steps(step).mean()
        return float(step)

    def phases(self, ring_rows: Ints, cells: _Cells) -> Floats:
        """Return the mean phase of the pulses in each row and azimuth block.

        The phase is the azimuth of a pulse modulo the azimuth step, in azimuth steps. The result
        has shape (rows, blocks) and is NaN where there are no pulses. `ring_rows` contains the row
        of each ring of the sweep.
        """
        row_count, _ = cells.shape
        bins = ring_rows[self.ring_index] * _BLOCKS + self._block
        phasors = np.exp(2j * np.pi * self.azimuth / cells.step_deg)
        real, imaginary = (
            np.bincount(bins, part, row_count * _BLOCKS) for part in (phasors.real, phasors.imag)
        )
        is_empty = np.bincount(bins, minlength=row_count * _BLOCKS) == 0
        phases = np.angle(real + 1j * imaginary) / (2 * np.pi)
        return np.where(is_empty, np.nan, phases).reshape(row_count, _BLOCKS)

    @property
    def _block(self) -> Ints:
        return (self.azimuth * (_BLOCKS / 360)).astype(np.int64).clip(0, _BLOCKS - 1)

    def image(self, ring_rows: Ints, phases: Floats, cells: _Cells) -> tuple[Floats, float]:
        """Return a sweep's range image, and the fraction of points that are not part of it.

        `ring_rows` contains the row of each ring of the sweep, and `phases` is the result of the
        method `phases`. If several points fall into a cell, the point closest to the center of the
        cell is used. Of several returns of the same pulse, the closest to the sensor is used.
        """
        row_count, column_count = cells.shape
        position = self.azimuth / cells.step_deg - phases[ring_rows[self.ring_index], self._block]
        column = np.round(position)
        offset = np.round(np.abs(position - column), 3)
        cell = ring_rows[self.ring_index] * column_count + column.astype(np.int64) % column_count
        order = np.lexsort((self.ranges, offset, cell))
        chosen = order[np.diff(cell[order], prepend=-1) > 0]
        image = np.full((4, row_count * column_count), np.nan)
        quantities = (self.ranges, self.intensities, self.azimuth, self.elevation)
        for index, values in enumerate(quantities):
            if values is not None:
                image[index, cell[chosen]] = values[chosen]
        return image.reshape(4, *cells.shape), 1 - len(chosen) / len(cell)


def range_images(
    a: Sweep, b: Sweep, names: tuple[str, str], azimuth_deg: float | None = None
) -> RangeImages:
    """Create range images of two sweeps from the same sensor, with the same cells.

    The width of a column is the azimuth step between pulses, or the larger of the two steps. The
    cells of each ring are centered on its pulses in every 10° block, so that no pulse falls on the
    boundary between two cells even if the head rotates unevenly. Each pulse of A is assigned to the
    cell of the nearest pulse of B.

    Raises LidarError if a sweep has no rings or is not in the sensor frame, or if the sweeps come
    from sensors with different rings. The message is a clause without a period.
    """
    sweep_a = _PolarSweep.from_points(a, names[0])
    sweep_b = _PolarSweep.from_points(b, names[1])
    common = _common_rings(sweep_a, sweep_b, names)
    row_count = len(common.rings)
    phases = _common_phases(sweep_a, sweep_b, common, azimuth_deg)
    column_count = max(round(360 / phases.step_deg - phases.seam), 1)
    cells = _Cells((row_count, column_count), phases.step_deg)
    image_a, hidden_a = sweep_a.image(common.rows_a, phases.phases_a, cells)
    image_b, hidden_b = sweep_b.image(common.rows_b, phases.phases_b, cells)
    images = np.stack([image_a, image_b])
    occupied = np.flatnonzero(np.isfinite(images[:, 0]).any(axis=(0, 1)))
    columns, start_deg = _field_of_view(occupied, column_count, phases.step_deg)
    images = images[..., columns]
    return RangeImages(
        rings=common.rings,
        elevation_deg=common.elevation,
        step_deg=phases.step_deg,
        start_deg=start_deg,
        images=images,
        hidden_shares=(hidden_a, hidden_b),
        notes=common.notes,
        cell_rows=np.repeat(np.arange(row_count), len(columns)),
        compared=images[:, :2].reshape(2, 2, -1),
    )


class _CommonPhases(NamedTuple):
    """Azimuth step of the common cells, and the phases of the pulses in both sweeps."""

    step_deg: float
    phases_a: Floats  # (rows, blocks), in steps
    phases_b: Floats  # (rows, blocks), in steps

    @property
    def seam(self) -> float:
        """Median phase change over a revolution, in azimuth steps."""
        return float(np.median(self.phases_b[:, -1] - self.phases_b[:, 0]))


def _common_phases(
    a: _PolarSweep, b: _PolarSweep, common: _CommonRings, azimuth_deg: float | None
) -> _CommonPhases:
    """Choose a common azimuth step, and compute the phases of both sweeps without gaps.

    If `azimuth_deg` is not None, it is used as the step.
    """
    steps = [a.step(), b.step()]
    same_mode = abs(steps[0] / steps[1] - 1) < _MEAN_STEP_TOLERANCE
    step = azimuth_deg or (steps[1] if same_mode else max(steps))
    cells = _Cells((len(common.rings), 0), step)
    phases_a = a.phases(common.rows_a, cells)
    phases_b = b.phases(common.rows_b, cells)
    prefers_b = same_mode or steps[0] < steps[1]
    preferred = phases_b if prefers_b else phases_a
    fallback = phases_a if prefers_b else phases_b
    middle = np.where(np.isnan(preferred), fallback, preferred)
    blocks = np.arange(_BLOCKS)
    for row in middle:  # phases change continuously from block to block
        finite = np.flatnonzero(~np.isnan(row))
        row[:] = np.interp(blocks, finite, np.unwrap(row[finite], period=1))
    difference = phases_a - middle
    for row in difference:
        finite = np.flatnonzero(~np.isnan(row))
        if len(finite):
            row[finite] = np.unwrap(row[finite], period=1)
            row -= np.round(np.median(row[finite]))
    # If a cell contains several pulses, A and B have no meaningful phase difference.
    if same_mode and abs(step / steps[1] - 1) < _STEP_TOLERANCE:
        return _CommonPhases(step, middle + difference, middle)
    return _CommonPhases(step, middle, middle)


class RayPairs(NamedTuple):
    """Returns of two sweeps with identical rays, paired by ray.

    If the sensor moves, pulses in the same cell of two range images often belong to different rays.
    """

    values: Floats  # (2, 2, k): range and intensity in A and in B, NaN without a return
    points: Floats  # (k, 3): positions in A, or in B without a return in A, meters
    rings: Ints  # (k,)


def pair_rays(a: Sweep, b: Sweep) -> RayPairs:
    """Pair the returns of two sweeps that have identical rays."""
    keys, channels = (np.append(a.columns[name], b.columns[name]) for name in (RAY_KEY, "channel"))
    _, first, ray = np.unique(keys, return_index=True, return_inverse=True)
    values = np.full((2, 2, len(first)), np.nan)
    for index, sweep, columns in ((0, a, ray[: len(a)]), (1, b, ray[len(a) :])):
        values[index, 0, columns] = np.linalg.norm(sweep.points, axis=1)
        values[index, 1, columns] = np.nan if sweep.intensity is None else sweep.intensity
    points = np.concatenate([a.points, b.points])[first]
    return RayPairs(values, points, channels[first])


def images_of_rays(
    pairs: RayPairs, names: tuple[str, str], azimuth_deg: float | None = None
) -> RangeImages:
    """Create range images from paired rays, analogous to `range_images`.

    If several rays fall into a cell, one of them is shown. Raises the same errors as
    `range_images`.
    """
    ray_index = np.arange(len(pairs.rings), dtype=np.float64)
    all_rays = Sweep(pairs.points, {"channel": pairs.rings, "intensity": ray_index})
    images = range_images(all_rays, all_rays, names, azimuth_deg)
    ray_of_cell = np.nan_to_num(images.images[0, 1], nan=-1).astype(int)
    values = np.pad(pairs.values, ((0, 0), (0, 0), (0, 1)), constant_values=np.nan)  # -1: no ray
    return replace(
        images,
        images=values[..., ray_of_cell],
        cell_rows=(pairs.rings[:, None] == images.rings).argmax(axis=1),
        compared=pairs.values,
        paired_by="rays",
    )


def _spacing(elevation: Floats) -> float:
    """Return the median spacing between rings, in degrees."""
    gaps = np.diff(np.sort(elevation))
    return float(np.median(gaps)) if len(gaps) else 1.0


class _CommonRings(NamedTuple):
    """Rings that occur in two sweeps, and their row indices, sorted by descending elevation."""

    rings: Ints  # (r,): ring numbers of B
    elevation: Floats  # (r,): degrees
    rows_a: Ints  # row of each ring of A
    rows_b: Ints  # row of each ring of B
    notes: tuple[str, ...]


def _common_rings(a: _PolarSweep, b: _PolarSweep, names: tuple[str, str]) -> _CommonRings:
    """Match rings of A and B that have the same elevation.

    Some programs number rings from the bottom, others from the top, and some start at 1. If the
    numbers of A can be converted to those of B, a ring with returns in only one sweep also gets a
    row. Raises LidarError if the elevations of the rings differ.
    """
    numbers, notes = _ring_numbers(a, b)
    rings, first = np.unique(np.append(b.rings, numbers), return_index=True)
    elevation = np.append(b.ring_elevation, a.ring_elevation)[first]
    _check_elevations(a, b, numbers, names)
    order = np.argsort(-elevation, kind="stable")
    row = np.empty(len(order), np.int64)
    row[order] = np.arange(len(order))
    return _CommonRings(
        rings=rings[order],
        elevation=elevation[order],
        rows_a=row[np.searchsorted(rings, numbers)],
        rows_b=row[np.searchsorted(rings, b.rings)],
        notes=tuple(notes),
    )


def _ring_tolerance(b: _PolarSweep) -> float:
    """Return the maximum elevation difference between matching rings of A and B, in degrees."""
    return max(_spacing(b.ring_elevation) / 2, 0.05)


def _ring_numbers(a: _PolarSweep, b: _PolarSweep) -> tuple[Ints, list[str]]:
    """Convert A's ring numbers to the numbering of B, and return notes about the conversion.

    The numbers are shifted or reversed. If neither is possible, rings are matched by elevation, and
    unmatched rings get negative numbers.
    """
    difference = np.abs(a.ring_elevation[:, None] - b.ring_elevation)
    index_a = difference.argmin(axis=0)
    index_b = np.flatnonzero(difference[index_a].argmin(axis=1) == np.arange(len(b.rings)))
    index_a = index_a[index_b]
    for sign in (1, -1):
        shift = int(np.median(b.rings[index_b] - sign * a.rings[index_a]))
        numbers = sign * a.rings + shift
        if np.mean(np.abs(numbers[index_a] - b.rings[index_b]) <= 1) >= _MIN_SHARE:
            if sign > 0 and not shift:
                return numbers, []
            rule = f"n {'+-'[shift < 0]} {abs(shift)}" if sign > 0 else f"{shift} - n"
            return numbers, [f"ring n of A corresponds to ring {rule} of B"]
    is_match = difference[index_a, index_b] <= _ring_tolerance(b)
    numbers = -1 - np.arange(len(a.rings))
    numbers[index_a[is_match]] = b.rings[index_b[is_match]]
    return numbers, [
        (
            "the rings of the two clouds are numbered in different orders, so they are matched by "
            "elevation"
        )
    ]


def _check_elevations(
    a: _PolarSweep, b: _PolarSweep, numbers: Ints, names: tuple[str, str]
) -> None:
    """Raise LidarError if rings with the same number have different elevations in A and B."""
    shared, in_a, in_b = np.intersect1d(numbers, b.rings, return_indices=True)
    offset = np.abs(a.ring_elevation[in_a] - b.ring_elevation[in_b])
    too_few = len(shared) < min(len(a.rings), len(b.rings)) / 2
    if too_few or np.median(offset) > 2 * _ring_tolerance(b):
        range_a = f"{a.ring_elevation.min():.1f}° to {a.ring_elevation.max():.1f}°"
        range_b = f"{b.ring_elevation.min():.1f}° to {b.ring_elevation.max():.1f}°"
        raise LidarError(
            f"the ring elevation angles are {range_a} in {names[0]} and {range_b} in {names[1]}, "
            "so the sweeps come from different sensors"
        )


def _field_of_view(occupied: Indices, column_count: int, step_deg: float) -> tuple[Ints, float]:
    """Return the columns within the field of view, and the azimuth of the first column.

    `occupied` contains the indices of the columns with a return. The azimuth is between -180 and
    180 degrees.
    """
    gaps = np.diff(occupied, append=occupied[:1] + column_count)
    widest = int(gaps.argmax())
    # A full circle starts behind the sensor.
    if gaps[widest] * step_deg < _SECTOR_DEG:
        first = round(180 / step_deg)
        count = column_count
    else:
        first = int(occupied[(widest + 1) % len(occupied)])
        count = column_count - int(gaps[widest]) + 1
    columns = (first + np.arange(count)) % column_count
    start_deg = first * step_deg
    return columns, start_deg - 360 if start_deg >= 180 - step_deg / 2 else start_deg
