"""Data of the charts of a reconstruction, which submaps are reduced to."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from lidarfiles.clouds.rings import elevations
from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints

from .alignment import AlignedSweep, AlignedSweeps
from .held_out import HeldOutRays

_COLUMNS = 720  # maximum number of image columns, 0.5° each
_ROWS = 64  # number of image rows for a sensor without rings
STATIONARY_DOTS = 150_000
MOVED_DOTS = 40_000


class SweepImages(NamedTuple):
    """Images of a recorded sweep and its simulation.

    The images have a row for each ring and a column for each azimuth. Their shape is (r, c), and
    pixels without a return are NaN.
    """

    number: Ints  # (1,), number of the sweep
    range_m: Floats32
    simulated_m: Floats32
    intensity: Floats32 | None
    simulated_intensity: Floats32 | None

    @classmethod
    def from_rays(cls, sweeps: AlignedSweeps, rays: HeldOutRays, number: int) -> SweepImages:
        """Create images of a held-out sweep and of its simulation."""
        sweep = sweeps.read(number)
        cells = _cells(sweep, sweeps)
        simulated = rays.select(rays.return_mask & (rays.sweep == number))
        range_m, in_twin_m = (
            _image(values, cells) for values in (sweep.range_m, simulated.simulated_m)
        )
        if sweep.intensities is None or not np.isfinite(simulated.simulated_intensity).any():
            return cls(np.array([number]), range_m, in_twin_m, None, None)
        intensity, in_twin = (
            _image(values, cells) for values in (sweep.intensities, simulated.simulated_intensity)
        )
        return cls(np.array([number]), range_m, in_twin_m, intensity, in_twin)


class TopViewPoints(NamedTuple):
    """Horizontal positions of sampled points in world coordinates."""

    still: Floats32  # (n, 2), stationary points, meters
    moved: Floats32  # (k, 2), points on moving objects, meters

    @classmethod
    def from_sweeps(
        cls, sweeps: AlignedSweeps, stationary: Mapping[int, Bools], numbers: Ints, share: float
    ) -> TopViewPoints:
        """Sample points from several sweeps.

        `share` is the fraction of the stationary points that are chosen. The number of points on
        moving objects is limited for each sweep.
        """
        still: list[Floats] = []
        moved: list[Floats] = []
        for number in numbers.tolist():
            mask = stationary[number]
            world = sweeps.read(number).world[:, :2]
            chosen = np.random.default_rng(number).random(len(world)) < share
            still.append(world[mask & chosen])
            moved.append(world[~mask][:MOVED_DOTS])
        parts = (np.concatenate(points).astype(np.float32) for points in (still, moved))
        return cls(*parts)


def _cells(sweep: AlignedSweep, sweeps: AlignedSweeps) -> tuple[Ints, tuple[int, int]]:
    """Return the pixel index of each point, and the shape of the image."""
    row_count = sweeps.recorded.ring_count
    row = sweep.ring
    if not len(sweeps.recorded.elevation_rad):
        elevation = elevations(sweep.points)
        low, high = np.quantile(elevation, (0, 1))
        row_count = _ROWS
        fraction = (high - elevation) / max(high - low, 1e-9)
        row = (fraction * _ROWS).astype(np.int64).clip(0, _ROWS - 1)
    # If there were more columns than pulses per ring, the image would have empty stripes.
    column_count = min(_COLUMNS, int(np.bincount(row).max()))
    turns = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) / (2 * np.pi) + 0.5
    column = (turns * column_count).astype(np.int64) % column_count
    return row * column_count + column, (row_count, column_count)


def _image(values: Floats, cells: tuple[Ints, tuple[int, int]]) -> Floats32:
    """Return an image with the values at their pixels.

    If several values share a pixel, the last one is used. Empty pixels are NaN.
    """
    cell, shape = cells
    image = np.full(shape[0] * shape[1], np.nan, np.float32)
    image[cell] = values
    return image.reshape(shape)
