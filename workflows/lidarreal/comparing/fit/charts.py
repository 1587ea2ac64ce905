"""Charts of a fit, with confidence intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from lidarview.render import theme
from lidarview.render.picture_page import Page, label_logarithms

from .estimates import Estimate


class _Chart(NamedTuple):
    """Axis labels of a chart, and a factor that converts values to the unit of the y axis."""

    x_label: str
    y_label: str
    factor: float


# {curve or channel field: chart}. There are three charts in a row.
_CHARTS = {
    "noise_by_range": _Chart("range, m", "noise, mm", 1000),
    "noise_by_light": _Chart("intensity or energy", "noise, mm", 1000),
    "noise_by_tilt": _Chart("incidence angle, °", "noise including angle noise, mm", 1000),
    "returned_by_light": _Chart("intensity or energy", "pulses that return, %", 100),
    "lost_by_range": _Chart("range in the scene, m", "pulses lost, %", 100),
    "light_by_range": _Chart("range, m", "mean intensity", 1),
    "noise_m": _Chart("elevation, °", "noise, mm", 1000),
    "bias_m": _Chart("elevation, °", "bias, mm", 1000),
    "uneven_deg": _Chart("elevation, °", "azimuth spread, 0.001°", 1000),
}


def draw_charts(figures: Mapping[str, Any]) -> Page:
    """Draw all curves and the values of each ring, with confidence intervals."""
    channels = figures["channels"]
    curves = dict(figures["curves"])
    for name in ("noise_m", "bias_m", "uneven_deg"):
        curves[name] = [
            {"x": channel["elevation_deg"], **channel[name]}
            for channel in channels
            if channel[name]
        ]
    names = [name for name in _CHARTS if curves.get(name)]
    height = 140 + 500 * -(-len(names) // 3)  # pixels
    page = Page((1600, height))
    page.title(figures["model"], f"fitted to {figures['name']}; bars show 95 % intervals")
    for number, name in enumerate(names):
        row, column = divmod(number, 3)
        bottom = 1 - (530 + 500 * row) / height
        axes = page.chart((0.075 + 0.32 * column, bottom, 0.235, 360 / height))
        _draw_curve(page, axes, name, curves[name])
    return page


def _draw_curve(page: Page, axes: Axes, name: str, points: Sequence[Mapping[str, float]]) -> None:
    """Draw the points of a curve with confidence intervals."""
    chart = _CHARTS[name]
    x = np.array([point["x"] for point in points])
    value, lower, upper = (
        chart.factor * np.array([point[field] for point in points]) for field in Estimate._fields
    )
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
    if name.endswith("light") and x[0] > 0:
        axes.set_xscale("log")
        label_logarithms(axes.xaxis, x[-1] < 1000 * x[0])
    is_share = chart.y_label.endswith("%")
    if is_share:
        lower, upper = np.clip((lower, upper), 0, 100)
    axes.vlines(x, lower, upper, color=theme.UNSEEN, lw=1.8 * page.unit)
    axes.plot(x, value, "o", color=theme.OBJECT_COLORS[0], ms=3.2 * page.unit, mew=0)
    if is_share:
        axes.set_ylim(*np.clip(axes.get_ylim(), -1, 101))
