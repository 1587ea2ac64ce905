"""The card of a data set, README.md, its page, its figures and pictures of its jobs."""

from __future__ import annotations

import hashlib
import json
import math
import re
from array import array
from bisect import insort
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from ..base.arrays import AnyArray, Bools, Floats, Ints
from ..base.choice import one_of_each_part
from ..base.errors import LidarpoolError, explained
from ..base.storage import Storage
from ..base.words import counted
from ..export.folder import LAST_FILE
from ..export.jobs import JobRow
from ..export.loader import Sweep
from ..render import theme
from ..render.page import FONT, Page, shortened, without_common_prefix
from ..run.result import CampaignRun
from ..scenario.campaign import Campaign
from .page.page import NARROW, rendered
from .report import stage_figures

FAILED_MOST, SLOWEST_MOST = 200, 10  # jobs that are kept whole
_COUNTS = ("scans", "sweeps", "rays", "hits", "points")
WIDTH = 1600
MOST_VARIED = 8  # quantities in a picture
ACROSS = 4  # of them side by side
MOST_LABELS = 12  # bars; the rarest labels share the last one
MOST_DOTS = 5_000
DOT, BAR = "#5b8fd0", "#7aa5d8"
LEFT, RIGHT, TOP = 118, 40, 186  # pixels around the charts
BETWEEN = 78  # columns of charts
COUNTS, GAP, AGAINST, BELOW = 120, 20, 340, 60  # heights: histogram, dots, and labels under them
SLANTED = 56  # more below slanted labels
ABOVE = 76  # from one row of charts to the next
MIDDLE = (10, 50, 90)  # percentiles of the points of jobs with near values
MOST_COLOURS = 6  # labels that have colours of their own
_BINS = 24  # at most
_GROUPS, _GROUP = 12, 8  # of jobs, by value, whose medians are drawn: so many, of at least so many
_LETTER = 11.5  # width of a letter of a label, pixels
SWEEP_SIZE, SWEEP_DOTS = (1600, 1000), 150_000
SWEEP_FRAME = (90, 60, 1210, 750)  # left, bottom, width, height of the drawing, pixels
SWEEP_SHARE = 0.97  # of the points that are within the drawing
SWEEP_VALUES = 4  # that are named
CLASSES = 10  # with colours of their own, the most frequent
CARD, PAGE, PICTURES, SPLITS = "README.md", "report.html", "pictures", "splits"
VALUES_SHOWN = 12  # of a quantity with labels
_CAPTIONS = {
    "job": "One of the jobs.",
    "varied": "What was varied: jobs by value, and the points of each job against it.",
    "results": "What came of it: jobs by points, share of rays that hit, and time of casting.",
}


def rank_correlation(a: AnyArray, b: AnyArray) -> float | None:
    """Spearman's rank correlation, ties with their mean rank; None if one is constant or empty.

    Examples
    --------
    >>> rank_correlation(np.array([1.0, 2.0, 5.0, 9.0]), np.array([4.0, 3.0, 2.0, 1.0]))
    -1.0
    """
    if not len(a):
        return None
    ranks: list[Floats] = []
    for values in (a, b):
        _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
        ends = np.cumsum(counts)
        rank = (ends - (counts - 1) / 2)[inverse]
        ranks.append(rank - rank.mean())
    size = np.sqrt((ranks[0] @ ranks[0]) * (ranks[1] @ ranks[1]))
    return float(ranks[0] @ ranks[1] / size) if size else None


@dataclass(frozen=True, eq=False)
class Varied:
    """What one quantity was in each job: numbers, or labels if a job had text, true or false."""

    name: str
    values: Floats  # (n,): numbers, or places in `labels`; NaN in jobs without the quantity
    labels: tuple[str, ...]  # empty for numbers

    @property
    def there(self) -> Floats:
        """Values of the jobs that have one."""
        return self.values[np.isfinite(self.values)]


class Figures:
    """Totals, and a few numbers of each job: 40 bytes, and 9 for each varied quantity.

    Parameters
    ----------
    names
        Names of the varied quantities.
    jobs
        Rows of the table, which are read once; `add` takes more.
    """

    def __init__(self, names: Sequence[str], jobs: Iterable[JobRow] = ()) -> None:
        self.jobs = 0
        # {split: done jobs and their counts}, {class: points and the jobs that have it}
        self.splits: dict[str, Counter[str]] = {}
        self.classes: dict[int, Counter[str]] = {}
        self.failed: list[JobRow] = []  # the first of them
        self.slowest: list[JobRow] = []  # those that took longest to cast, the slowest first
        self._each = {name: array("d") for name in ("points", "rays", "hits", "seconds", "failed")}
        # Numbers, or places in the labels; and which of both.
        self._values = {name: array("d") for name in names}
        self._labelled = {name: array("b") for name in names}
        self._labels: dict[str, dict[str, int]] = {name: {} for name in names}
        self._digest = hashlib.sha256()
        for row in jobs:
            self.add(row)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_digest": None}  # a copy, as for charts, has no digest

    def add(self, row: JobRow) -> None:
        """Count one more job."""
        self.jobs += 1
        for name, kept in self._each.items():
            kept.append(not row.done if name == "failed" else getattr(row, name))
        for name, labels in self._labels.items():
            value = row.values.get(name, np.nan)
            if labelled := isinstance(value, str | bool | np.bool_):
                text = value if isinstance(value, str) else str(value).lower()
                value = labels.setdefault(text, len(labels))
            self._values[name].append(value)
            self._labelled[name].append(labelled)
        if not row.done:
            if len(self.failed) < FAILED_MOST:
                self.failed.append(row)
            return
        self._digest.update(f"{row.name} {row.sha256}\n".encode())
        counts = {name: getattr(row, name) for name in _COUNTS}
        self.splits.setdefault(row.split, Counter()).update(counts, jobs=1)
        for number, points in row.classes.items():
            self.classes.setdefault(number, Counter()).update(points=points, jobs=1)
        insort(self.slowest, row, key=lambda row: (-row.seconds, row.number))
        del self.slowest[SLOWEST_MOST:]

    @property
    def done(self) -> int:
        """How many jobs are done."""
        return sum(counts["jobs"] for counts in self.splits.values())

    @property
    def totals(self) -> dict[str, int]:
        """Scans, sweeps, rays, hits and points of all done jobs."""
        each = self.splits.values()
        return {name: sum(counts[name] for counts in each) for name in _COUNTS}

    @property
    def sha256(self) -> str:
        """Digest of the names and points of all done jobs, in the order of their rows."""
        return self._digest.hexdigest()

    @property
    def varied(self) -> list[Varied]:
        """What each varied quantity was in each job."""
        return [self._varied(name) for name in self._values]

    def _varied(self, name: str) -> Varied:
        values, labels = np.array(self._values[name]), dict(self._labels[name])
        known = np.isfinite(values)
        values[~known] = np.nan
        if not labels:
            return Varied(name, values, ())
        numbers = known & (np.array(self._labelled[name]) == 0)
        codes = values.copy()
        for value in np.unique(values[numbers]).tolist():  # as «auto» beside 1 and 2
            codes[numbers & (values == value)] = labels.setdefault(f"{value:g}", len(labels))
        order = sorted(labels)
        codes[known] = np.argsort([labels[text] for text in order])[codes[known].astype(np.intp)]
        return Varied(name, codes, tuple(order))

    def each(self, name: str) -> Floats:
        """Return points, rays, hits or seconds of each job (n,)."""
        return np.array(self._each[name])

    @property
    def failures(self) -> Bools:
        """Whether each job failed (n,)."""
        return np.array(self._each["failed"]) > 0

    def spread(self, name: str) -> dict[str, float] | None:
        """Minimum, 10th, 50th and 90th percentile and maximum over done jobs; None without any."""
        values = self.each(name)[~self.failures]
        if not len(values):
            return None
        names = ("lowest", "tenth", "median", "ninetieth", "highest")
        return dict(zip(names, np.percentile(values, (0, 10, 50, 90, 100)).tolist(), strict=True))

    def described(self) -> Iterator[dict[str, Any]]:
        """Yield the figures of each varied quantity."""
        done, points = ~self.failures, self.each("points")
        for varied in self.varied:
            known = done & np.isfinite(varied.values)
            there = varied.there
            out: dict[str, Any] = {"name": varied.name, "jobs": len(there)}
            if varied.labels:
                counts = np.bincount(there.astype(np.intp), minlength=len(varied.labels))
                out["values"] = dict(zip(varied.labels, counts.tolist(), strict=True))
            elif len(there):
                low, median, high = np.percentile(there, (0, 50, 100)).tolist()
                out |= {"lowest": low, "median": median, "highest": high}
                correlation = rank_correlation(varied.values[known], points[known])
                told = None if correlation is None else round(correlation, 6)
                out["rank_correlation_with_points"] = told
            yield out


@dataclass(frozen=True, eq=False)
class Scale:
    """Where the values of a quantity are in a chart, and its bins."""

    name: str
    places: Floats  # (n,): as drawn; NaN without a value
    edges: Floats  # (bins + 1,)
    labels: tuple[str, ...]  # of bins; none for numbers
    is_log: bool

    @classmethod
    def of(cls, varied: Varied) -> Scale:
        """Choose bins for a quantity: of labels one each, of few whole numbers, or equal ones."""
        values, labels, there = varied.values, varied.labels, varied.there
        if len(labels) > MOST_LABELS:
            counts = np.bincount(there.astype(np.intp), minlength=len(labels))
            kept = np.sort(np.argsort(-counts, kind="stable")[: MOST_LABELS - 1])
            place = np.append(np.full(len(labels), MOST_LABELS - 1.0), np.nan)
            place[kept] = np.arange(len(kept))
            values = place[np.nan_to_num(values, nan=-1).astype(np.intp)]
            labels = (*(labels[k] for k in kept), f"{len(labels) - len(kept)} others")
        low, high = (float(there.min()), float(there.max())) if len(there) else (0.0, 1.0)
        bins, is_log = int(np.clip(2 * np.sqrt(len(there)), 6, _BINS)), False
        if labels:
            edges = np.linspace(-0.5, len(labels) - 0.5, len(labels) + 1)
        elif high - low <= 30 and (there == np.round(there)).all():
            edges = np.arange(low - 0.5, high + 1)
        elif low == high:
            edges = np.linspace(low - 0.5, high + 0.5, bins + 1)
        else:
            # Half of a logarithmic distribution lies below the geometric mean of its limits.
            middle = (np.sqrt(max(low, 0.0) * high) * (low + high) / 2) ** 0.5
            is_log = bool(low > 0 and high > 20 * low and np.median(there) < middle)
            spaced = np.geomspace if is_log else np.linspace
            edges = spaced(low, high, bins + 1).astype(np.float64)
        return cls(varied.name, values, edges, labels, is_log)

    @cached_property
    def bin_of(self) -> Ints:
        """int64 (n,): bin of each value; -1 without one."""
        found = np.searchsorted(self.edges, self.places, "right") - 1
        found = found.clip(0, len(self.edges) - 2)
        return np.where(np.isfinite(self.places), found, -1)

    @cached_property
    def short_labels(self) -> list[str]:
        """Labels without what all have in common, and not too long."""
        return [shortened(label, 15) for label in without_common_prefix(self.labels)]

    def slanted(self, wide: float) -> bool:
        """Whether labels are too long to stand side by side."""
        longest = max(map(len, self.short_labels), default=0)
        return longest * _LETTER > wide / max(1, len(self.labels))


def draw_varied(figures: Figures) -> Page | None:
    """Draw a histogram of each varied quantity above the points of each job against it.

    Jobs have the colours of the quantity of few labels that tells most about their points. None
    where nothing was varied or no job has run.
    """
    there = [varied for varied in figures.varied if len(varied.there)]
    if not there:
        return None
    scales = [Scale.of(varied) for varied in there[:MOST_VARIED]]
    rows = -(-len(scales) // ACROSS)
    across = -(-len(scales) // rows)
    wide = (WIDTH - LEFT - RIGHT - BETWEEN * (across - 1)) / across
    below = BELOW + SLANTED * any(scale.slanted(wide) for scale in scales)
    high = COUNTS + GAP + AGAINST + below
    page = Page((WIDTH, TOP + rows * high + (rows - 1) * ABOVE))
    points, failures = figures.each("points"), figures.failures
    limits = _limits(points[~failures])
    telling = _most_telling(scales, points, ~failures)
    colours = np.tile(theme.rgb(DOT), (len(points), 1))
    if telling is not None:
        some = theme.object_colours(len(telling.labels))
        known = telling.bin_of >= 0
        colours[known] = some[telling.bin_of[known]]
    for number, scale in enumerate(scales):
        row, column = divmod(number, across)
        left, top = LEFT + column * (wide + BETWEEN), TOP + row * (high + ABOVE)
        upper = _chart(page, left, top, wide, COUNTS)
        lower = _chart(page, left, top + COUNTS + GAP, wide, AGAINST)
        bars = some if scale is telling else theme.rgb(BAR)
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


def _remarks(figures: Figures, telling: Scale | None, more: int) -> str:
    """Sentence about colours, failures and `more` quantities that are not drawn."""
    told = []
    if telling is not None:
        told.append(f"coloured by {shortened(telling.name, 40)}")
    if failed := int(figures.failures.sum()):
        told.append(f"red: {counted(failed, 'failed job')}")
    if figures.done > MOST_DOTS:
        told.append(f"{MOST_DOTS:,} of {figures.done:,} jobs have dots")
    if more:
        told.append(f"{counted(more, 'more quantity', 'more quantities')} in jobs.csv")
    text = "; ".join(told)
    return f"{text[:1].upper()}{text[1:]}." if text else ""


def _most_telling(scales: Sequence[Scale], points: Floats, done: Bools) -> Scale | None:
    """Quantity of few labels whose groups have the most different points; None without any."""
    between = {}  # {quantity: variance of the means of its groups}
    for scale in scales:
        known = done & (scale.bin_of >= 0)
        if 2 <= len(scale.labels) <= MOST_COLOURS and known.any():
            groups = scale.bin_of[known]
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
            Varied("points of a job", points, ()),
            Varied("rays that hit, per cent", 100 * hits / rays, ()),
            Varied("casting a job, all its tasks, s", seconds, ()),
        )
    high, top = 250, 128
    page = Page((WIDTH, top + high + 92))
    wide = (WIDTH - LEFT - RIGHT - BETWEEN * 2) / 3
    for column, quantity in enumerate(quantities):
        axes = _chart(page, LEFT + column * (wide + BETWEEN), top, wide, high)
        scale = Scale.of(quantity)
        _draw_counts(axes, scale, np.zeros(len(points), np.bool_), theme.rgb(BAR))
        _set_labels(page, axes, scale, wide)
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


def _draw_counts(axes: Axes, scale: Scale, failures: Bools, colours: Floats) -> None:
    bins = len(scale.edges) - 1
    known = scale.bin_of >= 0
    counts = np.bincount(scale.bin_of[known], minlength=bins)
    failed = np.bincount(scale.bin_of[known & failures], minlength=bins)
    left, right = scale.edges[:-1], scale.edges[1:]
    if scale.labels:  # apart, since they have no order
        left, right = left + 0.15, right - 0.15
    wide = right - left
    axes.bar(left, counts - failed, wide, bottom=failed, align="edge", color=colours, lw=0)
    if failed.any():
        axes.bar(left, failed, wide, align="edge", color=theme.SENSOR, lw=0)
    axes.set_ylim(0, 1.1 * max(1, counts.max()))


def _draw_points(
    page: Page, axes: Axes, scale: Scale, points: Floats, failures: Bools, colours: Floats
) -> None:
    """Draw a dot for each job, the failed ones at the bottom, and percentiles."""
    unit = page.unit
    known = np.isfinite(scale.places)
    done = np.flatnonzero(known & ~failures)
    some = done[one_of_each_part(len(done), MOST_DOTS)]
    places = scale.places.copy()
    if scale.labels:  # spread over the bar, the same in each picture of the same jobs
        places += 0.5 * (np.arange(len(places)) * 0.618034 % 1 - 0.5)
    size = float(np.clip(300 / np.sqrt(max(len(some), 1)), 4, 30)) * unit**2
    alpha = float(np.clip(16 / np.sqrt(max(len(some), 1)), 0.25, 0.85))
    axes.scatter(
        places[some], points[some], s=size, c=colours[some], alpha=alpha, linewidths=0,
        clip_on=False, rasterized=True,
    )  # fmt: skip
    if scale.labels:  # a bar for each
        bins = np.unique(scale.bin_of[done])
        groups = [done[scale.bin_of[done] == number] for number in bins]
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
    failed = failed[one_of_each_part(len(failed), MOST_DOTS)]
    axes.scatter(
        places[failed], np.zeros(len(failed)), marker="x", s=18 * unit**2, color=theme.SENSOR,
        linewidths=0.9 * unit, clip_on=False, zorder=5, rasterized=len(failed) > 200,
        transform=axes.get_xaxis_transform(),
    )  # fmt: skip


def _limits(points: Floats) -> tuple[float, float]:
    """Limits of an axis of points: from 0, unless all jobs have nearly the same."""
    if not len(points):
        return 0.0, 1.0
    low, high = float(points.min()), float(points.max())
    if low > 0.6 * high:
        aside = 0.2 * (high - low) or 0.5 * high
        return low - aside, high + aside
    return 0.0, 1.06 * max(high, 1.0)


def _set_labels(page: Page, axes: Axes, scale: Scale, wide: float) -> None:
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
        axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 1000 * low else (1,)))
        axis.set_minor_formatter(NullFormatter())
    else:
        axes.set_xlim(low - 0.02 * (high - low), high + 0.02 * (high - low))
        whole = bool((scale.edges % 1 == 0.5).all())  # bins of whole numbers
        few = max(2, min(6, int(wide / 90)))
        axis.set_major_locator(MaxNLocator(few, integer=whole, min_n_ticks=1))
    axis.set_major_formatter(_tick)


def draw_sweep(sweep: Sweep) -> Page:
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
        f"{counted(len(sweep), 'point')} from above, metres in the sensor's axes",
        ", ".join(values),
    )
    if classes is not None and len(np.unique(classes)) > 1:
        counts = np.bincount(classes)
        frequent = [one for one in counts.argsort()[::-1][:CLASSES].tolist() if counts[one]]
        colours = theme.object_colours(len(frequent))
        painted = np.full((len(points), 3), 0.6)
        for one, colour in zip(frequent, colours, strict=True):
            painted[classes == one] = colour
        names = [f"class {one}" if one else "none" for one in frequent]
        page.legend([*zip(names, colours, strict=True)], "sensor")
    else:
        z = points[:, 2]
        low, high = np.percentile(z, (2, 98)) if len(z) else (0.0, 1.0)
        painted = theme.mapped("viridis", np.clip((z - low) / max(high - low, 1e-6), 0, 1))
    reach = 1.0
    if len(points):
        reach = float(np.percentile(np.abs(points[:, :2]).max(axis=1), 100 * SWEEP_SHARE))
    ratio = SWEEP_FRAME[2] / SWEEP_FRAME[3]
    axes.set_xlim(-reach * ratio, reach * ratio)
    axes.set_ylim(-reach, reach)
    axes.scatter(points[:, 0], points[:, 1], s=3 * page.unit**2, c=painted, lw=0, rasterized=True)
    axes.plot(0, 0, marker="o", color=theme.SENSOR, ms=7 * page.unit)
    return page


def write_card(
    place: Storage,
    campaign: Campaign,
    run: CampaignRun,
    jobs: Iterable[JobRow],
    versions: Mapping[str, str],
    picture: Page | None = None,
) -> dict[str, Any]:
    """Write README.md, report.html, pictures and splits of a data set, and report.json last.

    The rows of the table are read once; a few numbers of each job are held in memory.

    Parameters
    ----------
    place
        Folder of the data set, which must exist.
    campaign, run
        What the jobs are of.
    jobs
        Rows in order, such as `lidarpool.export.jobs.read_table` gives.
    versions
        Software on which the bytes of points depend, {name: version}.
    picture
        Of one job, for README.md.

    Returns
    -------
    The content of report.json.

    Raises
    ------
    LidarpoolError
        If a file cannot be written, or a split cannot be the name of a file.
    """
    with explained(f"The data set's card cannot be written to {place}", "make room"):
        place.remove([LAST_FILE])
        figures = Figures(campaign.names, _with_splits(place, jobs))
        pages = {"job": picture, "varied": draw_varied(figures), "results": draw_results(figures)}
        drawn = {name: page for name, page in pages.items() if page is not None}
        for name, drawing in drawn.items():
            with place.writing(f"{PICTURES}/{name}.png") as file:
                file.write(drawing.png())
        place.remove([f"{PICTURES}/{name}.png" for name in pages if name not in drawn])
        report = campaign_report(campaign, run, versions, figures)
        values: dict[str, Any] = {
            "report": report,
            "captions": _CAPTIONS,
            "command": campaign.command,
            "points_by_class": {
                name if name != "0" else "0 none": one["points"]
                for name, one in report["classes"].items()
            },
            "VALUES_SHOWN": VALUES_SHOWN,
        }
        page = rendered(
            "campaign.html",
            pictures={name: drawn[name].svg() for name in ("varied", "results") if name in drawn},
            slowest=figures.slowest,
            description=campaign.description,
            **values,
            stages=run.stages,
        )
        place.write(PAGE, page.encode())
        card = rendered("card.md", drawn=[*drawn], **values)
        place.write(CARD, card.encode("utf-8", "backslashreplace"))
        text = json.dumps(report, indent=1, allow_nan=False) + "\n"
        place.write(LAST_FILE, text.encode())
    return report


def _with_splits(place: Storage, jobs: Iterable[JobRow]) -> Iterator[JobRow]:
    """Yield rows, and write the names of done jobs into the files of their splits."""
    with ExitStack() as stack:
        files: dict[str, Any] = {}
        for row in jobs:
            if row.split and row.done:
                if row.split not in files:
                    if not re.fullmatch(r"\w[\w.-]*", row.split):
                        raise LidarpoolError(
                            f"A split cannot be called {row.split!r}: use letters and digits."
                        )
                    name = f"{SPLITS}/{row.split}.txt"
                    files[row.split] = stack.enter_context(place.writing(name))
                files[row.split].write(f"{row.name}\n".encode())
            yield row


def campaign_report(
    campaign: Campaign, run: CampaignRun, versions: Mapping[str, str], figures: Figures
) -> dict[str, Any]:
    """Return the figures of a data set, as in report.json."""
    return {
        "title": campaign.title,
        "format": campaign.keep.format,
        "license": campaign.license,
        "seed": campaign.seed,
        "versions": dict(versions),
        "sensors": dict(run.sensors),
        "notes": list(run.notes),
        "jobs": {
            "described": campaign.count,
            "done": figures.done,
            "failed": figures.jobs - figures.done,
            "resumed": run.resumed,
        },
        "totals": figures.totals,
        "seconds": {
            "run": round(run.seconds, 3),
            "casting": round(float(figures.each("seconds").sum()), 3),
        },
        "of_a_job": {name: figures.spread(name) for name in ("points", "rays", "hits", "seconds")},
        "splits": {
            name: {key: counts[key] for key in ("jobs", "sweeps", "points")}
            for name, counts in figures.splits.items()
        },
        "classes": {str(number): {**counts} for number, counts in sorted(figures.classes.items())},
        "varied": list(figures.described()),
        "failed": [_told(row, "error") for row in figures.failed],
        "slowest": [_told(row, "seconds") for row in figures.slowest],
        "stages": stage_figures(run.stages),
        "sha256": figures.sha256,
    }


def _told(row: JobRow, what: str) -> dict[str, Any]:
    values = {
        name: str(value) if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.values.items()
    }
    return {"number": row.number, "name": row.name, "values": values, what: getattr(row, what)}
