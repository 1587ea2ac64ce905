"""Charts of a held-out sweep and its simulation, and of the accuracy of a reconstruction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm, Normalize

from lidarsim.numerics.arrays import Bools, Floats, Floats32, Ints
from lidarview.render import theme
from lidarview.render.picture_page import Page, label_logarithms

from ..clouds.rings import elevations
from .alignment import AlignedSweep, AlignedSweeps
from .held_out import HeldOutRays

_WIDTH = 1600
_LEFT = 0.075
_CHART_WIDTH = 0.77
_IMAGE_HEIGHT = 190
_GAP = 62
_ABOVE_HEIGHT = 1000
_ABOVE_FRAME = (_LEFT, 0.09, 0.86, 0.76)  # left, bottom, width and height relative to the page
_TOP = 150
_BOTTOM = 90
_COLUMNS = 720  # maximum number of image columns, 0.5° each
_ROWS = 64  # number of image rows for a sensor without rings
_DIFFERENCE_M = 0.1  # limit of the color scale for differences
STATIONARY_DOTS = 150_000
_MOVED_DOTS = 40_000
_NO_RETURN = theme.rgb("#c8cbd0")
_MOVED_COLOR = "#d7301f"
_PATH_COLOR = "#08519c"


class _Image(NamedTuple):
    """Image of a sweep, with a caption and colors."""

    words: str
    values: Floats32  # (r, c)
    scale: Any  # Matplotlib norm
    colors: str  # name of a colormap


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

    def pictures(self) -> list[_Image]:
        """Return the images of the recorded and the simulated sweep, and of their differences."""
        near_m, far_m = np.nanquantile(self.range_m, (0.01, 0.98)).tolist()
        ranges = LogNorm(max(near_m, 0.1), max(far_m, 1.0))
        differences = Normalize(-_DIFFERENCE_M, _DIFFERENCE_M)
        words = f"difference up to {1000 * _DIFFERENCE_M:.0f} mm (red: reconstruction is farther)"
        images = [
            _Image("range, recorded", self.range_m, ranges, theme.RANGE_COLORS),
            _Image("range, reconstructed", self.simulated_m, ranges, theme.RANGE_COLORS),
            _Image(words, self.simulated_m - self.range_m, differences, "RdBu_r"),
        ]
        if self.intensity is not None and self.simulated_intensity is not None:
            scale = Normalize(0, max(float(np.nanquantile(self.intensity, 0.98)), 1e-9))
            images.append(_Image("intensity, recorded", self.intensity, scale, "gray"))
            images.append(
                _Image("intensity, reconstructed", self.simulated_intensity, scale, "gray")
            )
        return images


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
            moved.append(world[~mask][:_MOVED_DOTS])
        parts = (np.concatenate(points).astype(np.float32) for points in (still, moved))
        return cls(*parts)


def draw_sweep(sweep: SweepImages) -> Page:
    """Draw the ranges and intensities of a recorded and a simulated sweep, and the differences."""
    images = sweep.pictures()
    height = _TOP + len(images) * _IMAGE_HEIGHT + (len(images) - 1) * _GAP + _BOTTOM
    page = Page((_WIDTH, height))
    page.title(f"Sweep {int(sweep.number[0])}", "held out from the reconstruction")
    for index, one in enumerate(images):
        bottom = height - _TOP - (index + 1) * _IMAGE_HEIGHT - index * _GAP
        frame = (_LEFT, bottom / height, _CHART_WIDTH, _IMAGE_HEIGHT / height)
        axes = page.chart(frame, ylabel="ring")
        known = np.nan_to_num(one.values, nan=1.0)
        drawn = theme.apply_colormap(one.colors, np.asarray(one.scale(known).data))
        drawn[~np.isfinite(one.values)] = _NO_RETURN
        extent = (180, -180, one.values.shape[0] - 0.5, -0.5)
        axes.imshow(drawn[:, ::-1], aspect="auto", interpolation="nearest", extent=extent)
        axes.grid(False)
        page.heading(axes, one.words)
    axes.set_xlabel("azimuth, °")
    return page


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


def draw_top_view(parts: Sequence[TopViewPoints], path: Floats) -> Page:
    """Draw stationary and moving points and the sensor path, as seen from above.

    `path` has the sensor positions, of shape (s, 3).
    """
    page = Page((_WIDTH, _ABOVE_HEIGHT))
    page.title(
        "Top view", "gray: stationary points; red: points removed because rays passed through them"
    )
    near = np.concatenate([part.still for part in parts])
    moved = np.concatenate([part.moved for part in parts])
    low, high = np.quantile(near, (0.01, 0.99), axis=0)
    # Use an equal aspect ratio.
    sides = np.array([_ABOVE_FRAME[2] * _WIDTH, _ABOVE_FRAME[3] * _ABOVE_HEIGHT])
    half = ((high - low) / sides).max() * sides / 2
    axes = page.map_chart(_ABOVE_FRAME, (low + high) / 2 + [-half, half])
    for points, color, size, most in (
        (near, theme.UNSEEN, 1.0, STATIONARY_DOTS),
        (moved, _MOVED_COLOR, 1.6, _MOVED_DOTS),
    ):
        some = points[:: max(-(-len(points) // most), 1)]
        dots = size * page.unit**2
        axes.scatter(some[:, 0], some[:, 1], c=color, s=dots, lw=0, rasterized=True)
    axes.plot(path[:, 0], path[:, 1], color=_PATH_COLOR, lw=1.6 * page.unit)
    return page


def draw_errors(figures: Mapping[str, Any]) -> Page:
    """Draw the range errors as functions of sweep number and range."""
    page = Page((_WIDTH, 560))
    page.title(
        "Range differences",
        "absolute values in held-out sweeps; dots: medians; bars: 90th percentiles",
    )
    rows = (
        (figures["held_out"]["by_sweep"], "sweep", "sweep"),
        (figures["held_out"]["by_range"], "from_m", "range from, m"),
    )
    for index, (entries, key, label) in enumerate(rows):
        axes = page.chart((_LEFT + 0.46 * index, 0.17, 0.38, 0.56), xlabel=label, ylabel="mm")
        known = [entry for entry in entries if entry["median_abs_difference_m"] is not None]
        x = [entry[key] for entry in known]
        half = [1000 * entry["median_abs_difference_m"] for entry in known]
        most = [1000 * entry["p90_abs_difference_m"] for entry in known]
        axes.vlines(x, half, most, color=theme.UNSEEN, lw=1.8 * page.unit)
        axes.plot(x, half, "o", color=theme.OBJECT_COLORS[0], ms=4 * page.unit, mew=0)
        axes.set_yscale("log")
        if known:
            label_logarithms(axes.yaxis, max(most) < 1000 * min(half))
    return page
