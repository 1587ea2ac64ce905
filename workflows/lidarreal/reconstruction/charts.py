"""Charts of a held-out sweep and its simulation, and of the accuracy of a reconstruction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm, Normalize

from lidarsim.numerics.arrays import Floats, Floats32
from lidarview.render import theme
from lidarview.render.picture_page import Page, label_logarithms

from .chart_data import MOVED_DOTS, STATIONARY_DOTS, SweepImages, TopViewPoints

_WIDTH = 1600
_LEFT = 0.075
_CHART_WIDTH = 0.77
_IMAGE_HEIGHT = 190
_GAP = 62
_ABOVE_HEIGHT = 1000
_ABOVE_FRAME = (_LEFT, 0.09, 0.86, 0.76)  # left, bottom, width and height relative to the page
_TOP = 150
_BOTTOM = 90
_DIFFERENCE_M = 0.1  # limit of the color scale for differences
_NO_RETURN = theme.rgb("#c8cbd0")
_MOVED_COLOR = "#d7301f"
_PATH_COLOR = "#08519c"


class _Image(NamedTuple):
    """Image of a sweep, with a caption and colors."""

    words: str
    values: Floats32  # (r, c)
    scale: Any  # Matplotlib norm
    colors: str  # name of a colormap


def draw_sweep(sweep: SweepImages) -> Page:
    """Draw the ranges and intensities of a recorded and a simulated sweep, and the differences."""
    images = _sweep_images(sweep)
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


def _sweep_images(sweep: SweepImages) -> list[_Image]:
    """Return the images of the recorded and the simulated sweep, and of their differences."""
    near_m, far_m = np.nanquantile(sweep.range_m, (0.01, 0.98)).tolist()
    ranges = LogNorm(max(near_m, 0.1), max(far_m, 1.0))
    differences = Normalize(-_DIFFERENCE_M, _DIFFERENCE_M)
    words = f"difference up to {1000 * _DIFFERENCE_M:.0f} mm (red: reconstruction is farther)"
    images = [
        _Image("range, recorded", sweep.range_m, ranges, theme.RANGE_COLORS),
        _Image("range, reconstructed", sweep.simulated_m, ranges, theme.RANGE_COLORS),
        _Image(words, sweep.simulated_m - sweep.range_m, differences, "RdBu_r"),
    ]
    if sweep.intensity is not None and sweep.simulated_intensity is not None:
        scale = Normalize(0, max(float(np.nanquantile(sweep.intensity, 0.98)), 1e-9))
        images.append(_Image("intensity, recorded", sweep.intensity, scale, "gray"))
        images.append(_Image("intensity, reconstructed", sweep.simulated_intensity, scale, "gray"))
    return images


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
        (moved, _MOVED_COLOR, 1.6, MOVED_DOTS),
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
