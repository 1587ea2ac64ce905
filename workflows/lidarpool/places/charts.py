"""Pictures of a twin: a held-out sweep beside its simulation, the place, and errors on the way."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm, Normalize

from lidarsim.base.arrays import Bools, Floats, Ints
from lidarview.render import theme
from lidarview.render.picture_page import Page

from .alignment import AlignedSweep, AlignedSweeps
from .place import Place, Seen
from .recorded_sweeps import elevations
from .reflectances import Reflectances

_WIDTH = 1600
_LEFT = 0.075
_CHART_WIDTH = 0.77
_IMAGE_HEIGHT = 190
_GAP = 62
_TOP = 150
_BOTTOM = 90
_COLUMNS = 720  # of the images, at most: 0.5° each
_ROWS = 64  # of the images of a sensor without rings
_DIFFERENCE_M = 0.1  # end of the scale of differences
_STANDING_DOTS = 150_000
_MOVED_DOTS = 40_000
_NO_RETURN = theme.rgb("#c8cbd0")
_MOVED_COLOUR = "#d7301f"
_PATH_COLOUR = "#08519c"


class _Image(NamedTuple):
    """A picture of the values of the rays of a sweep."""

    words: str
    values: Floats  # (n,)
    scale: Any  # of Matplotlib
    colours: str  # name of a colour map


def draw_sweep(
    sweeps: AlignedSweeps, place: Place, reflectances: Reflectances | None, number: int
) -> Page:
    """Draw ranges and intensities of a sweep, recorded and in the twin, and their differences."""
    sweep = sweeps.read(number)
    images = _images(sweep, place.see(sweep), reflectances)
    cells = _cells(sweep, sweeps)
    height = _TOP + len(images) * _IMAGE_HEIGHT + (len(images) - 1) * _GAP + _BOTTOM
    page = Page((_WIDTH, height))
    page.title(f"Sweep {number}", "which was held out when the place was made")
    for index, one in enumerate(images):
        bottom = height - _TOP - (index + 1) * _IMAGE_HEIGHT - index * _GAP
        frame = (_LEFT, bottom / height, _CHART_WIDTH, _IMAGE_HEIGHT / height)
        axes = page.chart(frame, ylabel="ring")
        image = _image(one.values, cells)
        drawn = theme.mapped(one.colours, np.asarray(one.scale(np.nan_to_num(image, nan=1.0)).data))
        drawn[~np.isfinite(image)] = _NO_RETURN
        extent = (180, -180, image.shape[0] - 0.5, -0.5)
        axes.imshow(drawn[:, ::-1], aspect="auto", interpolation="nearest", extent=extent)
        axes.grid(False)
        page.heading(axes, one.words)
    axes.set_xlabel("azimuth, °")
    return page


def _images(sweep: AlignedSweep, seen: Seen, reflectances: Reflectances | None) -> list[_Image]:
    """Return the images of a sweep and of its rays in the twin."""
    range_m = sweep.range_m
    simulated_m = np.full(len(range_m), np.nan)
    simulated_m[seen.rays] = seen.distance_m
    near_m, far_m = np.quantile(range_m, (0.01, 0.98)).tolist()
    ranges = LogNorm(max(near_m, 0.1), max(far_m, 1.0))
    differences = Normalize(-_DIFFERENCE_M, _DIFFERENCE_M)
    words = f"difference, red where the twin is farther, to {1000 * _DIFFERENCE_M:.0f} mm"
    images = [
        _Image("range, recorded", range_m, ranges, "viridis"),
        _Image("range, in the twin", simulated_m, ranges, "viridis"),
        _Image(words, simulated_m - range_m, differences, "RdBu_r"),
    ]
    if reflectances is not None and sweep.intensities is not None:
        simulated = reflectances.intensities(sweep, seen)
        scale = Normalize(0, max(float(np.quantile(sweep.intensities, 0.98)), 1e-9))
        images.append(_Image("intensity, recorded", sweep.intensities, scale, "gray"))
        images.append(_Image("intensity, in the twin", simulated, scale, "gray"))
    return images


def _cells(sweep: AlignedSweep, sweeps: AlignedSweeps) -> tuple[Ints, tuple[int, int]]:
    """Return the cells (n,) of the points of a sweep in an image, and the image's shape."""
    row_count = sweeps.recorded.ring_count
    row = sweep.ring
    if not len(sweeps.recorded.elevation_rad):
        elevation = elevations(sweep.points)
        low, high = np.quantile(elevation, (0, 1))
        row_count = _ROWS
        share = (high - elevation) / max(high - low, 1e-9)
        row = (share * _ROWS).astype(np.int64).clip(0, _ROWS - 1)
    # More columns than a ring has pulses would leave stripes.
    column_count = min(_COLUMNS, int(np.bincount(row).max()))
    turns = np.arctan2(sweep.points[:, 1], sweep.points[:, 0]) / (2 * np.pi) + 0.5
    column = (turns * column_count).astype(np.int64) % column_count
    return row * column_count + column, (row_count, column_count)


def _image(values: Floats, cells: tuple[Ints, tuple[int, int]]) -> Floats:
    """Return the image (r, c) of values (n,): the last value of each cell, or NaN."""
    cell, shape = cells
    image = np.full(shape[0] * shape[1], np.nan)
    image[cell] = values
    return image.reshape(shape)


def draw_above(sweeps: AlignedSweeps, standing: Mapping[int, Bools]) -> Page:
    """Draw from above what stands and what moved, and the drive."""
    still: list[Floats] = []
    moved: list[Floats] = []
    share = _STANDING_DOTS / max(sum(map(len, standing.values())), 1)
    for number, mask in standing.items():
        world = sweeps.read(number).world
        chosen = np.random.default_rng(number).random(len(world)) < share
        still.append(world[mask & chosen])
        moved.append(world[~mask])
    page = Page((_WIDTH, 1000))
    page.title("From above", "grey: what stands; red: left out, because rays passed it")
    axes = page.chart((_LEFT, 0.09, 0.86, 0.76), xlabel="x, m", ylabel="y, m")
    for parts, colour, size, most in (
        (still, theme.UNSEEN, 1.0, _STANDING_DOTS),
        (moved, _MOVED_COLOUR, 1.6, _MOVED_DOTS),
    ):
        points = np.concatenate(parts)
        points = points[:: max(-(-len(points) // most), 1)]
        dots = size * page.unit**2
        axes.scatter(points[:, 0], points[:, 1], c=colour, s=dots, lw=0, rasterized=True)
    path = sweeps.alignment.poses[:, :3, 3]
    axes.plot(path[:, 0], path[:, 1], color=_PATH_COLOUR, lw=1.6 * page.unit)
    near = np.concatenate(still)
    low, high = np.quantile(near[:, :2], (0.01, 0.99), axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="datalim")
    return page


def draw_errors(figures: Mapping[str, Any]) -> Page:
    """Draw the differences of ranges along the drive, and by range."""
    page = Page((_WIDTH, 560))
    page.title("Differences of ranges", "of held-out sweeps; dots: half, bars: 90 % are smaller")
    rows = (
        (figures["held_out"]["by_sweep"], "sweep", "sweep"),
        (figures["held_out"]["by_range"], "from_m", "range from, m"),
    )
    for index, (entries, key, label) in enumerate(rows):
        axes = page.chart((_LEFT + 0.46 * index, 0.17, 0.38, 0.56), xlabel=label, ylabel="mm")
        known = [entry for entry in entries if entry["median_size_m"] is not None]
        x = [entry[key] for entry in known]
        half = [1000 * entry["median_size_m"] for entry in known]
        most = [1000 * entry["p90_size_m"] for entry in known]
        axes.vlines(x, half, most, color=theme.UNSEEN, lw=1.8 * page.unit)
        axes.plot(x, half, "o", color=theme.OBJECT_COLOURS[0], ms=4 * page.unit, mew=0)
        axes.set_yscale("log")
    return page
