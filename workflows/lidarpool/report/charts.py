"""Draw charts of a data set's jobs, and an image of one of its sweeps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from lidarfiles.datasets.figures import DataSetStatistics, VariedQuantity
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import TABLE, Z, names_by_value
from lidarsim.numerics.arrays import Bools, Floats, Indices
from lidarsim.numerics.even_samples import even_indices
from lidarsim.words import format_rounded, plural, shorten_name
from lidarview.page_templates import NARROW
from lidarview.render import theme
from lidarview.render.coloring import make_coloring
from lidarview.render.picture_page import FONT, Page, label_logarithms

WIDTH = 1600
MAX_VARIED = 8  # quantities per picture
MAX_COLUMNS = 4  # charts side by side
MAX_DOTS = 5_000
DOT = "#5b8fd0"
BAR = "#7aa5d8"
# Layout of the charts, pixels.
LEFT = 118
RIGHT = 40
TOP = 186
COLUMN_GAP = 78  # between columns of charts
COUNTS_HEIGHT = 120  # histogram
GAP = 20  # between the histogram and the scatter plot
DOTS_HEIGHT = 340  # scatter plot
LABEL_HEIGHT = 60  # tick labels below the scatter plot
SLANTED_HEIGHT = 56  # additional height of slanted labels
ROW_GAP = 76  # between rows of charts
PERCENTILES = (10, 50, 90)  # percentiles of points per job, drawn for each group of jobs
MAX_COLORS = 6  # maximum number of labels with separate colors
_MAX_GROUPS = 12  # maximum number of groups of jobs with similar values
_MIN_GROUP = 8  # minimum average number of jobs per group
SWEEP_SIZE = (1600, 1000)
SWEEP_DOTS = 150_000
SWEEP_FRAME = (90, 60, 1210, 750)  # left, bottom, width and height of the plot, pixels
SWEEP_SHARE = 0.97  # share of the points that lie within the plot
MAX_VALUES = 4  # maximum number of varied values in the title


def draw_varied(figures: DataSetStatistics) -> Page | None:
    """Draw a histogram and a scatter plot for each varied quantity.

    The scatter plot below each histogram shows the number of points of each job as a function of
    the quantity. Jobs are colored by the most informative quantity: of the quantities with few
    labels, the one whose groups of jobs differ most in their mean number of points. Return None if
    there are no varied quantities or no jobs.
    """
    drawable = [varied for varied in figures.varied_quantities if len(varied.known_values)]
    if not drawable:
        return None
    scales = [varied.merge_rare_labels() for varied in drawable[:MAX_VARIED]]
    layout = _Layout.for_scales(scales)
    page = Page((WIDTH, layout.page_height))
    points = figures.per_job("points")
    failures = figures.failures
    limits = _axis_limits(points[~failures])
    informative = _most_informative(scales, points, ~failures)
    colors = _dot_colors(informative, len(points))
    for number, scale in enumerate(scales):
        upper, lower = layout.add_charts(page, number)
        bars: Iterable[Any] = [BAR]
        if scale is informative:
            bars = theme.object_colors(len(scale.labels))
        _draw_counts(upper, scale, failures, bars)
        _draw_points(page, lower, scale, points, failures, colors)
        lower.set_ylim(limits)
        layout.label_charts(page, number, scale, upper, lower)
    page.title(
        "Varied quantities and resulting points",
        "Top: number of jobs by value. Bottom: one dot per job, with the median and the central "
        "80 % of jobs with similar values.",
        _remarks(figures, informative, len(drawable) - len(scales)),
    )
    return page


class _Layout(NamedTuple):
    """Pixel positions and sizes of the charts on a page."""

    row_count: int
    column_count: int
    width: float  # of a chart
    row_height: int

    @classmethod
    def for_scales(cls, scales: Sequence[VariedQuantity]) -> _Layout:
        """Return a layout with two charts for each quantity."""
        rows = -(-len(scales) // MAX_COLUMNS)
        columns = -(-len(scales) // rows)
        width = (WIDTH - LEFT - RIGHT - COLUMN_GAP * (columns - 1)) / columns
        is_slanted = any(scale.needs_slanted_labels(width) for scale in scales)
        label_height = LABEL_HEIGHT + SLANTED_HEIGHT * is_slanted
        return cls(rows, columns, width, COUNTS_HEIGHT + GAP + DOTS_HEIGHT + label_height)

    @property
    def page_height(self) -> int:
        return TOP + self.row_count * self.row_height + (self.row_count - 1) * ROW_GAP

    def add_charts(self, page: Page, number: int) -> tuple[Axes, Axes]:
        """Add axes for the histogram and the scatter plot of a quantity."""
        row, column = divmod(number, self.column_count)
        x = LEFT + column * (self.width + COLUMN_GAP)
        y = TOP + row * (self.row_height + ROW_GAP)
        upper = _add_axes(page, x, y, self.width, COUNTS_HEIGHT)
        lower = _add_axes(page, x, y + COUNTS_HEIGHT + GAP, self.width, DOTS_HEIGHT)
        return upper, lower

    def label_charts(
        self, page: Page, number: int, scale: VariedQuantity, upper: Axes, lower: Axes
    ) -> None:
        """Label the axes of both charts of a quantity, and add the quantity's name as a heading."""
        is_first = number % self.column_count == 0
        for axes, quantity in ((upper, "jobs"), (lower, "points per job")):
            _set_labels(page, axes, scale, self.width)
            if is_first:
                axes.set_ylabel(quantity)
                axes.yaxis.set_label_coords(-78 / self.width, 0.5)
        upper.tick_params(which="both", labelbottom=False, bottom=False)
        lower.tick_params(labelleft=is_first)
        name = shorten_name(scale.name, int(self.width / 13.8))
        page.heading(upper, name, weight="bold", pad=4 * page.unit)


def _dot_colors(informative: VariedQuantity | None, count: int) -> Floats:
    """Return an RGB color for each job.

    If `informative` is given, jobs are colored by their labels in this quantity. The result has
    shape (jobs, 3).
    """
    colors = np.tile(theme.rgb(DOT), (count, 1))
    if informative is not None:
        label_colors = theme.object_colors(len(informative.labels))
        has_label = np.isfinite(informative.values)
        colors[has_label] = label_colors[informative.values[has_label].astype(np.intp)]
    return colors


def _remarks(figures: DataSetStatistics, informative: VariedQuantity | None, hidden: int) -> str:
    """Return a sentence about colors, failed jobs, and omitted dots and quantities."""
    remarks = []
    if informative is not None:
        remarks.append(f"colored by {shorten_name(informative.name, 40)}")
    if failed := int(figures.failures.sum()):
        remarks.append(f"red: {plural(failed, 'failed job')}")
    if figures.done > MAX_DOTS:
        remarks.append(f"dots are shown for {MAX_DOTS:,} of {figures.done:,} jobs")
    if hidden:
        remarks.append(f"{plural(hidden, 'more quantity', 'more quantities')} in jobs.csv")
    text = "; ".join(remarks)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _most_informative(
    scales: Sequence[VariedQuantity], points: Floats, is_done: Bools
) -> VariedQuantity | None:
    """Return the quantity whose groups differ most in their mean number of points.

    Return None if no quantity has between two and MAX_COLORS labels.
    """
    variances = {}  # {quantity: variance of the group means, weighted by the number of jobs}
    for scale in scales:
        is_known = is_done & np.isfinite(scale.values)
        if 2 <= len(scale.labels) <= MAX_COLORS and is_known.any():
            groups = scale.values[is_known].astype(np.intp)
            means = np.bincount(groups, points[is_known]) / np.bincount(groups).clip(1)
            variances[scale] = float(np.var(means[groups]))
    return max(variances, key=lambda scale: variances[scale], default=None)


def draw_results(figures: DataSetStatistics) -> Page | None:
    """Draw histograms of the number of points and the hit rate of each job.

    Return None if no job has succeeded.
    """
    is_done = ~figures.failures
    points, rays, hits = (figures.per_job(name)[is_done] for name in ("points", "rays", "hits"))
    with np.errstate(invalid="ignore"):
        quantities = (
            VariedQuantity("points per job", points),
            VariedQuantity("rays that hit, %", 100 * hits / rays),
        )
    return _draw_distributions(quantities, "Results", "Number of jobs by points and by hits")


def draw_times(figures: DataSetStatistics) -> Page | None:
    """Draw a histogram of the jobs' casting times, or return None if no times are known."""
    seconds = figures.per_job("seconds")[~figures.failures]
    seconds = seconds[np.isfinite(seconds)]
    quantity = VariedQuantity("casting time per job (all tasks), s", seconds)
    return _draw_distributions((quantity,), "Casting time", "Number of jobs by casting time")


def _draw_distributions(
    quantities: Sequence[VariedQuantity], title: str, caption: str
) -> Page | None:
    """Draw one histogram of all jobs for each quantity, side by side.

    Return None if there are no jobs.
    """
    if not len(quantities[0].values):
        return None
    height = 250
    top = 128
    page = Page((WIDTH, top + height + 92))
    width = (WIDTH - LEFT - RIGHT - COLUMN_GAP * (len(quantities) - 1)) / len(quantities)
    for column, quantity in enumerate(quantities):
        axes = _add_axes(page, LEFT + column * (width + COLUMN_GAP), top, width, height)
        _draw_counts(axes, quantity, np.zeros(len(quantity.values), np.bool_), [BAR])
        _set_labels(page, axes, quantity, width)
        axes.set_xlabel(quantity.name)
        if len(quantity.known_values):
            axes.axvline(
                float(np.median(quantity.known_values)), color=theme.INK, lw=1.1 * page.unit
            )
    page.figure.axes[0].set_ylabel("jobs")
    page.title(title, f"{caption}; the line marks the median.")
    return page


def _add_axes(page: Page, x: float, y: float, chart_width: float, chart_height: float) -> Axes:
    """Add axes with an unobtrusive frame.

    `x`, `y`, `chart_width` and `chart_height` are in pixels, measured from the top left corner.
    """
    width, height = page.size
    axes = page.chart(
        (x / width, 1 - (y + chart_height) / height, chart_width / width, chart_height / height)
    )
    axes.yaxis.set_major_locator(
        MaxNLocator(4 if chart_height > COUNTS_HEIGHT else 2, integer=True)
    )
    axes.yaxis.set_major_formatter(_format_tick)
    axes.xaxis.grid(visible=False)
    axes.tick_params(which="both", color=theme.LINE)
    return axes


def _format_tick(value: float, _: object = None) -> str:
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= 10 * size or (abs(value) >= size and letter != "k"):
            return f"{value / size:.4g}{NARROW}{letter}"
    return f"{value:,.6g}"


def _draw_counts(axes: Axes, scale: VariedQuantity, failures: Bools, colors: Iterable[Any]) -> None:
    """Draw a histogram with bars in `colors`, and stack a histogram of failed jobs on top."""
    bar_width = 0.7 if scale.labels else 1.0  # gaps show that labels have no order
    edges = scale.edges.tolist()
    failed = scale.values[failures & np.isfinite(scale.values)]
    counts, *_ = axes.hist(scale.known_values, edges, rwidth=bar_width)
    for bar, color in zip(axes.patches, cycle(colors)):
        bar.set_facecolor(color)
    axes.hist(failed, edges, rwidth=bar_width, color=theme.EMPHASIS)
    axes.set_ylim(0, 1.1 * max(1, np.max(counts)))


def _draw_points(
    page: Page, axes: Axes, scale: VariedQuantity, points: Floats, failures: Bools, colors: Floats
) -> None:
    """Draw a dot for each job, and crosses at the bottom for failed jobs.

    `points` has shape (jobs,), and `colors` has shape (jobs, 3).
    """
    unit = page.unit
    is_known = np.isfinite(scale.values)
    done_jobs = np.flatnonzero(is_known & ~failures)
    drawn = done_jobs[even_indices(len(done_jobs), MAX_DOTS)]
    x = scale.values.copy()
    if scale.labels:  # deterministic jitter within the bar, so that pictures are reproducible
        x += 0.5 * (np.arange(len(x)) * 0.618034 % 1 - 0.5)
    size = float(np.clip(300 / np.sqrt(max(len(drawn), 1)), 4, 30)) * unit**2
    alpha = float(np.clip(16 / np.sqrt(max(len(drawn), 1)), 0.25, 0.85))
    axes.scatter(
        x[drawn],
        points[drawn],
        s=size,
        c=colors[drawn],
        alpha=alpha,
        linewidths=0,
        clip_on=False,
        rasterized=True,
    )
    _draw_percentiles(axes, scale, x, points, done_jobs, 1.6 * unit)
    failed = np.flatnonzero(is_known & failures)
    failed = failed[even_indices(len(failed), MAX_DOTS)]
    axes.scatter(
        x[failed],
        np.zeros(len(failed)),
        marker="x",
        s=18 * unit**2,
        color=theme.EMPHASIS,
        linewidths=0.9 * unit,
        clip_on=False,
        zorder=5,
        rasterized=len(failed) > 200,
        transform=axes.get_xaxis_transform(),
    )


def _draw_percentiles(
    axes: Axes,
    scale: VariedQuantity,
    x: Floats,
    points: Floats,
    done_jobs: Indices,
    line_width: float,
) -> None:
    """Draw percentiles of `points` for groups of jobs with equal labels or similar `x`.

    Both arrays have shape (jobs,). Each group is drawn as a separate horizontal bar. A line that
    connects the groups would suggest a trend where the jobs differ in other quantities.
    """
    if scale.labels:
        bins = np.unique(scale.values[done_jobs])
        groups = [done_jobs[scale.values[done_jobs] == number] for number in bins]
        bars = bins[:, None] + [-0.35, 0.35, np.nan]
    else:
        groups = _group_similar_jobs(x, done_jobs)
        bars = _adjoining_bars([x[group] for group in groups])
    if groups:
        percentiles = [np.percentile(points[group], PERCENTILES) for group in groups]
        lower, median, upper = np.repeat(percentiles, 3, axis=0).T
        axes.fill_between(bars.ravel(), lower, upper, color=theme.MUTED, alpha=0.18, lw=0)
        axes.plot(bars.ravel(), median, color=theme.INK, lw=line_width, solid_capstyle="butt")


def _group_similar_jobs(x: Floats, jobs: Indices) -> list[Indices]:
    """Divide jobs into groups with similar values of `x`, in ascending order.

    `x` has shape (all jobs,), and `jobs` contains indices into it. Jobs with equal values are in
    the same group. Return an empty list if there are too few jobs.
    """
    count = min(_MAX_GROUPS, len(jobs) // _MIN_GROUP)
    if count < 2:
        return []
    limits = np.quantile(x[jobs], np.arange(1, count) / count, method="higher")
    number = np.searchsorted(np.unique(limits), x[jobs], side="right")
    groups = [jobs[number == k] for k in range(count)]
    return [group for group in groups if len(group)]


def _adjoining_bars(groups: Sequence[Floats]) -> Floats:
    """Return the left and right ends of the bar of each group.

    Bars of adjacent groups meet halfway between the groups. NaN interrupts the line that is drawn
    through the ends. The result has shape (groups, 3).
    """
    lowest = np.array([values.min() for values in groups])
    highest = np.array([values.max() for values in groups])
    midpoints = (highest[:-1] + lowest[1:]) / 2
    left = np.concatenate([lowest[:1], midpoints])
    right = np.concatenate([midpoints, highest[-1:]])
    return np.stack([left, right, np.full(len(groups), np.nan)], axis=1)


def _axis_limits(points: Floats) -> tuple[float, float]:
    """Return axis limits for the numbers of points.

    The axis starts at 0 unless all jobs have similar numbers of points.
    """
    if not len(points):
        return 0.0, 1.0
    lower = float(points.min())
    upper = float(points.max())
    if lower > 0.6 * upper:
        margin = 0.2 * (upper - lower) or 0.5 * upper
        return lower - margin, upper + margin
    return 0.0, 1.06 * max(upper, 1.0)


def _set_labels(page: Page, axes: Axes, scale: VariedQuantity, width: float) -> None:
    """Set the limits and tick labels of the x-axis."""
    axis = axes.xaxis
    lower, upper = scale.edges[[0, -1]].tolist()
    if scale.labels:
        axes.set_xlim(lower, upper)
        style: dict[str, Any] = {"parse_math": False, "fontsize": 6.8 * page.unit, "family": FONT}
        if scale.needs_slanted_labels(width):
            style |= {"rotation": 28, "ha": "right", "rotation_mode": "anchor"}
        axis.set_ticks(range(len(scale.labels)), scale.short_labels, **style)
        return
    if scale.is_log:
        axes.set_xscale("log")
        axes.set_xlim(lower * (lower / upper) ** 0.02, upper * (upper / lower) ** 0.02)
        label_logarithms(axis, upper < 1000 * lower)
    else:
        axes.set_xlim(lower - 0.02 * (upper - lower), upper + 0.02 * (upper - lower))
        is_integer = bool((scale.edges % 1 == 0.5).all())  # each bin is centered on an integer
        max_ticks = max(2, min(6, int(width / 90)))
        axis.set_major_locator(MaxNLocator(max_ticks, integer=is_integer, min_n_ticks=1))
    axis.set_major_formatter(_format_tick)


def draw_sweep(sweep: Sweep, names: Mapping[int, str]) -> Page:
    """Draw the points of a sweep in the sensor frame, as seen from above.

    Points are colored by class if there is more than one class, otherwise by height. `names` maps
    class numbers to names.
    """
    page = Page(SWEEP_SIZE)
    frame = np.divide(SWEEP_FRAME, SWEEP_SIZE * 2)
    axes = page.chart((frame[0], frame[1], frame[2], frame[3]))
    rows = slice(None, None, max(1, -(-len(sweep) // SWEEP_DOTS)))
    points = sweep.points[rows]
    classes = None if sweep.classes is None else sweep.classes[rows]
    known = [(name, value) for name, value in sweep.values.items() if value is not None]
    values = [
        f"{name} "
        f"{format_rounded(value, 4) if isinstance(value, float) else shorten_name(str(value))}"
        for name, value in known[:MAX_VALUES]
    ]
    page.title(
        f"A sweep of job {sweep.job}",
        f"{plural(len(sweep), 'point')}, seen from above, in meters in the sensor frame",
        ", ".join(values),
    )
    if classes is not None and len(np.unique(classes)) > 1:
        coloring = make_coloring(classes, TABLE["class"], names_by_value({0: "none", **names}))
        page.legend(coloring.labels, "sensor")
        painted = coloring.paint(classes)
    else:
        painted = make_coloring(points[:, 2], Z).paint(points[:, 2])
    reach = 1.0
    if len(points):
        reach = float(np.percentile(np.abs(points[:, :2]).max(axis=1), 100 * SWEEP_SHARE))
    ratio = SWEEP_FRAME[2] / SWEEP_FRAME[3]
    axes.set_xlim(-reach * ratio, reach * ratio)
    axes.set_ylim(-reach, reach)
    axes.scatter(points[:, 0], points[:, 1], s=3 * page.unit**2, c=painted, lw=0, rasterized=True)
    axes.plot(0, 0, marker="o", color=theme.SENSOR, ms=7 * page.unit)
    return page
