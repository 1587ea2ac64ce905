"""Stack of a recording's sweeps that have been resampled to common cells.

A cell is defined by a ring and a column, which is an azimuth step. All pulses in the same cell
belong to the same ray. Arrays have s sweeps, r rings (rows), c columns and k rays. Positions and
directions are in the sensor frame.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from lidarfiles.clouds.recording import Recording
from lidarfiles.recordings.opening import with_sweeps
from lidarsim.columns.sweep import Sweep
from lidarsim.errors import LidarError, prefix_errors
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints
from lidarsim.numerics.even_samples import even_indices
from lidarsim.words import format_rounded

from ..compared_sweep import compared_sweep, rings_note
from ..range_image import RangeImages, range_images

MAX_RETURNS = 1 << 24  # maximum number in memory; longer recordings are sampled evenly by sweep
_MAX_FOREIGN_SHARE = 0.1  # maximum fraction of points in rings that the reference does not have
_NEIGHBOR_RAYS = 5  # number of rays on either side whose scatter is included
_MIN_CELL_SHARE = 0.3  # cells that return in a smaller fraction of sweeps do not reveal gaps
_MAX_LOG_CHANCE = -16.0  # missing pulses are a gap if losing them by chance is less likely
_STEADY_PATCH = (3, 9)  # rows and columns of the patches in which returns are counted
MAX_KINK_M = 0.01  # maximum distance of a surface from its plane within four columns


@dataclass(frozen=True, eq=False)
class SweepStack:
    """Returns of all sweeps in common cells, sorted by descending ring elevation.

    Values are NaN in cells without a return.
    """

    numbers: Ints  # (s,): numbers of the sweeps in the recording
    rings: Ints  # (r,): numbers of the rings
    elevation_deg: Floats  # (r,): elevations of the rings
    directions: Floats  # (r, c, 3): mean unit directions of the cells
    ranges: Floats32  # (s, r, c): meters
    intensities: Floats32  # (s, r, c)
    azimuth_offsets: Floats32  # (s, r, c): azimuths of pulses minus `directions`, radians
    rough_sigma: Floats  # (r, c): rough standard deviation of ranges over the sweeps, meters
    covered: Bools  # (s, r, c): whether the sweep sent a pulse into the cell, even if it was lost
    notes: tuple[str, ...]

    @property
    def sweep_count(self) -> int:
        """Number of sweeps in the stack."""
        return len(self.ranges)

    @cached_property
    def trials(self) -> Ints:
        """Number of sweeps that emitted a pulse into each cell, whether or not it returned.

        The array has shape (r, c).
        """
        return np.asarray(self.covered.sum(axis=0))

    @cached_property
    def steady(self) -> Bools:
        """Mask of the cells near which no object appears or disappears.

        The array has shape (r, c).
        """
        return steady_cells(np.isfinite(self.ranges), self.covered)

    @classmethod
    def read(cls, recording: Recording, read: Callable[[int], Sweep] | None = None) -> SweepStack:
        """Read the sweeps of a recording and group their points by cell.

        `read` is a function that reads the returns of a sweep by its index. The default is
        `compared_sweep`. Raises LidarError if the recording has no sweeps with points and rings, or
        contains several sensors.
        """
        check_sweeps(recording)
        read = read or partial(compared_sweep, recording)
        cells = _CommonCells.read(recording, read)
        notes = [*recording.notes, *cells.ring_notes]
        if len(cells.numbers) < len(recording):
            notes.append(
                f"{len(cells.numbers):,} evenly spaced sweeps out of {len(recording):,} are used"
            )
        for index, number in enumerate(cells.numbers.tolist()):
            sweep = read(number)
            with prefix_errors(recording.info.name):
                cells.add_sweep(index, sweep)
        elevation_deg, values = cells.sorted_by_elevation()
        covered = covered_cells(np.isfinite(values[0]))
        has_return = np.isfinite(values[0]).any(axis=0)
        if (gaps := 1 - covered[:, has_return].mean()) > 0.5 / covered.size:
            notes.append(
                f"{format_rounded(100 * gaps, 2)} % of the cells in the sweeps are gaps, which are "
                "runs of cells without a return that are too long for individually lost pulses. "
                "Possible causes are lost packets, truncated sweeps, and motion of the sensor or "
                "of objects. Gaps are not counted as lost pulses"
            )
        directions, azimuth_offsets = _mean_directions(values, elevation_deg, cells.step_deg)
        return cls(
            numbers=cells.numbers[cells.have_points],
            rings=cells.sorted_rings(),
            elevation_deg=elevation_deg,
            directions=directions,
            ranges=values[0],
            intensities=values[1],
            azimuth_offsets=azimuth_offsets,
            rough_sigma=rough_scatter(values[0]),
            covered=covered,
            notes=tuple(notes),
        )


def check_sweeps(recording: Recording) -> None:
    """Raise LidarError unless the recording has sweeps that contain all returns."""
    if recording.info.thinned:
        raise LidarError(f"{recording.notes[0]}.")
    with_sweeps(recording)


@dataclass(eq=False)
class _CommonCells:
    """Cells that all sweeps share, filled with one sweep at a time.

    A ring is added with its first return.
    """

    numbers: Ints  # (s,): numbers of the sweeps that are read from the recording
    reference: Sweep  # sweep whose rings and azimuth steps define the cells
    ring_notes: list[str]  # notes on how the rings of the reference were determined
    images: RangeImages  # range images of the reference
    rings: Ints  # (r,)
    elevation_deg: Floats  # (r,)
    values: Floats32  # (4, s, r, c): range in meters, intensity, azimuth and elevation in degrees

    @classmethod
    def read(cls, recording: Recording, read: Callable[[int], Sweep]) -> _CommonCells:
        """Create empty cells, using the largest of the first three sweeps."""
        reference = max(map(read, range(min(3, len(recording)))), key=len)
        if not len(reference):
            raise LidarError(
                f"{recording.info.name} contains no points, so there is nothing to fit."
            )
        # This call determines the rings. It stays outside `prefix_errors`, because errors that
        # occur when a sweep is read already name the recording.
        ring_notes = rings_note(recording, reference)
        with prefix_errors(recording.info.name):
            images = range_images(reference, reference, ("a sweep", "a sweep"))
        shape = len(images.rings), round(360 / images.step_deg)
        max_sweeps = max(MAX_RETURNS // (shape[0] * shape[1]), 2)
        numbers = even_indices(len(recording), max_sweeps)
        values = np.full((4, len(numbers), *shape), np.nan, np.float32)
        elevation_deg = images.elevation_deg
        return cls(numbers, reference, ring_notes, images, images.rings, elevation_deg, values)

    @property
    def step_deg(self) -> float:
        return self.images.step_deg

    def add_sweep(self, index: int, points: Sweep) -> None:
        if not len(points):
            return
        number = int(self.numbers[index])
        names = (f"sweep {number}", "another")
        sweep = range_images(points, self.reference, names, self.step_deg)
        returned = np.isfinite(sweep.images[0, 0])
        # A ring that contains only false alarms may have no return in the first sweeps.
        foreign = returned[~np.isin(sweep.rings, self.images.rings)].sum()
        is_foreign = foreign > _MAX_FOREIGN_SHARE * returned.sum()
        # If the azimuth steps differ, more points share a cell with another point.
        if is_foreign or sweep.hidden_shares[0] > self.images.hidden_shares[0] + 0.25:
            raise LidarError(
                f"sweep {number} comes from a different sensor, or was recorded in a different "
                "mode."
            )
        self._add_rings(sweep)
        _, sweep_rows, row_indices = np.intersect1d(sweep.rings, self.rings, return_indices=True)
        first_column = round(sweep.start_deg / sweep.step_deg)
        columns = first_column + np.arange(sweep.images.shape[-1])
        columns %= self.values.shape[-1]
        self.values[:, index, row_indices[:, None], columns] = sweep.images[0][:, sweep_rows]

    def _add_rings(self, sweep: RangeImages) -> None:
        """Append rows for rings that none of the earlier sweeps contain."""
        is_new = ~np.isin(sweep.rings, self.rings)
        if not is_new.any():
            return
        _, sweep_count, _, column_count = self.values.shape
        self.rings = np.append(self.rings, sweep.rings[is_new])
        self.elevation_deg = np.append(self.elevation_deg, sweep.elevation_deg[is_new])
        blank = np.full((4, sweep_count, is_new.sum(), column_count), np.nan, np.float32)
        self.values = np.concatenate([self.values, blank], axis=2)

    @property
    def have_points(self) -> Bools:
        return np.asarray(np.isfinite(self.values[0]).any(axis=(1, 2)))

    def _order(self) -> Ints:
        return np.argsort(-self.elevation_deg, kind="stable")

    def sorted_rings(self) -> Ints:
        return np.asarray(self.rings[self._order()])

    def sorted_by_elevation(self) -> tuple[Floats, Floats32]:
        """Return the elevations and values, sorted by descending elevation.

        The arrays have shapes (r,) and (4, s, r, c). Sweeps without points are omitted.
        """
        order = self._order()
        return self.elevation_deg[order], self.values[:, self.have_points][:, :, order]


def _mean_directions(
    values: Floats32, elevation_deg: Floats, step_deg: float
) -> tuple[Floats, Floats32]:
    """Return each cell's mean direction, and the azimuth offsets from this direction in radians.

    The shapes are (r, c, 3) and (s, r, c). `values` comes from `_CommonCells`, and `elevation_deg`
    contains the elevation of each ring.
    """
    grid_azimuth = np.radians(step_deg * np.arange(values.shape[-1]))
    grid_elevation = elevation_deg[:, None]
    azimuth_offset = (np.radians(values[2]) - grid_azimuth + np.pi) % (2 * np.pi) - np.pi
    elevation_offset = np.radians(values[3] - grid_elevation)
    mean_azimuth_offset, mean_elevation_offset = (
        np.nansum(offset, axis=0) / np.maximum(np.isfinite(offset).sum(axis=0), 1)
        for offset in (azimuth_offset, elevation_offset)
    )
    azimuth = grid_azimuth + mean_azimuth_offset
    elevation = np.radians(grid_elevation) + mean_elevation_offset
    directions = [
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation),
    ]
    return np.stack(directions, axis=-1), azimuth_offset - mean_azimuth_offset


def finite_median(values: Floats32, axis: int | tuple[int, ...]) -> Any:
    """Return the median of the finite values along axes as float64, or NaN if there are none."""
    with warnings.catch_warnings(action="ignore"):
        return np.nanmedian(values, axis=axis).astype(np.float64)


def rough_scatter(ranges: Floats32) -> Floats:
    """Estimate the standard deviation of the ranges in each cell over all sweeps, in meters.

    The result is a median over neighboring rays, but not less than the median of the ring. Ranges
    of weak or steep surfaces scatter more than other ranges of the same ring.
    """
    changes = np.abs(np.diff(ranges, axis=0)) / (0.6745 * np.sqrt(2))
    ring_scatter = finite_median(changes, (0, 2))[:, None]
    ray_scatter = finite_median(changes, 0)
    shifts = range(-_NEIGHBOR_RAYS, _NEIGHBOR_RAYS + 1)
    neighborhood = finite_median(
        np.stack([np.roll(ray_scatter, shift, axis=1) for shift in shifts]), 0
    )
    ring_scatter = np.where(np.isnan(ring_scatter), MAX_KINK_M, np.maximum(ring_scatter, 1e-4))
    return np.fmax(neighborhood, ring_scatter)


def covered_cells(returned: Bools) -> Bools:
    """Return a mask of the cells into which a sweep emitted a pulse.

    The mask has shape (s, r, c). The other cells are gaps due to lost packets or incomplete sweeps.
    `returned` marks the cells with a return. A run of cells without a return, in one ring or in all
    rings, is considered a gap if independent losses of pulses are very unlikely to produce such a
    run.
    """
    fraction = (returned.sum(axis=0) + 0.5) / (len(returned) + 1)
    log_chance = np.where(fraction > _MIN_CELL_SHARE, np.log1p(-fraction), 0.0)
    # Columns without a return in any ring are gaps even if few sweeps return there.
    sparse_log_chance = np.log1p(-returned.sum(axis=0) / (len(returned) + 1)).sum(axis=0)
    columns = _improbable_runs(np.asarray(~returned.any(axis=1)), sparse_log_chance)
    rings = _improbable_runs(~returned, log_chance)
    return ~(columns[:, None] | rings)


def _improbable_runs(empty: Bools, log_chance: Floats) -> Bools:
    """Mark sequences of empty cells that are too long to be caused by chance.

    Runs extend along the last axis, which is a revolution. `log_chance` contains the logarithm of
    the probability that a cell is empty.
    """
    count = empty.shape[-1]
    edge = np.zeros((*empty.shape[:-1], 1), bool)
    twice = np.concatenate([edge, empty, empty, edge], axis=-1)
    changes = np.diff(twice.ravel().astype(np.int8))
    starts = np.flatnonzero(changes == 1)
    stops = np.flatnonzero(changes == -1)
    weights = np.zeros(twice.shape)
    weights[..., 1:-1] = np.concatenate([log_chance, log_chance], axis=-1)
    total = np.cumsum(weights.ravel())
    gaps = total[stops] - total[starts] < _MAX_LOG_CHANCE
    marks = np.zeros(twice.size, np.int64)
    marks[starts[gaps] + 1] += 1
    marks[stops[gaps] + 1] -= 1
    inside = np.cumsum(marks).reshape(twice.shape) > 0
    return np.asarray(inside[..., 1 : count + 1] | inside[..., count + 1 : -1])


def steady_cells(returned: Bools, covered: Bools) -> Bools:
    """Mark the cells near which no object appears or disappears between sweeps.

    If a car drives past in front of the sky, the pulses of many cells return in some sweeps and in
    none of the others. Independent losses are very unlikely to produce this pattern: by the bound
    of Chernoff (1952), the number of returns in a patch of cells would be close to its mean.
    `returned` and `covered` mark cells with a return, and cells into which a sweep sent a pulse.
    Both have shape (s, r, c).
    """
    from scipy.ndimage import maximum_filter, uniform_filter
    from scipy.special import rel_entr

    modes = ("constant", "wrap")

    def patch_sums(values: Bools) -> Floats:
        means = uniform_filter(values.astype(np.float64), _STEADY_PATCH, mode=modes)
        return np.asarray(np.rint(means * np.prod(_STEADY_PATCH)))

    pulses = sum(patch_sums(mask) for mask in covered)
    return_counts = sum(patch_sums(mask) for mask in returned & covered)
    mean_fraction = return_counts / np.maximum(pulses, 1)
    unsteady = np.zeros(mean_fraction.shape, bool)
    for sweep_returned, sweep_covered in zip(returned, covered, strict=True):
        trials = patch_sums(sweep_covered)
        fraction = patch_sums(sweep_returned & sweep_covered) / np.maximum(trials, 1)
        divergence = rel_entr(fraction, mean_fraction) + rel_entr(1 - fraction, 1 - mean_fraction)
        unsteady |= np.where(trials > 0, divergence, 0) * trials > -_MAX_LOG_CHANCE
    return ~maximum_filter(unsteady, _STEADY_PATCH, mode=modes)
