"""Shapes of the page's charts; the axes are text of the page, so that they are legible anywhere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from poolpart.wording import counted

from ...plan import Plan, Trial
from ...render.page import without_common_prefix
from ...render.stage import nice_step
from .words import share

HIGH, WIDE = 100, 1000  # units of a drawing, whatever its size on the page
OBJECTS_MOST = 25
CHANNELS_MOST = 128
TICKS = 6
_POINTS_MOST = 400  # of a curve
_LEAST_EXCESS = 1e-6  # a float32 history knows no less

Floats = NDArray[np.float64]
Tick = tuple[float, str]  # per cent of the axis, label


class Bar(NamedTuple):
    """A row of a bar chart: name in full and short, number, share of all, length in per cent."""

    name: str
    label: str
    points: int
    share: str
    percent: float


class ObjectBars(NamedTuple):
    """Points by object; `rest` tells of those that have no bar."""

    bars: tuple[Bar, ...]
    rest: str


class Histogram(NamedTuple):
    """Columns: a path for SVG, ticks below, and the tallest column's count."""

    path: str
    ticks: tuple[Tick, ...]
    tallest: int


class Convergence(NamedTuple):
    """Curves of the trials' best costs: paths for SVG and ticks on both axes."""

    band: str
    median: str
    best: str
    across: tuple[Tick, ...]
    up: tuple[Tick, ...]
    title: str


def object_bars(counts: Mapping[str, int]) -> ObjectBars:
    """Bars of the objects with the most points."""
    total, ranked = sum(counts.values()), sorted(counts.items(), key=lambda item: -item[1])
    hit = [item for item in ranked if item[1]]
    shown = hit[:OBJECTS_MOST]
    most = shown[0][1] if shown else 1
    labels = dict(zip(counts, without_common_prefix(list(counts)), strict=True))
    bars = [Bar(name, labels[name], n, share(n, total), 100 * n / most) for name, n in shown]
    rest = []
    if more := hit[OBJECTS_MOST:]:
        points = sum(count for _, count in more)
        rest.append(
            f"{counted(len(more), 'more object')} with {counted(points, 'point')} "
            f"({share(points, total)})"
        )
    if missed := len(ranked) - len(hit):
        rest.append(f"{counted(missed, 'object')} without points")
    return ObjectBars(tuple(bars), "; ".join(rest))


def range_histogram(counts: NDArray[np.int64], edges: Floats) -> Histogram:
    """Columns of points by distance, (b,), between edges, (b + 1,), in metres."""
    low, high = float(edges[0]), float(edges[-1])
    step = nice_step((high - low) / TICKS)
    at = np.arange(math.ceil(low / step - 1e-9), high / step + 1e-9) * step
    ticks = [(100 * (x - low) / (high - low), f"{x:.6g} m") for x in at.tolist()]
    return Histogram(_columns(counts), tuple(ticks), int(counts.max()))


def channel_histogram(counts: NDArray[np.int64]) -> Histogram:
    """Columns of points by channel, (channels,); neighbours together where there are many."""
    each = -(-len(counts) // CHANNELS_MOST)
    columns = np.add.reduceat(counts, np.arange(0, len(counts), each))
    step = max(1, round(nice_step(len(counts) / TICKS)))
    wide = len(columns) * each
    ticks = [(100 * (k + 0.5) / wide, str(k)) for k in range(0, len(counts), step)]
    return Histogram(_columns(columns), tuple(ticks), int(columns.max()))


def _columns(counts: NDArray[np.int64]) -> str:
    """Path of columns as high as the drawing."""
    width, most = WIDE / len(counts), max(1, int(counts.max()))
    gap = min(0.15 * width, 2.0)
    path = []
    for k, count in enumerate(counts.tolist()):
        if count:
            high = max(0.6, HIGH * count / most)
            path.append(
                f"M{k * width + gap:.1f} {HIGH}V{HIGH - high:.1f}h{width - 2 * gap:.1f}V{HIGH}Z"
            )
    return "".join(path)


def convergence(trials: Sequence[Trial], plan: Plan) -> Convergence | None:
    """Curves of how the trials came down to the shortest path; None where there is nothing.

    Up is the logarithm of the excess over the shortest possible path, or over the least cost
    that was found where none is possible.
    """
    costs = np.array([trial.history for trial in trials], np.float64)  # (trials, iterations)
    if not costs.size:
        return None
    possible = 0 < plan.shortest_possible < math.inf
    base = plan.shortest_possible if possible else max(float(costs.min()), 1e-9)
    excess = np.log10(np.maximum(costs / base - 1, _LEAST_EXCESS))
    low = math.floor(excess.min())
    high = min(max(math.ceil(excess.max()), low + 1), max(1, low + 1))
    chosen = np.unique(np.linspace(0, costs.shape[1] - 1, _POINTS_MOST).astype(int))
    x = ((chosen + 1) / costs.shape[1] * WIDE).tolist()

    def line(values: Floats, step: int = 1) -> str:
        """Points of a curve; what is above the drawing runs along its edge."""
        y = HIGH * (1 - (values.clip(low, high) - low) / (high - low))
        points = list(zip(x, y.tolist(), strict=True))
        return "L".join(f"{a:.1f} {b:.2f}" for a, b in points[::step])

    best = next((k for k, trial in enumerate(trials) if trial.trial == plan.trial), 0)
    tenth, middle, ninth = np.quantile(excess[:, chosen], (0.1, 0.5, 0.9), axis=0, method="nearest")
    step = max(1, round(nice_step(costs.shape[1] / TICKS)))
    iterations = range(0, costs.shape[1] + 1, step)
    return Convergence(
        band=f"M{line(ninth)}L{line(tenth, -1)}Z",
        median=f"M{line(middle)}",
        best=f"M{line(excess[best, chosen])}",
        across=tuple((100 * k / costs.shape[1], f"{k:,}") for k in iterations),
        up=tuple(
            (100 * (power - low) / (high - low), f"{10.0 ** (power + 2):.4g}%")
            for power in range(low, high + 1)
        ),
        title="lowest cost so far, above the "
        + ("shortest possible path" if possible else "lowest that was found"),
    )
