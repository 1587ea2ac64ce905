"""Charts of the jobs of a data set, and the picture of one of its sweeps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from lidarsim.base.arrays import Bools, Floats
from lidarsim.base.sampling import even_indices
from lidarsim.base.words import plural, shortened
from lidarsim.columns.table import TABLE, Z, value_names
from lidarview.render import theme
from lidarview.render.colouring import colours_of
from lidarview.render.picture_page import FONT, Page, label_logarithms

from ..datasets.figures import Figures, Varied
from ..datasets.sweep_data import Sweep
from .page.rendering import NARROW

WIDTH = 1600
MOST_VARIED = 8  # quantities in a picture
ACROSS = 4  # of them side by side
MOST_DOTS = 5_000
DOT = "#5b8fd0"
BAR = "#7aa5d8"
# pixels around the charts
LEFT = 118
RIGHT = 40
TOP = 186
BETWEEN = 78  # columns of charts
# heights: histogram, dots, and labels under them
COUNTS = 120
GAP = 20
AGAINST = 340
BELOW = 60
SLANTED = 56  # more below slanted labels
ABOVE = 76  # from one row of charts to the next
MIDDLE = (10, 50, 90)  # percentiles of the points of jobs with near values
MOST_COLOURS = 6  # labels that have colours of their own
# of jobs, by value, whose medians are drawn: so many, of at least so many
_GROUPS = 12
_GROUP = 8
SWEEP_SIZE = (1600, 1000)
SWEEP_DOTS = 150_000
SWEEP_FRAME = (90, 60, 1210, 750)  # left, bottom, width, height of the drawing, pixels
SWEEP_SHARE = 0.97  # of the points that are within the drawing
SWEEP_VALUES = 4  # that are named


def draw_varied(figures: Figures) -> Page | None:
    """Draw a histogram of each varied quantity above the points of each job against it.

    Jobs have the colours of the quantity of few labels that tells most about their points. None
    where nothing was varied or no job has run.
    """
    there = [varied for varied in figures.varied if len(varied.there)]
    if not there:
        return None
    scales = [varied.folded() for varied in there[:MOST_VARIED]]
    rows = -(-len(scales) // ACROSS)
    across = -(-len(scales) // rows)
    wide = (WIDTH - LEFT - RIGHT - BETWEEN * (across - 1)) / across
    below = BELOW + SLANTED * any(scale.slanted(wide) for scale in scales)
    high = COUNTS + GAP + AGAINST + below
    page = Page((WIDTH, TOP + rows * high + (rows - 1) * ABOVE))
    points = figures.each("points")
    failures = figures.failures
    limits = _limits(points[~failures])
    telling = _most_telling(scales, points, ~failures)
    colours = np.tile(theme.rgb(DOT), (len(points), 1))
    if telling is not None:
        some = theme.object_colours(len(telling.labels))
        known = np.isfinite(telling.values)
        colours[known] = some[telling.values[known].astype(np.intp)]
    for number, scale in enumerate(scales):
        row, column = divmod(number, across)
        left = LEFT + column * (wide + BETWEEN)
        top = TOP + row * (high + ABOVE)
        upper = _chart(page, left, top, wide, COUNTS)
        lower = _chart(page, left, top + COUNTS + GAP, wide, AGAINST)
        bars = some if scale is telling else [BAR]
        _draw_counts(upper, scale, failures, bars)
        _draw_points(page, lower, scale, points, failures, colours)
        lower.set_ylim(limits)
        for axes, quantity in ((upper, "jobs"), (lower, "points of a job")):
            _set_labels(page, axes, scale, wide)
            if column == 0:
                axes.set_ylabel(quantity)
                axes.yaxis.set_label_coords(-78 / wide, 0.5)
        upper.tick_params(which="both", labelbottom=False, bottom=False)
        lower.tick_params(labelleft=column == 0)
        name = shortened(scale.name, int(wide / 13.8))
        page.heading(upper, name, weight="bold", pad=4 * page.unit)
    page.title(
        "What was varied, and the points that came of it",
        "Above, the jobs by value. Below, a dot for each job; the median of jobs with near values, "
        "and the range of their middle 80%.",
        _remarks(figures, telling, len(there) - len(scales)),
    )
    return page


def _remarks(figures: Figures, telling: Varied | None, more: int) -> str:
    """Sentence about colours, failures and `more` quantities that are not drawn."""
    told = []
    if telling is not None:
        told.append(f"coloured by {shortened(telling.name, 40)}")
    if failed := int(figures.failures.sum()):
        told.append(f"red: {plural(failed, 'failed job')}")
    if figures.done > MOST_DOTS:
        told.append(f"{MOST_DOTS:,} of {figures.done:,} jobs have dots")
    if more:
        told.append(f"{plural(more, 'more quantity', 'more quantities')} in jobs.csv")
    text = "; ".join(told)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _most_telling(scales: Sequence[Varied], points: Floats, done: Bools) -> Varied | None:
    """Quantity of few labels whose groups have the most different points; None without any."""
    between = {}  # {quantity: variance of the means of its groups}
    for scale in scales:
        known = done & np.isfinite(scale.values)
        if 2 <= len(scale.labels) <= MOST_COLOURS and known.any():
            groups = scale.values[known].astype(np.intp)
            means = np.bincount(groups, points[known]) / np.bincount(groups).clip(1)
            between[scale] = float(np.var(means[groups]))
    return max(between, key=lambda scale: between[scale], default=None)


def draw_results(figures: Figures) -> Page | None:
    """Draw how points, hits and seconds of casting are distributed over jobs; None without any."""
    done = ~figures.failures
    if not done.any():
        return None
    points, rays, hits, seconds = (
        figures.each(name)[done] for name in ("points", "rays", "hits", "seconds")
    )
    with np.errstate(invalid="ignore"):
        quantities = (
            Varied("points of a job", points),
            Varied("rays that hit, per cent", 100 * hits / rays),
            Varied("casting a job, all its tasks, s", seconds),
        )
    high = 250
    top = 128
    page = Page((WIDTH, top + high + 92))
    wide = (WIDTH - LEFT - RIGHT - BETWEEN * 2) / 3
    for column, quantity in enumerate(quantities):
        axes = _chart(page, LEFT + column * (wide + BETWEEN), top, wide, high)
        _draw_counts(axes, quantity, np.zeros(len(points), np.bool_), [BAR])
        _set_labels(page, axes, quantity, wide)
        axes.set_xlabel(quantity.name)
        if len(quantity.there):
            axes.axvline(float(np.median(quantity.there)), color=theme.INK, lw=1.1 * page.unit)
    page.figure.axes[0].set_ylabel("jobs")
    page.title("What came of it", "Jobs by points, hits and time; the line is the median.")
    return page


def _chart(page: Page, left: float, top: float, wide: float, high: float) -> Axes:
    """Axes at a place in pixels, with a quiet frame."""
    width, height = page.size
    axes = page.chart((left / width, 1 - (top + high) / height, wide / width, high / height))
    axes.yaxis.set_major_locator(MaxNLocator(4 if high > COUNTS else 2, integer=True))
    axes.yaxis.set_major_formatter(_tick)
    axes.xaxis.grid(visible=False)
    axes.tick_params(which="both", color=theme.LINE)
    return axes


def _tick(value: float, _: object = None) -> str:
    """Write a number at an axis: «1.5 M»."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= 10 * size or (abs(value) >= size and letter != "k"):
            return f"{value / size:.4g}{NARROW}{letter}"
    return f"{value:,.6g}"


def _draw_counts(axes: Axes, scale: Varied, failures: Bools, colours: Iterable[Any]) -> None:
    """Draw a histogram, its bars in `colours`, and in front of it that of failed jobs."""
    wide = 0.7 if scale.labels else 1.0  # labels are apart, since they have no order
    edges = scale.edges.tolist()
    failed = scale.values[failures & np.isfinite(scale.values)]
    counts, *_ = axes.hist(scale.there, edges, rwidth=wide)
    for bar, colour in zip(axes.patches, cycle(colours)):
        bar.set_facecolor(colour)
    axes.hist(failed, edges, rwidth=wide, color=theme.SENSOR)
    axes.set_ylim(0, 1.1 * max(1, np.max(counts)))


def _draw_points(
    page: Page, axes: Axes, scale: Varied, points: Floats, failures: Bools, colours: Floats
) -> None:
    """Draw a dot for each job, the failed ones at the bottom, and percentiles."""
    unit = page.unit
    known = np.isfinite(scale.values)
    done = np.flatnonzero(known & ~failures)
    some = done[even_indices(len(done), MOST_DOTS)]
    places = scale.values.copy()
    if scale.labels:  # spread over the bar, the same in each picture of the same jobs
        places += 0.5 * (np.arange(len(places)) * 0.618034 % 1 - 0.5)
    size = float(np.clip(300 / np.sqrt(max(len(some), 1)), 4, 30)) * unit**2
    alpha = float(np.clip(16 / np.sqrt(max(len(some), 1)), 0.25, 0.85))
    axes.scatter(
        places[some], points[some], s=size, c=colours[some], alpha=alpha, linewidths=0,
        clip_on=False, rasterized=True,
    )  # fmt: skip
    if scale.labels:  # a bar for each
        bins = np.unique(scale.values[done])
        groups = [done[scale.values[done] == number] for number in bins]
        middles = (bins[:, None] + [-0.35, 0.35, np.nan]).ravel()
    else:
        count = min(_GROUPS, len(done) // _GROUP)
        ordered = done[np.argsort(places[done], kind="stable")]
        groups = np.array_split(ordered, count) if count > 1 else []
        middles = np.array([np.median(places[group]) for group in groups])
    if groups:
        percentiles = [np.percentile(points[group], MIDDLE) for group in groups]
        lows, medians, highs = np.repeat(percentiles, len(middles) // len(groups), axis=0).T
        axes.fill_between(middles, lows, highs, color=theme.MUTED, alpha=0.18, lw=0)
        axes.plot(middles, medians, color=theme.INK, lw=1.6 * unit, solid_joinstyle="round")
    failed = np.flatnonzero(known & failures)
    failed = failed[even_indices(len(failed), MOST_DOTS)]
    axes.scatter(
        places[failed], np.zeros(len(failed)), marker="x", s=18 * unit**2, color=theme.SENSOR,
        linewidths=0.9 * unit, clip_on=False, zorder=5, rasterized=len(failed) > 200,
        transform=axes.get_xaxis_transform(),
    )  # fmt: skip


def _limits(points: Floats) -> tuple[float, float]:
    """Limits of an axis of points: from 0, unless all jobs have nearly the same."""
    if not len(points):
        return 0.0, 1.0
    low = float(points.min())
    high = float(points.max())
    if low > 0.6 * high:
        aside = 0.2 * (high - low) or 0.5 * high
        return low - aside, high + aside
    return 0.0, 1.06 * max(high, 1.0)


def _set_labels(page: Page, axes: Axes, scale: Varied, wide: float) -> None:
    """Set the limits of the axis of values, and name its bins or numbers."""
    axis, (low, high) = axes.xaxis, scale.edges[[0, -1]].tolist()
    if scale.labels:
        axes.set_xlim(low, high)
        style: dict[str, Any] = {"parse_math": False, "fontsize": 6.8 * page.unit, "family": FONT}
        if scale.slanted(wide):
            style |= {"rotation": 28, "ha": "right", "rotation_mode": "anchor"}
        axis.set_ticks(range(len(scale.labels)), scale.short_labels, **style)
        return
    if scale.is_log:
        axes.set_xscale("log")
        axes.set_xlim(low * (low / high) ** 0.02, high * (high / low) ** 0.02)
        label_logarithms(axis, high < 1000 * low)
    else:
        axes.set_xlim(low - 0.02 * (high - low), high + 0.02 * (high - low))
        whole = bool((scale.edges % 1 == 0.5).all())  # bins of whole numbers
        few = max(2, min(6, int(wide / 90)))
        axis.set_major_locator(MaxNLocator(few, integer=whole, min_n_ticks=1))
    axis.set_major_formatter(_tick)


def draw_sweep(sweep: Sweep, names: Mapping[int, str]) -> Page:
    """Draw the points of a sweep in the sensor's axes, coloured by class, or else by height."""
    page = Page(SWEEP_SIZE)
    frame = np.divide(SWEEP_FRAME, SWEEP_SIZE * 2)
    axes = page.chart((frame[0], frame[1], frame[2], frame[3]))
    some = slice(None, None, max(1, -(-len(sweep) // SWEEP_DOTS)))
    points = sweep.points[some]
    classes = None if sweep.classes is None else sweep.classes[some]
    values = [
        f"{name} {f'{value:.4g}' if isinstance(value, float) else shortened(str(value))}"
        for name, value in list(sweep.values.items())[:SWEEP_VALUES]
    ]
    page.title(
        f"A sweep of job {sweep.job}",
        f"{plural(len(sweep), 'point')} from above, metres in the sensor's axes",
        ", ".join(values),
    )
    if classes is not None and len(np.unique(classes)) > 1:
        colouring = colours_of(classes, TABLE["class"], value_names({0: "none", **names}))
        page.legend(colouring.labels, "sensor")
        painted = colouring.paint(classes)
    else:
        painted = colours_of(points[:, 2], Z).paint(points[:, 2])
    reach = 1.0
    if len(points):
        reach = float(np.percentile(np.abs(points[:, :2]).max(axis=1), 100 * SWEEP_SHARE))
    ratio = SWEEP_FRAME[2] / SWEEP_FRAME[3]
    axes.set_xlim(-reach * ratio, reach * ratio)
    axes.set_ylim(-reach, reach)
    axes.scatter(points[:, 0], points[:, 1], s=3 * page.unit**2, c=painted, lw=0, rasterized=True)
    axes.plot(0, 0, marker="o", color=theme.SENSOR, ms=7 * page.unit)
    return page
