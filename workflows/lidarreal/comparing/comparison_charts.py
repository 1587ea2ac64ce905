"""Charts of the comparison of two clouds or recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize

from lidarsim.numerics.arrays import AnyArray, Floats
from lidarsim.numerics.even_samples import even_indices
from lidarsim.words import plural
from lidarview.page_templates import millimeters
from lidarview.render import theme
from lidarview.render.picture_page import Page, label_logarithms

from .comparison_data import CELLS, ComparisonData
from .range_image import RangeImages

WIDTH = 1600  # width of the pages, in pixels
# Left and right edge of the charts, as fractions of the width.
LEFT = 0.075
RIGHT = 0.845
MAX_DOTS = 120_000
# Colors of A and B.
A_COLOR = "#4477aa"
B_COLOR = "#ee7733"
# Colors of cells without a return. They do not occur in the color map of residuals.
ONLY_A = theme.rgb("#2ca25f")
ONLY_B = theme.rgb("#101418")
NO_RETURN = theme.rgb("#c8cbd0")  # independent of the page's color theme
GAP_LABELS = ("return in A only", "return in B only", "no return")
# Color maps.
RESIDUAL_COLORS = "RdBu_r"
DISTANCE_COLORS = "plasma"
RESIDUAL_SCALE = 6.0  # end of the scale in median absolute deviations, about four sigma
MIN_DISTANCE_M = 0.001  # lower end of the distance scale


class _ImageLayout(NamedTuple):
    """Heights, in pixels, of the elements on a page with three range images."""

    image_height: int
    page_height: int
    top: int = 150
    gap: int = 62
    bottom: int = 90

    @classmethod
    def for_rows(cls, row_count: int) -> _ImageLayout:
        image_height = int(np.clip(2.2 * row_count, 90, 300))
        defaults = cls._field_defaults
        gaps = defaults["top"] + 2 * defaults["gap"] + defaults["bottom"]
        return cls(image_height, 3 * image_height + gaps)

    def image_bottom(self, number: int) -> float:
        """Return the lower edge of an image, numbered from 0, as a fraction of the page height."""
        pixels = self.page_height - self.top - (number + 1) * self.image_height - number * self.gap
        return pixels / self.page_height


def draw_ranges(comparison: ComparisonData) -> Page:
    """Draw the range images of A and B and the image of their residuals, one below the other."""
    images = comparison.images
    assert images is not None
    row_count, column_count = images.ranges[0].shape
    layout = _ImageLayout.for_rows(row_count)
    page = Page((WIDTH, layout.page_height))
    size = f"{plural(row_count, 'ring')}, {plural(column_count, 'column')}"
    page.title("Range images", f"{size}, {images.step_deg:.4g}° per column")
    range_scale = _range_scale(images)
    limit = _residual_limit(comparison)
    residual_scale = Normalize(-limit, limit)
    fraction = layout.image_height / layout.page_height
    for number, words in enumerate(("A", "B", "A − B")):
        frame = (LEFT, layout.image_bottom(number), RIGHT - LEFT, fraction)
        axes = page.chart(frame, ylabel="elevation, °")
        if number < 2:
            colors = _range_colors(images, number, range_scale)
        else:
            colors = _residual_colors(images, residual_scale)
            axes.set_xlabel("azimuth, °")
            _draw_gap_legend(page, axes)
        _show_image(axes, images, colors)
        page.heading(axes, words)
    ramp = np.linspace(0, 1, 256)
    frame = (0.862, layout.image_bottom(1), 0.014, 2 * fraction + layout.gap / layout.page_height)
    page.color_bar(theme.apply_colormap(theme.RANGE_COLORS, ramp), range_scale, "range, m", frame)
    frame = (0.862, layout.bottom / layout.page_height, 0.014, fraction)
    page.color_bar(theme.apply_colormap(RESIDUAL_COLORS, ramp), residual_scale, "A − B, mm", frame)
    return page


def _range_scale(images: RangeImages) -> LogNorm:
    ranges = np.concatenate([image[np.isfinite(image)] for image in images.ranges])
    min_m, max_m = np.quantile(ranges, (0.01, 0.98)) if len(ranges) else (0.0, 1.0)
    return LogNorm(max(float(min_m), 0.01), max(float(max_m), float(min_m) * 1.01, 0.02))


def _range_colors(images: RangeImages, index: int, scale: LogNorm) -> AnyArray:
    ranges = np.nan_to_num(images.ranges[index], nan=1.0)
    colors = theme.apply_colormap(theme.RANGE_COLORS, scale(ranges).filled(0))
    colors[~images.return_masks[index]] = NO_RETURN
    return colors


def _residual_colors(images: RangeImages, scale: Normalize) -> AnyArray:
    """Return the pixel colors of the residual image, including those of cells without a return."""
    residual = images.ranges[0] - images.ranges[1]
    in_a, in_b = images.return_masks
    colors = theme.apply_colormap(RESIDUAL_COLORS, scale(1000 * np.nan_to_num(residual)).data)
    colors[~in_a & ~in_b] = NO_RETURN
    colors[in_a & ~in_b] = ONLY_A
    colors[~in_a & in_b] = ONLY_B
    return colors


def _draw_gap_legend(page: Page, axes: Axes) -> None:
    for text, color in zip(GAP_LABELS, (ONLY_A, ONLY_B, NO_RETURN), strict=True):
        axes.plot([], [], "s", color=color, ms=4, label=text)
    _draw_legend(page, axes)


def _show_image(axes: Axes, images: RangeImages, colors: AnyArray) -> None:
    """Show a range image from the viewpoint of the sensor, with the sensor's left on the left.

    The image has shape (r, c, …).
    """
    row_count, column_count = colors.shape[:2]
    start_deg = images.start_deg - images.step_deg / 2
    stop_deg = start_deg + column_count * images.step_deg
    extent = (stop_deg, start_deg, row_count - 0.5, -0.5)
    axes.imshow(colors[:, ::-1], aspect="auto", interpolation="nearest", extent=extent)
    rows = np.unique(np.linspace(0, row_count - 1, min(row_count, 5)).round().astype(int))
    axes.set_yticks(rows, [f"{images.elevation_deg[row]:.1f}" for row in rows])
    axes.grid(False)


def draw_rings(comparison: ComparisonData) -> Page:
    """Draw each ring's residuals and lost returns, and a histogram of all residuals."""
    image = comparison.figures["ranges"]
    rings = [ring for ring in image["rings"] if ring["cells"]]
    page = Page((WIDTH, 760))
    page.title("Residuals by ring", f"A − B in {image['residual']['cells']:,} {image['paired_by']}")
    has_gaps = image["no_return"] is not None
    width = 0.225 if has_gaps else 0.4
    gap = 0.0975 if has_gaps else 0.1
    second_x = LEFT + width + gap
    third_x = second_x + (width + gap)
    frames = [(x, 0.13, width, 0.64) for x in (LEFT, second_x, third_x)]
    limit = _residual_limit(comparison)
    axes = page.chart(frames[0], xlabel="A − B, mm", ylabel="elevation, °")
    _draw_ring_residuals(page, axes, rings, limit)
    if has_gaps:
        axes = page.chart(frames[1], xlabel="cells without a return, %")
        _draw_ring_gaps(page, axes, image["rings"])
    frame = frames[2] if has_gaps else frames[1]
    axes = page.chart(
        frame, xlabel="A − B, mm (outer bins include larger values)", ylabel="cells", yscale="log"
    )
    _draw_residual_histogram(axes, comparison.residuals, limit)
    return page


def _draw_residual_histogram(axes: Axes, residuals: Floats, limit: float) -> None:
    bin_mm = np.ceil(limit / 25) if limit > 10 else limit / 25  # ranges are often whole millimeters
    outer = np.floor(limit / bin_mm) + 0.5
    edges = np.arange(-outer, outer + 1) * bin_mm
    values = np.clip(1000 * residuals, edges[0], edges[-1])
    counts, *_ = axes.hist(values, bins=edges.tolist(), color=A_COLOR)
    label_logarithms(axes.yaxis, np.max(counts) < 1000)


def _marker_size(page: Page, rings: Sequence[Any]) -> float:
    """Return the marker size for rings, in points."""
    return 3.4 * page.unit if len(rings) < 40 else 2 * page.unit


def _draw_ring_residuals(
    page: Page, axes: Axes, rings: Sequence[Mapping[str, Any]], limit: float
) -> None:
    """Draw the mean, median and spread of the residuals in each ring.

    The axis ends at `limit`, in millimeters.
    """
    elevation = np.array([ring["elevation_deg"] for ring in rings])
    p05, median, p95, mean = (
        1000 * np.array([ring[name] for ring in rings])
        for name in ("p05_m", "median_m", "p95_m", "bias_m")
    )
    line_width = float(np.clip(150 / max(len(rings), 1), 0.7, 4)) * page.unit
    axes.hlines(elevation, p05, p95, color=theme.UNSEEN, lw=line_width, label="5 to 95 %")
    axes.axvline(0, color=theme.MUTED, lw=0.7 * page.unit)
    size = _marker_size(page, rings)
    axes.plot(median, elevation, "o", color=A_COLOR, ms=size, mew=0, label="median")
    mean_style: dict[str, Any] = {"color": theme.EMPHASIS, "ms": 2 * size, "mew": 0.8 * page.unit}
    axes.plot(mean, elevation, "|", label="mean", **mean_style)
    axes.set_xlim(-limit, limit)
    _draw_legend(page, axes)


def _draw_ring_gaps(page: Page, axes: Axes, rings: Sequence[Mapping[str, Any]]) -> None:
    """Draw each ring's percentage of cells without a return in A and in B."""
    counts = np.array([[ring["no_return"][name] for name in CELLS] for ring in rings])
    has_returns = counts[:, 1:].any(axis=1)
    counts = counts[has_returns]
    elevation = np.array([ring["elevation_deg"] for ring in rings])[has_returns]
    style: dict[str, Any] = {"ms": _marker_size(page, rings), "mew": 0, "lw": 0.6 * page.unit}
    for color, state, label in ((A_COLOR, 1, "A"), (B_COLOR, 2, "B")):
        fraction = 100 * (counts[:, 0] + counts[:, state]) / counts.sum(axis=1)
        axes.plot(fraction, elevation, "o-", color=color, label=label, **style)
    axes.set_xlim(left=min(0, axes.get_xlim()[0]))
    _draw_legend(page, axes)


def draw_distances(comparison: ComparisonData) -> Page:
    """Draw the distributions of distances in both directions, and of intensities if available."""
    page = Page((WIDTH, 760))
    distances = comparison.figures["distances"]
    page.title(
        "Distances to the nearest neighbor",
        f"median distances: A to B {millimeters(distances['a_to_b']['median_m'])}, B to A "
        f"{millimeters(distances['b_to_a']['median_m'])}",
    )
    intensity = comparison.figures["intensity"]
    axes = page.chart(
        (LEFT, 0.13, 0.4 if intensity else 0.77, 0.64),
        xlabel="distance, m",
        ylabel="points within, %",
        xscale="log",
        ylim=(0, 101),
    )
    fractions = np.linspace(0, 1, 1001)
    labels = ("A to B", "B to A")
    for values, color, label in zip(comparison.distances, (A_COLOR, B_COLOR), labels, strict=True):
        quantiles = np.quantile(values, fractions).clip(MIN_DISTANCE_M)
        axes.plot(quantiles, 100 * fractions, color=color, lw=1.4 * page.unit, label=label)
    max_m = max(float(np.quantile(values, 0.999)) for values in comparison.distances)
    right_m = max(2 * max_m, 0.01)
    axes.set_xlim(MIN_DISTANCE_M, right_m)
    label_logarithms(axes.xaxis, right_m < 1000 * MIN_DISTANCE_M)
    for score in distances["f_scores"]:
        axes.axvline(score["distance_m"], color=theme.LINE, lw=0.9 * page.unit, ls=(0, (4, 3)))
    _draw_legend(page, axes)
    if intensity:
        _draw_intensities(page, comparison)
    return page


def _draw_intensities(page: Page, comparison: ComparisonData) -> None:
    """Draw a two-dimensional histogram of paired intensities on the right half of the page."""
    figures = comparison.figures["intensity"]
    frame = (LEFT + 0.5, 0.13, 0.4, 0.64)
    name_a, name_b = figures["columns"]["a"], figures["columns"]["b"]
    scales = ("energy",) * 2 if figures["same_scale"] else ("scale of B", "scale of A")
    axes = page.chart(
        frame, xlabel=f"{name_b} in B, {scales[0]}", ylabel=f"{name_a} in A, {scales[1]}"
    )
    intensity_a, intensity_b = comparison.intensities
    bins = _intensity_bins(intensity_b), _intensity_bins(intensity_a)
    if figures["same_scale"]:
        both = max(bins, key=lambda edges: edges[-1])
        bins = both, both
    axes.hist2d(intensity_b, intensity_a, bins, norm=LogNorm(), cmap="viridis", rasterized=True)
    axes.locator_params(nbins=6)  # labels of small numbers are long
    axes.grid(False)
    correlation = f"rank correlation {figures['rank_correlation']:.3f}"
    page.heading(axes, f"{correlation}, {figures['pairs']:,} {figures['of']}")


def draw_above(comparison: ComparisonData) -> Page:
    """Draw a top view of both clouds, coloring each point by its distance to the other cloud."""
    height = 830
    page = Page((WIDTH, height))
    pictured = comparison.figures["pictured"]
    which = "" if pictured is None else f"sweep {pictured[0]} of A and sweep {pictured[1]} of B, "
    page.title(
        "Top view", f"{which}colored by the distance to the nearest point of the other cloud"
    )
    clouds = comparison.points
    distances = [d[: len(points)] for d, points in zip(comparison.distances, clouds, strict=True)]
    lower = np.min([np.quantile(points[:, :2], 0.01, axis=0) for points in clouds], axis=0)
    upper = np.max([np.quantile(points[:, :2], 0.99, axis=0) for points in clouds], axis=0)
    half_side = 1.06 * max(float((upper - lower).max()), 1e-3) / 2
    limits = (lower + upper) / 2 + half_side * np.array([[-1.0], [1.0]])
    width = 0.36
    chart_height = 0.36 * WIDTH / height
    scale = _distance_scale(np.concatenate(distances))
    for number, points in enumerate(clouds):
        frame = (LEFT + number * (width + 0.045), 0.12, width, chart_height)
        axes = page.map_chart(frame, limits, tick_count=6)
        if number:
            axes.set_ylabel("")
        _scatter_points(page, axes, points, distances[number], scale)
        page.heading(axes, ("A, distance to B", "B, distance to A")[number])
    frame = (0.875, 0.12, 0.014, chart_height)
    page.color_bar(
        theme.apply_colormap(DISTANCE_COLORS, np.linspace(0, 1, 256)), scale, "distance, m", frame
    )
    return page


def _distance_scale(distances: Floats) -> LogNorm:
    max_m = max(float(np.quantile(distances, 0.99)), 10 * MIN_DISTANCE_M)
    min_m = max(MIN_DISTANCE_M, min(float(np.quantile(distances, 0.05)), max_m / 10))
    return LogNorm(min_m, max_m)


def _scatter_points(
    page: Page, axes: Axes, points: Floats, distances: Floats, scale: LogNorm
) -> None:
    """Draw a top view of points colored by distance, with the largest distances on top."""
    rows = even_indices(len(points), MAX_DOTS)
    rows = rows[np.argsort(distances[rows])]
    axes.scatter(
        points[rows, 0],
        points[rows, 1],
        c=np.maximum(distances[rows], scale.vmin or 0.0),
        cmap=DISTANCE_COLORS,
        norm=scale,
        s=(1.6 if len(rows) > 40_000 else 3) * page.unit**2,
        lw=0,
        rasterized=True,
    )


def _residual_limit(comparison: ComparisonData) -> float:
    """Return the upper limit of the residual scale, in millimeters."""
    residual = comparison.figures["ranges"]["residual"]
    if not residual["cells"]:
        return 1
    return max(1000 * (abs(residual["median_m"]) + RESIDUAL_SCALE * residual["mad_m"]), 0.1)


def _intensity_bins(values: AnyArray) -> AnyArray:
    """Return the edges of histogram bins for intensities.

    Integers are at the centers of their bins.
    """
    upper = max(float(np.quantile(values, 0.995)), 1e-12)
    if upper <= 300 and (values == np.round(values)).all():
        return np.arange(-0.5, upper + 1)
    return np.linspace(0, upper, 121)


def _draw_legend(page: Page, axes: Axes) -> None:
    handles, _ = axes.get_legend_handles_labels()
    style = {"ncols": len(handles), "columnspacing": 1.2, "borderaxespad": 0.3}
    page.key(handles, 6.8, axes, loc="lower right", bbox_to_anchor=(1, 1), **style)
